"""Scenarios of CommonRoad become cases of interceptions: roads, traffic, goals, and states."""

import importlib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.path import Path as Area

import planner_jax as pj
from planner_jax.robot.car import CarPlan

ROOT = Path(__file__).parents[1]
# Two lanes of 3.5 m and 40 m side by side; the right one, below y = 0, continues in a bend.
SCENARIO = ROOT / "tests" / "data" / "commonroad.xml"


@pytest.fixture(scope="module")
def package():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "benchmarks" / "commonroad_reader")
        yield [importlib.import_module(f"commonroad_{name}") for name in ("reader", "rows")]


@pytest.fixture(scope="module")
def reader(package):
    return package[0]


@pytest.fixture(scope="module")
def problems(reader):
    return reader.read(SCENARIO)


def rectangle_goal(problems):
    return next(each for each in problems if each.arguments["earliest"] == 3.0)


def distance_from_walls(problem, points):
    walls = np.concatenate(
        [np.linspace(wall, np.roll(wall, -1, axis=0), 200) for wall in problem.arguments["walls"]],
        axis=None,
    ).reshape(-1, 2)
    return np.linalg.norm(np.asarray(points, float)[:, None] - walls, axis=2).min(axis=1)


def test_walls_stand_on_the_outer_borders_of_the_road_alone(problems):
    along = np.linspace(1.0, 39.0, 20)
    at = {y: np.stack([along, np.full(20, y)], axis=1) for y in (-3.5, 0.0, 3.5)}
    problem = rectangle_goal(problems)
    assert distance_from_walls(problem, at[-3.5]).max() < 0.1
    assert distance_from_walls(problem, at[3.5]).max() < 0.1
    assert distance_from_walls(problem, at[0.0][:-2]).min() > 1.9  # the circle, 2 m away
    angles = np.linspace(0.1, 1.4, 9)
    for radius in (10.0, 13.5):
        bend = [40.0, 10.0] + radius * np.stack([np.sin(angles), -np.cos(angles)], axis=1)
        assert distance_from_walls(problem, bend).max() < 0.2


def test_the_ends_of_the_road_and_the_way_between_lanelets_are_open(problems):
    gates = [[0.0, -1.75], [0.0, 1.75], [40.0, -1.75], [40.0, 1.75], [51.75, 10.0]]
    assert distance_from_walls(rectangle_goal(problems), gates).min() > 1.0


def test_a_circle_becomes_a_polygon_around_it(problems):
    polygon = rectangle_goal(problems).arguments["walls"][-1]
    radii = np.linalg.norm(polygon - [30.0, 3.0], axis=1)
    assert radii.min() >= 1.0 and radii.max() < 1.03


def test_traffic_exists_from_its_first_to_its_last_state_after_the_start(problems):
    arguments = rectangle_goal(problems).arguments
    (car, pedestrian), (times, poses) = arguments["movers"], arguments["mover_paths"][0]
    np.testing.assert_allclose(times, [0.0, 0.5, 1.0, 1.5, 2.0])  # the problem starts at step 2
    np.testing.assert_allclose(poses[:, 0], [16.0, 14.0, 12.0, 10.0, 8.0])
    np.testing.assert_allclose(np.diff(poses[:, 2]), 0.1, atol=1e-3)  # it does not jump by 2 pi
    np.testing.assert_allclose(np.abs(car), [[2.0, 1.0]] * 4)
    assert pedestrian.max() == 0.6
    np.testing.assert_allclose(arguments["mover_paths"][1][0], [2.0, 2.5, 3.0, 3.5])


def test_a_goal_has_its_region_and_its_intervals(problems):
    problem = rectangle_goal(problems)
    arguments = problem.arguments
    assert (arguments["earliest"], arguments["time"]) == (3.0, 4.0)
    assert arguments["end_heading"] == pytest.approx(0.1)
    assert arguments["heading_tolerance"] == pytest.approx(0.2, rel=0.03)
    assert arguments["end_speed"] == (2.0, 9.0)
    np.testing.assert_allclose(arguments["target"].pos, [36.0, 1.5])
    corner = [3.0 * np.cos(0.1) - np.sin(0.1), 3.0 * np.sin(0.1) + np.cos(0.1)]
    assert np.abs(arguments["region"] - corner).sum(axis=1).min() < 0.1


def test_a_goal_lanelet_is_divided_into_convex_goals_that_lie_inside_it(problems):
    parts = [each for each in problems if each.arguments["time"] == 6.0]
    assert len(parts) > 1 and all(each.arguments["heading_tolerance"] > 3.1 for each in parts)
    corners = np.concatenate(
        [np.asarray(each.arguments["target"].pos) + each.arguments["region"] for each in parts]
    )
    radii = np.linalg.norm(corners - [40.0, 10.0], axis=1)
    assert 9.8 < radii.min() < 10.5 and 13.0 < radii.max() < 13.6


def test_the_body_of_the_car_starts_in_the_middle_that_the_file_states(reader, problems):
    arguments = problems[0].arguments
    np.testing.assert_allclose(arguments["start"], [5.0 - reader.AHEAD, -1.75, 0.0])
    assert (arguments["initial_speed"], arguments["speed"]) == (8.0, reader.SPEED)
    assert arguments["initial_curvature"] == pytest.approx(0.05)
    front = reader.CAR["length"] - reader.CAR["rear_overhang"]
    assert arguments["start"][0] + front == pytest.approx(5.0 + 0.5 * reader.CAR["length"])


def test_the_states_of_a_plan_are_the_middles_of_the_body_at_the_time_steps(package, problems):
    knots = 9
    plan = CarPlan(
        cost=jnp.zeros(()),
        violation=jnp.zeros(()),
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.zeros((), jnp.int32),
        start=jnp.asarray(problems[0].arguments["start"]),
        time=jnp.asarray(4.0),
        speed=jnp.full(knots, 8.0),
        curvature=jnp.full(knots, 0.0),
        origin=jnp.zeros(2),
    )
    row = package[1].row_of(problems[0], plan)
    assert (row["file"], row["problem"]) == ("commonroad.xml", 7)
    expected = [[5.0 + 4.0 * k, -1.75, 0.0, 8.0, 0.0] for k in range(9)]  # every 0.5 s
    np.testing.assert_allclose(row["states"], expected, atol=1e-4)


def test_the_car_does_not_start_in_a_wall(problems):
    walls = problems[0].arguments["walls"]
    body = [5.0, -1.75] + np.array([[-2.25, -0.8], [2.25, -0.8], [2.25, 0.8], [-2.25, 0.8]])
    assert not any(Area(body).intersects_path(Area(wall), filled=True) for wall in walls)


def test_cases_of_a_batch_have_equal_shapes(reader, tmp_path, monkeypatch):
    text = SCENARIO.read_text()
    (tmp_path / "a.xml").write_text(text)
    kept = text[: text.index('<dynamicObstacle id="12"')] + text[text.index("<planningProblem") :]
    (tmp_path / "b.xml").write_text(kept)
    monkeypatch.setenv("COMMONROAD", str(tmp_path))
    cases = reader.draw(2, 0, 0)
    pj.require_sound(cases)
    assert cases.batch_shape == (2,)
    assert sorted(np.asarray(cases.movers.present).sum(axis=1)) == [2, 3]  # one is 1 km away
