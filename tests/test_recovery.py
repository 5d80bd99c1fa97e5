"""What is flown behind the last contact: to rest, within all limits, and judged like the rest."""

import dataclasses

import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.errors import ArgumentError
from planner_jax.recovery.case import RecoveryCase, end_state
from planner_jax.recovery.planner import RecoveryPlanner
from planner_jax.robot.quadrotor import QuadrotorLimits
from planner_jax.runs.run_folder import RunFolder
from planner_jax.sweep import run
from planner_jax.sweep.catch.settings import CatchSettings
from planner_jax.sweep.hit.settings import HitSettings
from planner_jax.sweep.hit.sweep import HitSweep
from planner_jax.sweep.quadrotor import recovery_remark
from planner_jax.sweep.rows import planned_row
from planner_jax.sweep.single import sampled
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, total_duration

NUM = 8


@pytest.fixture(scope="module")
def hits():
    return jax.tree.map(np.asarray, pj.hit.draw(NUM, seed=4))


@pytest.fixture(scope="module")
def braked(hits):
    return pj.plan(pj.hit.planner("exact", recovery="brake"), hits)


def states(path, time=None):
    """Position to jerk (4, 3) of one trajectory at a time, or at its end."""
    time = total_duration(path) if time is None else time
    return np.stack([evaluate(path, time, order) for order in range(4)])


def test_a_hit_comes_to_rest_where_its_trajectory_left_off(hits, braked):
    assert pj.solved(braked).all()
    assert pj.hit.judge(hits, braked).success.all()
    for k in range(NUM):
        plan = pj.take(braked, k)
        np.testing.assert_allclose(
            states(plan.recovery, 0.0), np.asarray(end_state(plan.trajectory)), atol=5e-3
        )
        np.testing.assert_allclose(states(plan.recovery)[1:], 0.0, atol=2e-2)


def test_the_contact_is_where_it_was_without_a_recovery(hits, braked):
    plain = pj.plan(pj.hit.planner("exact"), hits)
    np.testing.assert_allclose(braked.stroke.time, plain.stroke.time, rtol=1e-6)
    np.testing.assert_array_equal(braked.trajectory.durations, plain.trajectory.durations)


def test_setpoints_go_on_until_the_quadrotor_rests(braked):
    plan = pj.take(braked, 0)
    setpoints = plan.sample(100.0)
    assert setpoints.time[-1] > plan.stroke.time + 0.2
    np.testing.assert_allclose(setpoints.vel[-1], 0.0, atol=0.1)


def test_a_plan_with_a_recovery_is_saved_and_read(tmp_path, braked):
    braked.save(tmp_path / "plans.npz")
    read = pj.hit.HitPlan.load(tmp_path / "plans.npz")
    jax.tree.map(np.testing.assert_array_equal, read, braked)


def test_a_recovery_that_does_not_rest_fails_by_name(hits, braked):
    path = braked.recovery
    moving = PiecewisePolynomial(coeffs=path.coeffs, durations=path.durations.copy())
    moving.durations[:, -1] *= 0.5
    verdict = pj.hit.judge(hits, dataclasses.replace(braked, recovery=moving))
    assert (verdict.failed_limit == "recovery").all()
    assert "way to rest" in verdict.sentence(0)


def test_limits_hold_behind_the_contact_too(hits, braked):
    least = 0.5 * pj.hit.judge(hits, braked).max_speed.astype(np.float32)
    slow = dataclasses.replace(hits, limits=dataclasses.replace(hits.limits, speed=least))
    still = jax.tree.map(np.array, braked)
    still.trajectory.coeffs[:, :, 1:] = 0.0  # it hovers, and the recovery alone moves
    verdict = pj.hit.judge(slow, still)
    ends = still.trajectory.durations.sum(axis=1)
    assert (verdict.max_speed > least).any()
    assert set(verdict.failed_limit) <= {"continuity", "head state", "speed"}, ends


@pytest.mark.parametrize("to", ["brake", "home"])
def test_from_a_fast_flight_it_comes_to_rest_where_it_should(to):
    head = np.zeros((NUM, 4, 3), np.float32)
    head[:, 0, 2] = 1.5
    head[:, 1] = np.random.default_rng(0).uniform(-2.0, 2.0, (NUM, 3))
    ones = np.ones(NUM, np.float32)
    limits = QuadrotorLimits(
        speed=5 * ones,
        body_rate=5 * ones,
        min_height=0.25 * ones,
        min_thrust=3 * ones,
        max_thrust=24 * ones,
    )
    home = np.tile(np.float32([1.0, 0.0, 1.0]), (NUM, 1))
    case = RecoveryCase(head_state=head, home=home, gravity=9.81 * ones, limits=limits)
    plans = pj.plan(RecoveryPlanner(to=to), case)
    assert pj.solved(plans).all()
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
    np.testing.assert_array_equal(verdict.success, pj.solved(plans))
    assert verdict.success.all(), verdict.failed_limit


# Sweeps.


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """The folder of a sweep with ways to rest, and its manifest; nothing is drawn."""
    out = tmp_path_factory.mktemp("runs") / "braked"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "write_report", lambda folder: None)
        patch.setattr(HitSweep, "other_planners", lambda *_: {})
        settings = HitSettings(num=NUM, seed=4, recovery="brake")
        return out, run.start_sweep(pj.task_named("hit"), settings, out, progress=False)


def test_rows_of_a_sweep_have_the_way_to_rest_that_was_judged(swept, braked):
    out, manifest = swept
    assert manifest["parameters"]["recovery"] == "brake"
    assert manifest["summary"]["successes"] == NUM
    for row in range(NUM):
        found, sentence = planned_row(RunFolder(out), row)
        whole = pj.take(braked, row).whole
        np.testing.assert_allclose(total_duration(found.whole), total_duration(whole), rtol=1e-3)
        np.testing.assert_allclose(states(found.recovery)[1:], 0.0, atol=2e-2)
        assert not sentence
    assert "to rest where that is cheapest" in recovery_remark(manifest["parameters"])[0]
    assert not recovery_remark({}) and not recovery_remark({"recovery": "none"})


def test_a_sweep_is_resumed_with_its_recovery_alone(swept):
    out, _ = swept
    with pytest.raises(
        ArgumentError, match="^recovery must be brake as in the run that is resumed"
    ):
        run.resume_sweep(pj.task_named("hit"), out, progress=False, recovery="home")


def test_the_limits_of_one_case_are_looked_at_behind_the_contact_too(braked):
    plan = pj.take(braked, 0)
    assert sampled(plan).time[-1] > plan.stroke.time + 0.2


@pytest.mark.parametrize("settings", [HitSettings, CatchSettings])
def test_settings_refuse_another_recovery_and_leave_none_to_the_planner(settings):
    with pytest.raises(
        ArgumentError, match="^recovery must be one of none, brake, home, got 'land'"
    ):
        settings(recovery="land")
    assert "recovery" not in settings().planner_options()
    assert settings(recovery="home").planner_options()["recovery"] == "home"


def test_another_recovery_is_refused_in_one_line():
    with pytest.raises(ValueError, match="^recovery must be one of brake, home, got 'land'$"):
        pj.hit.planner("exact", recovery="land")
    with pytest.raises(ValueError, match="^to must be one of brake, home, got 'land'$"):
        RecoveryPlanner(to="land")
