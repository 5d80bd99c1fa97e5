"""Recordings of flights, and the viewer that plays them."""

import dataclasses
import importlib.util
import socket
import sys
import time
import urllib.request
from types import SimpleNamespace

import jax
import numpy as np
import pyarrow as pa
import pytest

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.core.errors import ArgumentError
from planner_jax.core.missing_extra import install_line
from planner_jax.runs.dataset import Dataset
from planner_jax.runs.run_folder import RunFolder
from planner_jax.sims import recording as recordings
from planner_jax.sims import view
from planner_jax.sims.loop_state import Flown, Record
from planner_jax.sims.model import BALL_RADIUS
from planner_jax.sims.robot import Physics
from planner_jax.sims.scoring import no_contact
from planner_jax.sims.settings import CatchFly
from planner_jax.sims.tasks.catch import CATCH_WORLD
from planner_jax.sims.tasks.hit import HIT_WORLD
from planner_jax.sims.view import Viewer, free_address
from tests.recordings import recording

GRAVITY, NET = CATCH_WORLD.gravity, CATCH_WORLD.robot
needs_viser = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None,
    reason="viser is not installed; it comes with the extra view",
)


def drag_free(pos, vel, times):
    return pos + np.outer(times, vel) - np.outer(0.5 * GRAVITY * times**2, [0.0, 0.0, 1.0])


def flight_with_return():
    """Return a quadrotor at rest for 0.5 s, and a ball that is hit straight up after 0.2 s."""
    times = 0.01 * np.arange(1, 51)
    pos, vel = np.array([2.0, 0.0, 2.0]), np.array([-3.0, 0.0, 4.0])
    balls = drag_free(pos, vel, times)
    qpos = np.concatenate([np.tile([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0], (50, 1)), balls], axis=1)
    still = np.zeros((1, 50, 9)), np.zeros((1, 50, 4))
    record = Record(times[None], Physics(qpos[None], *still), qpos[None, :, :3], None, None)
    met = {"met": np.array([[True]]), "time": np.array([[0.2]])}
    contact = no_contact(1).replace(**met, ball_pos=drag_free(pos, vel, np.array([0.2]))[None])
    back = pj.BallState(contact.ball_pos[:, 0], np.array([[0.0, 0.0, 5.0]]))
    flown = Flown(contact, None, np.zeros(1), np.zeros((1, 2)), record)
    launched = pj.BallState(pos[None, None], vel[None, None])
    return flown, launched, back


def record_flight(flown, balls, begins, **more):
    drag = np.zeros((1, len(begins)))
    launches = recordings.Launches(balls, drag, np.array(begins), seen=0.3, **more)
    one = {"index": np.array([0]), "success": np.array([True])}
    return recordings.make_recording(CATCH_WORLD, flown, launches, **one)


def test_a_recording_contains_the_ball_from_the_machine_to_the_ground():
    flown, launched, back = flight_with_return()
    whole = record_flight(flown, launched, [0.0], returned=back, target=np.zeros((1, 3)))
    path, times = whole.balls[0, :, 0], whole.time[0]
    np.testing.assert_allclose(times[0], -0.3, atol=1e-9)
    before = times < 0.205
    expected = drag_free(launched.pos[0, 0], launched.vel[0, 0], times[before])
    np.testing.assert_allclose(path[before], expected, atol=1e-6)
    place, heading = whole.launch(0)
    np.testing.assert_allclose(place, expected[0], atol=1e-6)
    assert abs(abs(heading) - np.pi) < 1e-6  # along -x
    down = 0.2 + (5.0 + np.sqrt(25.0 + 2.0 * GRAVITY * back.pos[0, 2])) / GRAVITY
    assert down <= times[-1] < down + 0.02
    np.testing.assert_allclose(path[-1], [*back.pos[0, :2], 0.0], atol=1e-4)
    assert np.isfinite(path).all()
    assert np.isnan(whole.robot[0, times > 0.505]).all()  # the simulation has ended
    assert whole.num_samples(0) == len(times)


def test_a_second_ball_is_recorded_from_its_own_launch():
    flown, launched, _ = flight_with_return()
    physics, begin = flown.record.physics, 0.4
    waiting = np.full((1, 50, 3), 100.0)
    none = {"met": np.zeros((1, 2), bool), "time": np.zeros((1, 2))}
    contact = no_contact(2).replace(**none, ball_pos=np.zeros((1, 2, 3)))
    physics = physics.replace(qpos=np.concatenate([physics.qpos, waiting], axis=2))
    record = flown.record.replace(physics=physics)
    flown = dataclasses.replace(flown, contact=contact, record=record)
    balls = jax.tree.map(lambda leaf: np.repeat(leaf, 2, axis=1), launched)
    whole = record_flight(flown, balls, [0.0, begin])
    times, second = whole.time[0], whole.balls[0, :, 1]
    assert np.isnan(second[times < begin - 0.305]).all()
    early = (times > begin - 0.305) & (times < begin + 0.005)
    expected = drag_free(launched.pos[0, 0], launched.vel[0, 0], times[early] - begin)
    np.testing.assert_allclose(second[early], expected, atol=1e-6)
    assert np.isnan(second[times > begin + 0.005]).all()  # the record has it far away
    assert np.isnan(whole.met).all() and np.isnan(whole.contact).all()
    assert whole.num_samples(0) == len(times) == 81


def test_a_recording_is_read_as_it_was_written(tmp_path):
    written = recording()
    Dataset(tmp_path / recordings.FLIGHTS).write_rows(recordings.to_rows(written))
    read = recordings.read_recording(Dataset(tmp_path / recordings.FLIGHTS).read())
    for field in dataclasses.fields(written):
        before, after = getattr(written, field.name), getattr(read, field.name)
        assert before.shape == after.shape
        np.testing.assert_allclose(after, before, atol=1e-6)


def test_a_frame_holds_all_positions_at_a_sample():
    now = recordings.frame(recording(), NET, 0, 2)
    assert now.time == 0.02
    np.testing.assert_allclose(now.robot[:3], [0.0, 0.0, 1.02])
    np.testing.assert_allclose(now.wanted, [0.01, 0.01, 1.03])
    np.testing.assert_allclose(now.balls, [[0.3, 0.0, 1.98]])
    with pytest.raises(ValueError, match="^flight must be >= 0 and < 1, got 1$"):
        recordings.frame(recording(), NET, 1, 0)
    for sample in (-1, 6):
        with pytest.raises(ValueError, match=f"^sample must be >= 0 and < 6, got {sample}$"):
            recordings.frame(recording(), NET, 0, sample)


def test_after_its_end_a_flight_stands_still_and_a_caught_ball_lies_in_the_net():
    last = recordings.frame(recording(), NET, 0, 5)
    np.testing.assert_allclose(last.robot[:3], [0.0, 0.0, 1.04])
    inside = [[0.0, 0.0, 1.04 + NET.tool.height - BALL_RADIUS]]
    np.testing.assert_allclose(last.balls, inside)
    beside_racket = recordings.frame(recording(), HIT_WORLD.robot, 0, 5).balls
    assert np.isnan(beside_racket).all()  # a racket holds no ball


def test_an_address_that_cannot_be_served_is_refused_in_one_line():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ArgumentError, match=f"^port must be free, got {port}"):
            free_address("localhost", port)
    with pytest.raises(ArgumentError, match="^port must be >= 0 and <= 65535, got 70000$"):
        free_address("localhost", 70000)
    for host in ("192.0.2.1", "no such host"):
        with pytest.raises(ArgumentError, match="^host must be an address of this machine, got '"):
            free_address(host, 0)


@pytest.fixture
def run_folder(tmp_path):
    folder = RunFolder(tmp_path / "run")
    settings = dataclasses.asdict(CatchFly())
    manifest = {
        **{"kind": "fly catch", "state": "complete", "parameters": settings, "seed": 0},
        **{"device": {}, "loop": {}, "times": {"compile_seconds": 0.0, "wall_seconds": 1.0}},
        "summary": {
            **{"num": 1, "successes": 1, "success_rate": 1.0, "wilson_95": [0.2, 1.0]},
            **{"tracking_rms_median": 0.0, "tracking_worst": 0.0},
        },
    }
    with folder.lock():
        Dataset(folder.path / recordings.FLIGHTS).write_rows(recordings.to_rows(recording()))
        folder.plans.write_rows(pa.table({"index": [0]}))
        folder.write_manifest(manifest)
    return folder


def read_error(capsys, *arguments):
    assert main(["view", *map(str, arguments)]) == 2
    return capsys.readouterr().err.removeprefix("planner-jax: error: ")


def test_a_folder_without_flights_is_refused_in_one_line(run_folder, tmp_path, capsys):
    says = "RUN must be the folder of a run, with its m"
    assert read_error(capsys, tmp_path / "no").startswith(says)
    manifest = run_folder.read_manifest()
    for change, says in (
        ({"kind": "bench hit_rows"}, "a run of flights, got a bench hit_rows\n"),
        ({"state": "running"}, "finished, with its flights, got"),
        ({"parameters": manifest["parameters"] | {"task": "catch"}}, "a run with settings of this"),
        ({}, "a run whose flights/part-000000-"),
    ):
        run_folder.write_manifest(manifest | change)
        if not change:
            Dataset(run_folder.path / recordings.FLIGHTS).files()[0].write_bytes(b"half of it")
        assert read_error(capsys, run_folder.path).startswith(f"RUN must be {says}")


def test_a_missing_viser_is_named_with_its_remedy(run_folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    expected = f"the viewer needs the package viser: {install_line('view')}\n"
    assert read_error(capsys, run_folder.path) == expected


@needs_viser
def test_a_flight_is_served_scrubbed_and_played():
    two = jax.tree.map(lambda leaf: np.repeat(leaf, 2, axis=0), vars(recording()))
    two["time"] = two["time"].astype(np.float32)
    two["index"] = np.arange(2)
    viewer = Viewer(CatchFly().flight(), recordings.Recording(**two), port=0)
    try:
        with urllib.request.urlopen(viewer.url, timeout=10) as page:
            assert page.status == 200 and b"<html" in page.read()
        viewer.time.value = 0.02
        assert viewer.sample == 2
        np.testing.assert_allclose(viewer.robot[0].position, [0.0, 0.0, 1.02])
        viewer.flight.value = "catch 1, success"
        assert viewer.sample == 0
        viewer.speed.value = 1.0
        viewer.advance(0.03)
        assert viewer.sample == 3
        viewer.playing.value = False
        viewer.advance(0.01)
        assert viewer.sample == 3
        viewer.playing.value = True
        viewer.advance(0.03)
        assert viewer.sample == 0  # back at the start
    finally:
        viewer.close()


@needs_viser
def test_the_command_plays_until_ctrl_c(run_folder, capsys, monkeypatch):
    naps = iter([None, None])

    def sleep(_):
        if next(naps, "done") == "done":
            raise KeyboardInterrupt

    monkeypatch.setattr(view, "time", SimpleNamespace(sleep=sleep, monotonic=time.monotonic))
    assert main(["view", str(run_folder.path), "--port", "0"]) == 0
    assert "Playing 1 flights at http://localhost:" in capsys.readouterr().out
