"""Run folders of flights, films, and the command `planner-jax fly`."""

import dataclasses
import re
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from matplotlib.figure import Figure

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.core.registry import Task
from planner_jax.core.tasks import all_tasks
from planner_jax.runs.run_folder import RunFolder
from planner_jax.sims import loop as sims_loop
from planner_jax.sims import settings
from planner_jax.sims.block_settings import BlockFly
from planner_jax.sims.film import Scene, film_flights, require_film
from planner_jax.sims.launch import flight_keys, launch_ball, ready
from planner_jax.sims.loop import begin_compiling, fly_leg
from planner_jax.sims.loop_state import collect_flights
from planner_jax.sims.recording import Launches
from planner_jax.sims.run import start_flights
from planner_jax.sims.scoring import passage
from planner_jax.sims.settings import BallFly, CatchFly, HitFly, fly_settings
from planner_jax.sims.task import BallFlightTask, FlightCases, Flights
from planner_jax.sims.tasks.catch import CATCH_WORLD
from tests.recordings import recording

# Each row has invalid settings of a run, and the beginning of the error message.
BAD = """
fly_settings("dodge") | task must be one that can be flown (hit, rally, catch, team, intercept
CatchFly(balls=2, replan=100.0 / 3.0) | replan must be such that its period divides 0.8 s, got 33.3
CatchFly(decide="given") | decide must be one of best, greedy, random, policy, got 'given'
CatchFly(decide="best:file") | decide must be best without a file, got 'best:file'
CatchFly(redecide=40.0) | redecide must be 0 or a divisor of the 100 Hz of replanning, got 40
CatchFly(planner="mpp", redecide=100.0) | redecide must be 0 or a divisor of the 0 Hz of replanning
HitFly(planner="juggle", replan=50.0) | replan must be 0 for other planners, got 50
CatchFly(drag_error=-0.1) | drag_error must be >= 0 and < 1, got -0.1
InterceptFly(replan=3.0) | replan must be a divisor of 50 Hz, got 3
InterceptFly(noise="lab") | noise must be one of none, paper, got 'lab'
InterceptFly(latency=0.012) | latency must be a multiple of the control steps' 0.005 s, got 0.012
BlockFly(replan=10.0) | replan must be >= 0, and 0 without perception: a block is planned once, got
BlockFly(perception=True, noise=-1.0) | noise must be finite and >= 0, got -1
BlockFly(perception=True, frame_rate=0.0) | frame_rate must be finite and > 0, got 0
BlockFly(perception=True, planner="library:some.lib") | planner must be one other than 'library' wi
BlockFly(encoders="no") | encoders must be one of none, fine, coarse, got 'no'
BlockFly(observe=-0.1) | observe must be finite and >= 0, got -0.1
BlockFly(tip="flange") | tip must be left out without --arm, got 'flange'
BlockFly(arm="arm.xml", regime="R1") | regime must be left out with --arm, which has limits of its o
BlockFly(mass_error=-1.0) | mass_error must be > -1 and < 1, got -1
""".strip().splitlines()


def test_blocks_with_a_camera_have_defaults_of_their_own():
    def of(**given):
        found = BlockFly(**given)
        return found.suite, found.regime, found.wide

    assert of() == ("pole", "R2", False)
    assert of(perception=True) == ("short", "R1", True)
    assert of(perception=True, arm="arm.xml") == ("short", "R2", True)  # R2: limits of the file
    assert of(perception=True, wide=False, suite="open", regime="R3") == ("open", "R3", False)


@pytest.mark.parametrize("row", BAD)
def test_settings_that_break_a_rule_are_refused_in_one_line(row):
    call, message = row.split(" | ")
    with pytest.raises(pj.ArgumentError, match=f"^{re.escape(message)}") as caught:
        eval(call, vars(settings) | {"BlockFly": BlockFly})
    assert "\n" not in str(caught.value)


def test_order_and_times_are_decided_with_every_plan_by_default():
    assert CatchFly().redecide_rate == CatchFly().rate == 100.0
    assert CatchFly(replan=50.0).redecide_rate == 50.0
    assert CatchFly(redecide=0.0).redecide_rate == 0.0
    assert CatchFly(planner="mpp").redecide_rate == 0.0  # "mpp" does not replan


def test_a_film_is_written_without_a_display(tmp_path):
    path = tmp_path / "flights.gif"
    film_flights(path, HitFly().flight(), recording(target=(1.75, 0.0, 0.0)), 1)
    assert path.read_bytes()[:4] == b"GIF8"
    assert list(tmp_path.iterdir()) == [path]


def test_a_picture_shows_the_whole_path_of_the_returned_ball():
    kept = recording(met=0.02, target=(1.75, 0.0, 0.0))
    kept = dataclasses.replace(kept, balls=np.nan_to_num(kept.balls))
    scene = Scene(Figure(), HitFly().flight(), kept, 0)
    for at, back, num in ((4, None, 2), (2, 4, 2), (3, 3, 1)):
        scene.show(at, back)
        assert np.isfinite(np.array(scene.returned.get_data_3d())).all(axis=0).sum() == num


def test_a_film_tells_the_outcome_and_marks_the_contact_only_after_it(tmp_path, monkeypatch):
    kept = recording(met=0.02, target=(1.75, 0.0, 0.0))
    titles, stars = [], []

    def look(scene, at, back=None):
        show(scene, at, back)
        titles.append(scene.axes.get_title())
        stars.append(sum(line.get_marker() == "*" for line in scene.axes.lines))

    show = Scene.show
    monkeypatch.setattr(Scene, "show", look)
    film_flights(tmp_path / "flights.gif", HitFly().flight(), kept, 1)
    assert (titles[0], stars[0]) == ("hit 3", 0)
    assert (titles[-1], stars[-1]) == ("hit 3, success", 1)


def test_a_picture_contains_the_robot_s_whole_path():
    kept = recording(target=(1.75, 0.0, 0.0))
    kept.robot[0, -1, :3] = (0.0, 0.0, 9.0)
    scene = Scene(Figure(), CatchFly().flight(), kept, 0)
    assert scene.axes.get_zlim()[1] > 9.0


def test_a_film_that_fails_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(Figure, "clear", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        film_flights(tmp_path / "flights.gif", CatchFly().flight(), recording(), 1)
    assert not list(tmp_path.iterdir())


def test_mp4_without_ffmpeg_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    rule = "video must end in .gif where ffmpeg is not installed"
    with pytest.raises(pj.ArgumentError, match=f"^{rule}"):
        require_film(tmp_path / "flights.mp4")


@pytest.mark.slow
def test_a_run_of_flights_writes_all_its_files(tmp_path, capsys):
    out = tmp_path / "run"
    command = ["fly", "catch", "--num", "3", "--batch", "2", "--noise", "none", "--replan", "0"]
    assert main([*command, "--video", "--out", str(out)]) == 0
    printed, told = capsys.readouterr()
    assert "100.00 % of 3 flights caught all balls" in printed and "compiles first" in told
    files = {"manifest.json", "table.md", "index.html", "flights.gif"}
    assert {path.name for path in out.glob("[!.]*")} == files | {"plans", "flights", "figures"}
    page = (out / "index.html").read_text()
    for name in ("index.html", "table.md", "figures/flight.png"):
        (out / name).unlink()
    assert main(["report", str(out)]) == 0
    assert "100.00 % of 3 flights caught all balls" in capsys.readouterr().out
    assert (out / "figures" / "flight.png").exists() and (out / "table.md").exists()
    assert (out / "index.html").read_text() == page
    assert "Everything is simulated in MuJoCo MJX" in page and "Robot: " not in page
    manifest = RunFolder(out).read_manifest()
    manifest["parameters"]["robot"] = dataclasses.asdict(pj.robot_named("racer-net"))
    RunFolder(out).write_manifest(manifest)
    assert main(["report", str(out)]) == 0
    capsys.readouterr()
    for name in ("index.html", "table.md"):
        assert "Robot: racer-net" in (out / name).read_text()
    shutil.rmtree(out / "flights")
    assert main(["report", str(out)]) == 2
    assert "RUN must be finished, with its flights" in capsys.readouterr().err


DROP = Task(
    name="drop",
    summary="a quadrotor holds a falling ball",
    home="tests.test_sims_run",
    planners={"exact": "hover"},
    suites={},
    flight="tests.test_sims_run:DropFly",
)


@dataclasses.dataclass(frozen=True)
class DropFly(BallFly):
    TASK, FLIGHT, RATE = DROP, "tests.test_sims_run:DropFlight", 0.0


@struct.dataclass
class HoverPlan:
    trajectory: pj.PiecewisePolynomial
    status: np.ndarray
    iterations: np.ndarray


@dataclasses.dataclass(frozen=True)
class DropPilot:
    passage = staticmethod(passage)

    def times(self, plan):
        return jnp.full(1, 0.45)


@dataclasses.dataclass(frozen=True)
class RisingPilot(DropPilot):
    num: int = 2

    def plan_shapes(self, cases):
        of = lambda *sizes: jax.ShapeDtypeStruct((self.num, *sizes), jnp.float32)  # noqa: E731
        path, one = of(1, 8, 3), of(1)
        codes = jax.ShapeDtypeStruct((self.num,), jnp.int32)
        return HoverPlan(pj.PiecewisePolynomial(path, one), codes, codes)

    def pose_problem(self, case, plan, outlook):
        return plan

    @property
    def searches(self):
        higher = lambda path: path.at[0, 0, 2].add(1e-3)  # noqa: E731
        raised = lambda plan: jax.tree.map(lambda x: higher(x) if x.ndim == 3 else x, plan)  # noqa: E731
        return (lambda plan: plan, raised)

    def choose(self, asked, outlook, found):
        return found[1], outlook.time < 0.09


class DropFlights(Flights):
    @property
    def success(self):
        return np.all(self.flown.contact.met, axis=1)


class DropFlight(BallFlightTask):
    CONTACT, SUCCESS, PUBLISHED, COLUMNS = "caught", "held the ball", "nothing", ()
    suite = "a fall of 1 m"

    def world(self):
        return CATCH_WORLD

    def cases(self):
        return FlightCases(np.arange(self.settings.num))

    def fly(self, cases, record):
        state, records, plan = self.leg(self.loop(record), cases, DropPilot(), 60)
        return DropFlights(plan, collect_flights(state, records), 0.0)

    def leg(self, loop, cases, pilot, periods):
        num = len(cases)
        place, drag = jnp.tile(jnp.array([0.0, 0.0, 1.0]), (num, 1)), jnp.full((num, 1), 0.06)
        path = jnp.zeros((num, 1, 8, 3)).at[:, 0, 0].set(place)
        codes = np.zeros(num, int)
        plan = HoverPlan(pj.PiecewisePolynomial(path, jnp.ones((num, 1))), codes, codes)
        state = ready(loop, place, flight_keys(self.settings.seed, cases.index))
        balls = self.launches(cases, None).balls
        state = launch_ball(loop, state, balls, drag, drag, ball=0, seen=0.1)
        state = state.replace(plan=plan, began=state.time, present=state.launched)
        return *fly_leg(loop, pilot, state, None, drag, num_periods=periods), plan

    def launches(self, cases, flown):
        at = np.tile(np.float32([0.0, 0.0, 2.2]), (len(cases), 1, 1))
        return Launches(pj.BallState(at, 0.0 * at), np.full(at.shape[:2], 0.06), np.zeros(1), 0.1)


def test_a_missing_package_of_mjx_is_named_with_its_extra():
    code = "import sys; sys.modules['trimesh'] = None; import planner_jax.sims.model"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "MissingExtra: a flight needs trimesh: pip install" in done.stderr


def test_a_task_without_flights_is_refused_in_one_line(monkeypatch):
    monkeypatch.setitem(all_tasks(), "drop", dataclasses.replace(DROP, flight=None))
    with pytest.raises(pj.ArgumentError) as error:
        fly_settings("drop")
    rule = "task must be one that can be flown (hit, rally, catch, team, intercept, block)"
    assert str(error.value) == f"{rule}, got 'drop'"


@pytest.mark.slow
def test_the_parts_of_a_period_give_the_same_flights_as_one_program(monkeypatch):
    flight = DropFly(num=2, noise="none").flight()
    loop = dataclasses.replace(flight.loop(True), replan=50.0)
    flights = []
    for in_parts in (False, True):
        monkeypatch.setattr(sims_loop, "in_parts", lambda _, parts=in_parts: parts)
        state, records, _ = flight.leg(loop, flight.cases(), RisingPilot(), 8)
        flights.append(dataclasses.asdict(collect_flights(state, records)))
    whole, parts = flights
    assert whole["plan"]["trajectory"]["coeffs"][0, 0, 0, 2] == pytest.approx(1.004, abs=1e-6)
    assert whole["record"]["time"].shape == (2, 8 * loop.observations_per_plan)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5), whole, parts)


@pytest.mark.slow
def test_a_leg_compiled_ahead_is_not_compiled_again(monkeypatch, caplog):
    monkeypatch.setattr(sims_loop, "in_parts", lambda _: True)
    flight = DropFly(num=3, noise="none").flight()
    loop = dataclasses.replace(flight.loop(False), replan=50.0)
    pilot, drag = RisingPilot(3), jnp.zeros((3, 1))
    start = ready(loop, jnp.zeros((3, 3)), flight_keys(0, flight.cases().index))
    jax.config.update("jax_log_compiles", True)  # in every thread
    try:
        begin_compiling(loop, pilot, start, None, drag)()
        ahead = list_compiled_parts(caplog)
        plan = jax.tree.map(lambda leaf: jnp.ones(leaf.shape, leaf.dtype), pilot.plan_shapes(None))
        fly_leg(loop, pilot, start.replace(plan=plan), None, drag, num_periods=3)
    finally:
        jax.config.update("jax_log_compiles", False)
    assert ahead == ["_fly", "_pose_problems", "_search_plans", "_search_plans", "_with_plans"]
    assert list_compiled_parts(caplog) == ahead


def list_compiled_parts(caplog):
    found = re.findall(r"Finished XLA compilation of jit\((_\w+)\)", caplog.text)
    return sorted(name for name in found if hasattr(sims_loop, name))


@pytest.mark.slow
def test_a_third_task_is_flown_into_a_run_folder_without_an_edit(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(all_tasks(), "drop", DROP)
    manifest = start_flights(DropFly(num=2, noise="none"), tmp_path / "run")
    assert manifest["kind"] == "fly drop"
    assert (manifest["summary"]["success_rate"], manifest["summary"]["num"]) == (1.0, 2)
    assert main(["report", str(tmp_path / "run")]) == 0
    assert "100.00 % of 2 flights held the ball" in capsys.readouterr().out
    assert "a fall of 1 m" in (tmp_path / "run" / "index.html").read_text()
