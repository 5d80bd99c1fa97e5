"""Plans come to rest as they leave for a controller: quadrotors, cars and arms, by their case."""

import dataclasses

import jax
import numpy as np
import pytest
from flown_plans import SOLVED, quadrotor, table
from rest_referee import referee_rests, referee_stands, referee_stops

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.core.errors import ArgumentError, NoRecovery
from planner_jax.plane.target import TurningPath
from planner_jax.recovery.after_plan import append_recovery, is_rested
from planner_jax.robot.arm import ArmPlan
from planner_jax.robot.car import CarPlan
from planner_jax.sweep import run
from planner_jax.sweep.hit.settings import HitSettings
from planner_jax.sweep.hit.sweep import HitSweep
from planner_jax.trajectory.polynomial import PiecewisePolynomial

NUM = 4


@pytest.fixture(scope="module")
def hit():
    """A hit and its plan, which ends at the contact."""
    cases = jax.tree.map(np.asarray, pj.hit.draw(1, seed=4))
    return pj.take(cases, 0), pj.take(pj.plan(pj.hit.planner(), cases), 0)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


# Quadrotors.


def test_a_plan_leaves_with_a_way_to_rest_behind_what_it_was(hit, here):
    case, plan = hit
    _, bare = table(pj.export(plan, to="csv", out="bare.csv", recovery=None))
    _, rows = table(pj.export(plan, to="csv", out="whole.csv", case=case))
    np.testing.assert_allclose(rows[: len(bare)], bare, atol=1e-6)
    speeds = np.linalg.norm(rows[:, 4:7], axis=1)
    assert speeds[len(bare) - 1] > 0.5 and speeds[-1] < 0.1
    _, home = table(pj.export(plan, to="csv", out="home.csv", case=case, recovery="home"))
    np.testing.assert_allclose(home[-1, 1:4], case.head_state[0], atol=0.1)


def test_a_plan_that_has_its_own_keeps_it_or_leaves_without_it(hit, here):
    case, plan = hit
    ended = append_recovery(case, plan, "brake")
    assert not is_rested(plan) and is_rested(ended)
    _, rows = table(pj.export(ended, to="csv", out="own.csv"))
    assert rows[-1, 0] == pytest.approx(float(np.sum(ended.whole.durations)), abs=0.011)
    _, bare = table(pj.export(ended, to="csv", out="bare.csv", recovery=None))
    assert bare[-1, 0] <= float(np.sum(plan.trajectory.durations))


def test_without_its_case_a_plan_is_refused_in_one_line(here):
    says = "^case must be given, .* or recovery=None to leave that out, got neither$"
    with pytest.raises(ArgumentError, match=says):
        pj.export(quadrotor(), to="csv", out="a.csv")
    with pytest.raises(ArgumentError, match="^recovery must be one of brake, home, got 'land'$"):
        pj.export(quadrotor(), to="csv", out="a.csv", recovery="land")
    assert not list(here.iterdir())


def test_the_case_of_another_plan_and_a_batch_of_cases_are_refused(hit, here):
    case, plan = hit
    with pytest.raises(ArgumentError, match="^case must be that of the plan, got InterceptCase$"):
        pj.export(plan, to="csv", out="a.csv", case=driving()[0])
    many = jax.tree.map(lambda leaf: leaf[None], case)
    with pytest.raises(ArgumentError, match=r"^case must be one, .* got a batch of shape \(1,\)$"):
        pj.export(plan, to="csv", out="a.csv", case=many)


def test_where_no_way_to_rest_keeps_the_limits_nothing_is_written(hit, here):
    case, plan = hit
    slow = dataclasses.replace(case.limits, speed=np.float32(0.1))
    says = "^recovery must be none .* keeps every limit, got 'brake' .speed: .* above its limit"
    with pytest.raises(ArgumentError, match=says):
        pj.export(plan, to="csv", out="a.csv", case=dataclasses.replace(case, limits=slow))
    assert not list(here.iterdir())


def test_the_referee_wants_a_way_that_goes_on_and_rests(hit):
    case, plan = hit
    ended = append_recovery(case, plan, "brake")
    batch = lambda tree: jax.tree.map(lambda leaf: np.array(leaf)[None], tree)  # noqa: E731
    assert referee_rests(batch(case), batch(ended)).success.all()
    for name, change in {
        "head state": lambda path: path.coeffs.__setitem__((0, 0, 0), path.coeffs[0, 0, 0] + 0.1),
        "recovery": lambda path: path.durations.__setitem__((0, -1), 0.5 * path.durations[0, -1]),
    }.items():
        other = batch(ended)
        change(other.recovery)
        assert referee_rests(batch(case), other).failed_limit[0] == name


# Rows of a sweep.


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "bare"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "write_report", lambda folder: None)
        patch.setattr(HitSweep, "other_planners", lambda *_: {})
        settings = HitSettings(num=NUM, seed=4)
        run.start_sweep(pj.task_named("hit"), settings, out, progress=False)
    return out


def test_the_command_says_that_a_row_goes_on_to_rest(swept, here, capsys):
    assert main(["export", str(swept), "--row", "1", "--to", "csv", "--out", "a.csv"]) == 0
    out, err = capsys.readouterr()
    told = "planner-jax: row 1 goes on to rest behind its end (brake), within the limits of its"
    assert out == "a.csv\n" and err.startswith(told) and err.count("\n") == 1
    assert np.linalg.norm(table(here / "a.csv")[1][-1, 4:7]) < 0.1
    bare = ["--row", "1", "--to", "csv", "--out", "b.csv", "--recovery", "none"]
    assert main(["export", str(swept), *bare]) == 0
    assert capsys.readouterr() == ("b.csv\n", "")
    assert np.linalg.norm(table(here / "b.csv")[1][-1, 4:7]) > 0.5


def test_a_file_of_plans_does_not_hold_their_limits(here, capsys):
    quadrotor().save("one.npz")
    assert main(["export", "one.npz", "--to", "csv"]) == 2
    says = (
        "planner-jax: error: --recovery must be none for plans of a file that do not come to rest,"
    )
    assert capsys.readouterr().err.startswith(says)
    assert main(["export", "one.npz", "--to", "csv", "--recovery", "land"]) == 2
    says = "planner-jax: error: --recovery must be one of none, brake, home, got 'land'\n"
    assert capsys.readouterr().err == says
    assert {path.name for path in here.iterdir()} == {"one.npz"}


# Cars.


def driving(*walls, **settings):
    """A car that drives straight on at 1 m/s for a second, from (1, 4), and its case."""
    target = TurningPath(np.float32([2.0, 4.0]), np.zeros(2, np.float32), np.float32(0.0))
    case = pj.intercept.case(target, start=(1.0, 4.0, 0.0), walls=walls, **settings)
    plan = CarPlan(
        **SOLVED,
        start=np.float32([1.0, 4.0, 0.0]),
        time=np.float32(1.0),
        speed=np.ones(5, np.float32),
        curvature=np.zeros(5, np.float32),
    )
    return jax.tree.map(np.asarray, case), plan


def box(left, bottom, right, top):
    return np.array([(left, bottom), (right, bottom), (right, top), (left, top)])


def test_a_car_brakes_to_a_stand_on_its_way(here):
    case, plan = driving()
    _, rows = table(pj.export(plan, to="csv", out="a.csv", case=case))
    assert rows[-1, 4] < 0.02 and rows[101, 0] > 1.0
    # v^2 / 2 a behind the meeting, in so many steps as long as the plan's, of 0.25 s.
    assert rows[-1, 1] == pytest.approx(2.0 + 0.5 * 5 * 0.25, abs=0.01)
    assert np.abs(rows[:, 5]).max() <= 1.0 and not rows[:, 6].any()
    stands = append_recovery(case, plan, "brake")
    assert is_rested(stands) and not is_rested(plan)


def test_a_car_steers_past_what_stands_in_its_way_and_says_where_it_cannot():
    beside = box(2.7, 4.06, 3.4, 4.4)  # in the straight way, not in one to the right
    case, plan = driving(beside)
    stands = append_recovery(case, plan, "brake")
    assert stands.curvature[-1] < 0.0
    np.testing.assert_array_equal(stands.speed[:5], plan.speed)
    case, plan = driving(box(2.4, 3.0, 3.0, 5.0))
    with pytest.raises(NoRecovery, match=r"^wall: the body is .* inside walls\[0\]"):
        append_recovery(case, plan, "brake")


def test_only_quadrotors_go_home(here):
    case, plan = driving()
    with pytest.raises(
        ArgumentError, match="^recovery must be brake, as only quadrotors go home, got"
    ):
        pj.export(plan, to="csv", out="a.csv", case=case, recovery="home")
    assert not list(here.iterdir())


def test_movers_are_where_they_are_behind_the_meeting():
    """One that is in the car's way now is gone by then; one that comes is there."""
    gone = {"movers": [box(2.3, 3.9, 2.5, 4.1)], "mover_velocities": (0.0, 2.0)}
    case, plan = driving(**gone)
    assert not append_recovery(case, plan, "brake").curvature.any()
    comes = {"movers": [box(1.9, 1.0, 3.6, 3.0)], "mover_velocities": (0.0, 1.0)}
    with pytest.raises(NoRecovery, match="^mover: "):
        append_recovery(*driving(**comes), "brake")


def test_a_car_that_does_not_stand_in_the_end_is_told():
    case, plan = driving()
    later = dataclasses.replace(plan, speed=np.float32([1.0, 0.75, 0.5, 0.25, 0.2]))
    assert referee_stops(case, plan, later).startswith("stand: the car drives at 0.2 m/s")


# Arms.


def turning(rates, regime="R1"):
    """An arm whose joints have turned at these rates [rad/s] for 0.1 s, and its case."""
    case = pj.block.case((3.0, 0.0, 2.0), (-6.0, 0.0, 2.0), regime=regime)
    case = jax.tree.map(np.asarray, case)
    coeffs = np.stack([case.angles, np.asarray(rates, np.float32)])[None]
    motion = PiecewisePolynomial(coeffs=coeffs, durations=np.float32([0.1]))
    return case, ArmPlan(**SOLVED, motion=motion)


def test_an_arm_brakes_with_all_joints_at_once(here):
    rates = np.array([1.0, -0.5, 0.25, 2.0, 0.0, -3.0])
    case, plan = turning(rates)
    whole = append_recovery(case, plan, "brake")
    assert is_rested(whole) and not is_rested(plan)
    assert whole.motion.durations[-1] == pytest.approx(3.0 / (0.98 * 60.0), rel=1e-4)
    np.testing.assert_allclose(whole.motion.coeffs[0, :2], plan.motion.coeffs[0])
    _, rows = table(pj.export(plan, to="csv", out="a.csv", rate=1000.0, case=case))
    assert np.abs(rows[-1, 7:13]).max() < 0.1 and np.abs(rows[:, 13:]).max() <= 60.0


def test_an_arm_that_rests_leaves_as_it_is_and_one_that_cannot_says_why(here):
    _, plan = turning(np.zeros(6))
    assert is_rested(plan)
    pj.export(plan, to="csv", out="a.csv")
    case, plan = turning([0.0, 0.0, 0.0, 0.0, 0.0, 7.0])
    near = dataclasses.replace(case.arm, upper=case.angles + np.float32(0.75))
    with pytest.raises(NoRecovery, match="^position: joint 6 is .* rad beyond its limit"):
        append_recovery(dataclasses.replace(case, arm=near), plan, "brake")
    assert referee_stands(case, plan, plan).startswith("start: joint 6 starts")
