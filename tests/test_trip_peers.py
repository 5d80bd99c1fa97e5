"""Trips among walls: the time of a path, the clearance at a pose, and reading of maps."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import planner_jax as pj
from planner_jax.benchmarks import trip_peers
from planner_jax.benchmarks.trip_peers import JACKAL, MARGIN, make_trip, time_path

BOX = np.array([(4.0, -1.0), (5.0, -1.0), (5.0, 1.0), (4.0, 1.0)])


@pytest.fixture(scope="module")
def trip():
    walls = [BOX, pj.intercept.Circle(2.0, 3.0, 0.5)]
    return make_trip(walls, (0.0, 0.0, 0.0), (8.0, 0.0), (-3.0, -5.0), (10.0, 5.0))


@pytest.mark.parametrize("length", [0.5, 3.0, 20.0])
def test_a_straight_path_is_driven_by_a_trapezoid_of_speed(length):
    speed, acceleration = 2.0, 1.0
    pieces = np.full(200, length / 200)
    expected = length / speed + speed / acceleration
    if length < speed**2 / acceleration:
        expected = 2.0 * np.sqrt(length / acceleration)
    assert time_path(pieces, np.full(200, speed), acceleration) == pytest.approx(expected)


def test_a_slow_piece_takes_the_time_of_its_speed_and_of_the_ramps_beside_it():
    speed = np.array([2.0, 1.0, 2.0])
    # On both outer pieces of 10 m: 1.5 m from 2 to 1 m/s in 1 s, 2 m from 0 to 2 m/s in 2 s.
    outer = 1.0 + 2.0 + (10.0 - 1.5 - 2.0) / 2.0
    fine = np.full(300, 0.1), np.repeat(speed, 100)
    assert time_path(*fine, 1.0) == pytest.approx(2.0 * outer + 10.0, rel=1e-3)


def test_a_pose_is_free_if_the_body_keeps_the_margin(trip):
    front = JACKAL["length"] - JACKAL["rear_overhang"]
    touching = 4.0 - MARGIN - front  # the front end is at the margin of the box
    assert trip.is_free(touching - 1e-3, 0.0, 0.0) and not trip.is_free(touching + 1e-3, 0.0, 0.0)
    beside = 3.0 - 0.5 - MARGIN - 0.5 * JACKAL["width"]  # the left side is at the disc's margin
    assert trip.is_free(1.9, beside - 1e-3, 0.0) and not trip.is_free(1.9, beside + 1e-3, 0.0)
    assert not trip.is_free(9.95, 0.0, 0.0)  # the body's middle is off the map


def test_a_path_is_rejected_that_touches_a_wall_misses_the_goal_or_bends_too_much(trip):
    start = np.asarray(trip.case.start, float)
    straight = start + np.linspace(0.0, 8.0, 50)[:, None] * np.array([1.0, 0.0, 0.0])
    assert not trip.judge_path(straight, 0.0).success
    free = make_trip([BOX + (0.0, 4.0)], (0.0, 0.0, 0.0), (8.0, 0.0), (-3.0, -5.0), (10.0, 5.0))
    found = free.judge_path(straight, 0.0)
    assert found.success and found.time == pytest.approx(8.0 / 2.0 + 2.0, rel=1e-3)
    assert found.lateral == pytest.approx(found.time)
    assert not free.judge_path(straight[:-1], 0.0).success
    bent = straight.copy()
    bent[20:, 2] += 0.5
    assert not free.judge_path(bent, 0.0).success


def test_a_path_of_cells_leads_round_the_box(trip):
    path = trip_peers.path_of_cells(trip)
    assert np.linalg.norm(path[[0, -1]] - [(0.0, 0.0), (8.0, 0.0)], axis=1).max() < 0.1
    length = np.hypot(*np.diff(path, axis=0).T).sum()
    assert 8.0 < length < 9.5
    assert float(trip.case.time) == pytest.approx(2.0 * (length / 2.0 + 2.0))


def test_a_world_of_gazebo_is_read_as_circles(tmp_path):
    model = "<model name='unit_cylinder_{}'><static>1</static><pose frame=''>{} 6 0 0 0 0</pose>"
    state = "<state><model name='unit_cylinder_0'><pose frame=''>9 9 0 0 0 0</pose></model></state>"
    models = "".join(f"{model.format(k, x)}</model>" for k, x in enumerate((-1.5, -3.0)))
    file = tmp_path / "one.world"
    file.write_text(f"<world>{models}{state}</world>")
    walls = trip_peers.read_barn(file).walls
    assert np.asarray(walls.centre).tolist() == [[-1.5, 6.0], [-3.0, 6.0]]
    assert np.asarray(walls.radius) == pytest.approx(trip_peers.RADIUS)


def test_generated_maps_give_trips_with_free_ends(tmp_path):
    trip_peers.write_maps(folder := tmp_path / "maps", 0)
    for name in ("rooms", "warehouse"):
        for one in trip_peers.draw_trips(folder / f"{name}.yaml", 2, 0):
            assert one.is_free(*map(float, one.case.start))
            assert len(trip_peers.path_of_cells(one))


@pytest.mark.skipif(importlib.util.find_spec("ompl") is None, reason=trip_peers.OMPL)
def test_rrt_connect_drives_round_the_box(trip):
    found = trip_peers.search_ompl(trip, 1)[0]
    assert found.success and 6.0 < found.time <= found.lateral


def test_a_folder_without_worlds_is_reported(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(trip_peers, "compare", lambda *_, **__: None)
    monkeypatch.setattr(trip_peers, "draw_trips", lambda *_: [])
    monkeypatch.setattr("sys.argv", ["trip_peers", "--out", str(tmp_path / "run")])
    trip_peers.main()
    assert "pass its folder by --barn" in capsys.readouterr().out
    assert Path(tmp_path / "run" / "maps" / "rooms.pgm").exists()
