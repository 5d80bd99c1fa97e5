"""Recoveries: trajectories from the last contact to standstill, of quadrotors, cars and arms."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flown_plans import SOLVED, quadrotor, table

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.cli.plan.answer import sample_plan
from planner_jax.core.errors import ArgumentError, NoRecovery
from planner_jax.recovery.after_plan import append_recovery, is_rested
from planner_jax.recovery.case import RecoveryCase, end_state
from planner_jax.referee import recovery
from planner_jax.referee.block import referee_blocks
from planner_jax.referee.intercept import referee_intercepts
from planner_jax.robot import quadrotor_model
from planner_jax.robot.arm import ArmPlan
from planner_jax.robot.car import CarPlan
from planner_jax.runs.run_folder import RunFolder
from planner_jax.sweep import run
from planner_jax.sweep.catch.settings import CatchSettings
from planner_jax.sweep.hit.settings import HitSettings
from planner_jax.sweep.hit.sweep import HitSweep
from planner_jax.sweep.quadrotor import recovery_remark
from planner_jax.sweep.rows import read_plan
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, total_duration
from tests.trees import assert_same

NUM = 8


@pytest.fixture(scope="module")
def hits():
    return jax.tree.map(np.asarray, pj.hit.draw(NUM, seed=4))


@pytest.fixture(scope="module")
def hit(hits):
    return pj.take(hits, 0), pj.take(pj.plan(pj.hit.planner(), hits), 0)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def braked(hits):
    return pj.plan(pj.hit.planner("exact", recovery="brake"), hits)


def assert_refused(rule, function, *arguments, **options):
    with pytest.raises(ArgumentError, match=rule):
        function(*arguments, **options)


@jax.jit
def states(path, time=None):
    time = total_duration(path) if time is None else time
    return jnp.stack([evaluate(path, time, order) for order in range(4)])


def test_a_recovery_continues_the_trajectory_to_standstill(hits, braked):
    assert pj.are_solved(braked).all()
    assert pj.hit.judge(hits, braked).success.all()
    for k in range(NUM):
        plan = pj.take(braked, k)
        end = jax.jit(end_state)(plan.trajectory)
        np.testing.assert_allclose(states(plan.recovery, np.float32(0.0)), end, atol=5e-3)
        np.testing.assert_allclose(np.asarray(states(plan.recovery))[1:], 0.0, atol=2e-2)
    # The appended recovery trajectory does not change the plan's contact time.
    plain = pj.plan(pj.hit.planner("exact"), hits)
    np.testing.assert_allclose(braked.stroke.time, plain.stroke.time, rtol=1e-6)
    np.testing.assert_array_equal(braked.trajectory.durations, plain.trajectory.durations)


def test_setpoints_continue_to_standstill_and_a_file_holds_the_recovery(tmp_path, braked):
    plan = pj.take(braked, 0)
    for setpoints in (plan.sample(100.0), sample_plan(plan)):
        assert setpoints.time[-1] > plan.stroke.time + 0.2
        np.testing.assert_allclose(setpoints.vel[-1], 0.0, atol=0.1)
    braked.save(tmp_path / "plans.npz")
    assert_same(pj.hit.HitPlan.load(tmp_path / "plans.npz"), braked)


def test_a_recovery_that_does_not_rest_fails_by_name(hits, braked):
    path = braked.recovery
    moving = PiecewisePolynomial(coeffs=path.coeffs, durations=path.durations.copy())
    moving.durations[:, -1] *= 0.5
    verdict = pj.hit.judge(hits, dataclasses.replace(braked, recovery=moving))
    assert (verdict.failed_limit == "recovery").all()
    assert "does not end at standstill" in verdict.sentence(0)


def test_the_tilt_of_recoveries_is_limited(hits, braked):
    for name in ("RECOVERY_TILT", "MORE_TILT"):
        assert vars(recovery)[name] == vars(quadrotor_model)[name]
    tilt = pj.hit.judge(hits, braked).max_tilt
    strict = hits.limits.replace(recovery_tilt=np.float32(0.2) * tilt.astype(np.float32))
    verdict = pj.hit.judge(dataclasses.replace(hits, limits=strict), braked)
    starts = np.stack([end_state(pj.take(braked.trajectory, k))[2] for k in range(NUM)])
    allowed = np.arctan2(np.hypot(*starts.T[:2]), starts[:, 2] + hits.gravity) + recovery.MORE_TILT
    assert (tilt <= np.maximum(recovery.RECOVERY_TILT, allowed) * 1.001).all()
    np.testing.assert_array_equal(verdict.failed_limit == "tilt", tilt > allowed * 1.001)
    assert (verdict.failed_limit == "tilt").any()


def test_limits_apply_to_the_recovery(hits, braked):
    least = 0.5 * pj.hit.judge(hits, braked).max_speed.astype(np.float32)
    slow = dataclasses.replace(hits, limits=dataclasses.replace(hits.limits, speed=least))
    still = jax.tree.map(np.array, braked)
    still.trajectory.coeffs[:, :, 1:] = 0.0  # the plan hovers, and only the recovery moves
    verdict = pj.hit.judge(slow, still)
    assert (verdict.max_speed > least).any()
    assert set(verdict.failed_limit) <= {"continuity", "head state", "speed"}


@pytest.mark.parametrize("to", ["brake", pytest.param("home", marks=pytest.mark.slow)])
def test_a_fast_flight_ends_at_the_requested_position(to):
    head = np.zeros((NUM, 4, 3), np.float32)
    head[:, 0, 2] = 1.5
    head[:, 1] = np.random.default_rng(0).uniform(-2.0, 2.0, (NUM, 3))
    ones = np.ones(NUM, np.float32)
    limits = jax.tree.map(np.asarray, pj.catch.draw(NUM).limits)
    home = np.tile(np.float32([1.0, 0.0, 1.0]), (NUM, 1))
    case = RecoveryCase(head_state=head, home=home, gravity=9.81 * ones, limits=limits)
    plans = pj.plan(pj.RecoveryProblem.planner(to=to), case)
    assert pj.are_solved(plans).all()
    ends = np.stack([states(pj.take(plans.trajectory, k))[0] for k in range(NUM)])
    if to == "home":
        np.testing.assert_allclose(ends, home, atol=1e-3)
    else:
        assert (ends[:, 2] >= 0.25).all() and not np.allclose(ends, home, atol=0.1)


@pytest.mark.slow
def test_catches_that_end_too_fast_for_the_limits_are_planned_slower():
    cases = jax.tree.map(np.asarray, pj.catch.draw(24, "triangle3", 3))
    plans = pj.plan(pj.catch.planner("exact", decide="greedy", recovery="brake"), cases)
    verdict = pj.catch.judge(cases, plans)
    np.testing.assert_array_equal(verdict.success, pj.are_solved(plans))
    assert verdict.success.all(), verdict.failed_limit


def sweep(out, **settings):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "write_report", lambda folder: None)
        patch.setattr(HitSweep, "other_planners", lambda *_: {})
        settings = HitSettings(num=NUM, seed=4, **settings)
        return out, run.start_sweep(pj.task_named("hit"), settings, out, progress=False)


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    return sweep(tmp_path_factory.mktemp("runs") / "braked", recovery="brake")


def test_rows_of_a_sweep_have_the_judged_recovery(swept, braked):
    out, manifest = swept
    assert manifest["parameters"]["recovery"] == "brake"
    assert manifest["summary"]["successes"] == NUM
    for row in range(NUM):
        found, sentence = read_plan(RunFolder(out), row)
        whole = pj.take(braked, row).whole
        np.testing.assert_allclose(total_duration(found.whole), total_duration(whole), rtol=1e-3)
        np.testing.assert_allclose(states(found.recovery)[1:], 0.0, atol=2e-2)
        assert not sentence
    assert "standstill at the cheapest place" in recovery_remark(manifest["parameters"])[0]
    assert not recovery_remark({}) and not recovery_remark({"recovery": "none"})


def test_another_recovery_is_refused_in_one_line_and_settings_leave_none_to_the_planner():
    rule = "must be one of brake, home, got 'land'$"
    assert_refused(f"^recovery {rule}", pj.hit.planner, "exact", recovery="land")
    assert_refused(f"^to {rule}", pj.RecoveryProblem, to="land")
    for settings in (HitSettings, CatchSettings):
        assert "recovery" not in settings().planner_options()
        assert settings(recovery="home").planner_options()["recovery"] == "home"


export = functools.partial(pj.export, to="csv", out="a.csv")


def test_an_exported_plan_has_a_recovery(hit, here):
    case, plan = hit
    _, bare = table(pj.export(plan, to="csv", out="bare.csv", recovery=None))
    _, rows = table(pj.export(plan, to="csv", out="whole.csv", case=case))
    np.testing.assert_allclose(rows[: len(bare) - 1], bare[:-1], atol=1e-6)
    speeds = np.linalg.norm(rows[:, 4:7], axis=1)
    assert speeds[len(bare) - 2] > 0.5 and speeds[-1] == 0.0
    _, home = table(pj.export(plan, to="csv", out="home.csv", case=case, recovery="home"))
    np.testing.assert_allclose(home[-1, 1:4], case.head_state[0], atol=1e-3)


def test_a_plan_is_exported_with_its_own_recovery_or_without_one(hit, here):
    case, plan = hit
    ended = append_recovery(case, plan, "brake")
    assert not is_rested(plan) and is_rested(ended)
    _, rows = table(pj.export(ended, to="csv", out="own.csv"))
    assert rows[-1, 0] == pytest.approx(float(np.sum(ended.whole.durations)), abs=0.011)
    _, bare = table(pj.export(ended, to="csv", out="bare.csv", recovery=None))
    assert bare[-1, 0] <= float(np.sum(plan.trajectory.durations))


def test_an_export_without_a_fitting_case_or_recovery_is_refused_and_writes_nothing(hit, here):
    case, plan = hit
    (drive_case, drive), many = driving(), jax.tree.map(lambda leaf: leaf[None], case)
    homewards = {"case": drive_case, "recovery": "home"}
    for rule, given, options in (
        ("case must be given, .* or recovery=None to omit it, got neither", plan, {}),
        ("recovery must be one of brake, home, got 'land'", plan, {"recovery": "land"}),
        ("case must be the case of a quadrotor, got InterceptCase", plan, {"case": drive_case}),
        (r"case must be one, .* got a batch of shape \(1,\)", plan, {"case": many}),
        ("recovery must be brake, as only quadrotors go home, got .*", drive, homewards),
    ):
        assert_refused(f"^{rule}$", export, given, **options)
    assert not list(here.iterdir())


def test_nothing_is_written_if_no_recovery_keeps_the_limits(hit, here, monkeypatch):
    case, plan = hit
    monkeypatch.setattr(pj.RecoveryProblem, "attempts", pj.RecoveryProblem.attempts[:1])
    slow = dataclasses.replace(case.limits, speed=np.float32(0.1))
    says = "^recovery must be none .* keeps every limit, got 'brake' .speed: .* above its limit"
    assert_refused(says, export, plan, case=dataclasses.replace(case, limits=slow))
    assert not list(here.iterdir())


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    return sweep(tmp_path_factory.mktemp("runs") / "bare")[0]


def test_the_command_reports_the_recovery_of_a_row(bare, here, capsys):
    assert main(["export", str(bare), "--row", "1", "--to", "csv", "--out", "a.csv"]) == 0
    out, err = capsys.readouterr()
    says = "row 1 is extended by a recovery trajectory (brake) within its case's limits"
    assert out == "a.csv\n" and err.startswith(f"planner-jax: {says}") and err.count("\n") == 1
    assert not table(here / "a.csv")[1][-1, 4:13].any()
    options = ["--row", "1", "--to", "csv", "--out", "b.csv", "--recovery", "none"]
    assert main(["export", str(bare), *options]) == 0
    assert capsys.readouterr() == ("b.csv\n", "")
    assert np.linalg.norm(table(here / "b.csv")[1][-1, 4:7]) > 0.5


def test_a_file_of_plans_does_not_hold_their_limits(here, capsys):
    quadrotor().save("one.npz")
    for options, says in (
        ([], "none for plans of a file that do not come to rest,"),
        (["--recovery", "land"], "one of none, brake, home, got 'land'\n"),
    ):
        assert main(["export", "one.npz", "--to", "csv", *options]) == 2
        assert capsys.readouterr().err.startswith(f"planner-jax: error: --recovery must be {says}")
    assert {path.name for path in here.iterdir()} == {"one.npz"}


def driving(*walls, **settings):
    target = pj.TurningPath(np.float32([2.0, 4.0]), np.zeros(2, np.float32), np.float32(0.0))
    settings |= {"start": (1.0, 4.0, 0.0), "initial_speed": 1.0, "walls": walls}
    knots = {"speed": np.ones(5, np.float32), "curvature": np.zeros(5, np.float32)}
    knots |= {"time": np.float32(1.0), "origin": np.zeros(2, np.float32)}
    plan = CarPlan(**SOLVED, start=np.float32([1.0, 4.0, 0.0]), **knots)
    return jax.tree.map(np.asarray, pj.intercept.case(target, **settings)), plan


def assert_stops(case, whole):
    case = dataclasses.replace(case, time=whole.time, tolerance=np.inf, heading_tolerance=np.inf)
    cases, plans = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (case, whole))
    verdict = referee_intercepts(cases, plans)
    assert verdict.success[0], verdict.sentence(0)
    assert is_rested(whole) and whole.speed[-1] == 0.0


def box(left, bottom, right, top):
    return np.array([(left, bottom), (right, bottom), (right, top), (left, top)])


def test_a_car_brakes_on_its_path(here):
    case, plan = driving()
    _, rows = table(pj.export(plan, to="csv", out="a.csv", case=case))
    assert not rows[-1, [4, 5, 7]].any() and rows[101, 0] > 1.0
    assert rows[-1, 1] == pytest.approx(2.0 + 0.5 * 5 * 0.25, abs=0.01)
    assert np.abs(rows[:, 5]).max() <= 1.0 and not rows[:, 6].any()
    assert not is_rested(plan)
    assert_stops(case, append_recovery(case, plan, "brake"))


def test_a_car_steers_past_a_wall_or_names_the_wall_that_it_hits():
    beside = box(2.7, 4.06, 3.4, 4.4)  # blocks the straight path, but not a path to the right
    case, plan = driving(beside)
    stands = append_recovery(case, plan, "brake")
    assert stands.curvature[-1] < 0.0
    assert_stops(case, stands)
    np.testing.assert_array_equal(stands.speed[:5], plan.speed)
    case, plan = driving(box(2.4, 3.0, 3.0, 5.0))
    with pytest.raises(NoRecovery, match=r"^wall: the body is .* inside walls\[0\]"):
        append_recovery(case, plan, "brake")


def test_movers_move_during_the_recovery():
    gone = {"movers": [box(2.3, 3.9, 2.5, 4.1)], "mover_velocities": (0.0, 2.0)}
    case, plan = driving(**gone)
    straight = append_recovery(case, plan, "brake")
    assert not straight.curvature.any()
    assert_stops(case, straight)
    comes = {"movers": [box(1.9, 1.0, 3.6, 3.0)], "mover_velocities": (0.0, 1.0)}
    with pytest.raises(NoRecovery, match="^mover: "):
        append_recovery(*driving(**comes), "brake")


def turning(rates, regime="R1"):
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
    case = dataclasses.replace(case, rates=plan.motion.coeffs[0, 1], delay=np.float32(0.0))
    cases, motion = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (case, whole.motion))
    plans = SimpleNamespace(motion=motion, contact_time=motion.durations.sum(axis=1))
    assert referee_blocks(cases, plans).failed_limit[0] in ("ball", "tilt", "tunnel")
    _, rows = table(pj.export(plan, to="csv", out="a.csv", rate=1000.0, case=case))
    assert rows[-1, 0] == pytest.approx(whole.motion.durations.sum(), rel=1e-6)
    assert not rows[-1, 7:].any() and np.abs(rows[:, 13:]).max() <= 60.0


def test_an_arm_at_rest_is_exported_unchanged_and_one_that_cannot_brake_is_refused(here):
    _, plan = turning(np.zeros(6))
    assert is_rested(plan)
    pj.export(plan, to="csv", out="a.csv")
    case, plan = turning([0.0, 0.0, 0.0, 0.0, 0.0, 7.0])
    near = dataclasses.replace(case.arm, upper=case.angles + np.float32(0.75))
    with pytest.raises(NoRecovery, match="^position: joint 6 is .* rad beyond its limit"):
        append_recovery(dataclasses.replace(case, arm=near), plan, "brake")
