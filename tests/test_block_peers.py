"""Tests of published planners of blocks: bang-bang motions, torques, and accepted plans."""

import dataclasses
import re
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import planner_jax as pj
from planner_jax.baselines.block.b_spline import hodograph
from planner_jax.baselines.block.epase import State
from planner_jax.baselines.block.free_space import FreeSpace
from planner_jax.baselines.block.insat import InsatBlock
from planner_jax.baselines.block.library.insat_pairs import find_steps
from planner_jax.baselines.block.path_timing import PIECES, time_path
from planner_jax.baselines.block.pose_by_pose import Goal
from planner_jax.baselines.parts.bang_bang import bang_bang
from planner_jax.benchmarks.block_peers import motion_torques
from planner_jax.core.missing_extra import MissingExtra, install_line
from planner_jax.robot.arm import REGIMES
from planner_jax.robot.arm_dynamics import inverse_dynamics
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_motion import least_times, polynomial
from planner_jax.sweep.block.settings import BlockSettings
from planner_jax.sweep.block.sweep import BlockSweep
from planner_jax.task.block.spec import TASK
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate
from tests.trees import assert_same

LIMITS = REGIMES["R2"].limits
# Planner options for scenes without a pole: 6 control points, and up to 20 s of search a throw.
QUICK = {"points": 6, "budget": 20.0, "longest": 20.0}


def require_peers(*packages):
    for package in packages:
        pytest.importorskip(package, reason="the extra `arm-peers` is not installed")


@jax.jit
def quickest(turn, rate, stretch):
    times = least_times(turn, rate, LIMITS.velocity, LIMITS.acceleration, True)[0]
    duration = stretch * jnp.max(times)
    motion = bang_bang(jnp.zeros(6), rate, turn, duration, jnp.asarray(LIMITS.acceleration))
    at = jax.vmap(lambda time: jnp.stack([evaluate(motion, time, k) for k in range(3)]))
    return at(jnp.linspace(0.0, 1.0, 400) * duration), times


def test_joints_from_rest_take_the_times_of_closed_forms(float64):
    v, a = LIMITS.velocity.astype(float), LIMITS.acceleration.astype(float)
    turn = np.array([0.1, -0.2, 0.0, 1.5, -2.5, 4.0])
    times = quickest(turn, np.zeros(6), 1.0)[1]
    far = np.abs(turn) / v + v / a
    expected = np.where(np.abs(turn) > v**2 / a, far, 2.0 * np.sqrt(np.abs(turn) / a))
    np.testing.assert_allclose(times, expected, rtol=1e-12)
    assert (np.abs(turn) > v**2 / a).any()


@pytest.mark.parametrize("stretch", [1.0, 1.3, 3.0])
def test_joints_arrive_together_at_rest_within_their_limits(stretch, float64):
    """Start joints at rest, towards the goal, away from it, or too fast to stop before it."""
    rng = np.random.default_rng(0)
    for scale in (0.0, 1.0):
        turn = rng.uniform(-1.5, 1.5, 6) * np.array([1, 1, 1, 1, 0.01, 0.0])
        rate = scale * rng.uniform(-1.0, 1.0, 6) * LIMITS.velocity
        angles, rates, accelerations = np.moveaxis(quickest(turn, rate, stretch)[0], 1, 0)
        np.testing.assert_allclose(angles[0], 0.0, atol=1e-12)
        np.testing.assert_allclose(rates[0], rate, atol=1e-12)
        np.testing.assert_allclose(angles[-1], turn, atol=1e-9)
        np.testing.assert_allclose(rates[-1], 0.0, atol=1e-9)
        assert (np.abs(rates) <= LIMITS.velocity + 1e-6).all()
        assert (np.abs(accelerations) <= LIMITS.acceleration + 1e-6).all()
        steps = np.diff(angles, axis=0)
        assert np.abs(steps).max() < 0.2  # Pieces join without a jump.


@jax.jit
def torques(arm, motion, gravity):
    return motion_torques(arm, motion, gravity, samples=64)


def test_an_arm_at_rest_exerts_the_torque_of_gravity(float64):
    arm: Any = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), irb1600())
    still = PiecewisePolynomial(coeffs=arm.home[None, None], durations=jnp.array([0.7]))
    found = torques(arm, still, 9.81)
    expected = np.abs(inverse_dynamics(arm, arm.home, jnp.zeros(6), jnp.zeros(6)))
    np.testing.assert_allclose(found.rms, expected, atol=1e-9)
    np.testing.assert_allclose(found.peak, expected, atol=1e-9)
    np.testing.assert_allclose(torques(arm, still, 0.0).peak, 0.0, atol=1e-9)


def test_constant_acceleration_takes_the_torque_of_inertia(float64):
    """Accelerate joint 1 in the first half and brake it in the second, without gravity."""
    arm: Any = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), irb1600())
    acceleration, half = 3.0, 0.2
    rows = np.zeros((2, 3, 6))
    rows[:, 0] = arm.home
    rows[0, 2, 0], rows[1, 2, 0] = 0.5 * acceleration, -0.5 * acceleration
    rows[1, 0, 0] += 0.5 * acceleration * half**2
    rows[1, 1, 0] = acceleration * half
    motion = PiecewisePolynomial(jnp.asarray(rows), jnp.full(2, half))
    one = jnp.zeros(6).at[0].set(1.0)
    inertia = inverse_dynamics(arm, arm.home, jnp.zeros(6), one, 0.0)[0]
    found = torques(arm, motion, 0.0)
    assert found.rms[0] == pytest.approx(acceleration * inertia)
    assert found.peak[0] == pytest.approx(acceleration * inertia)


def test_direct_is_confirmed_by_the_referee_and_reports_each_failure():
    cases = jax.tree.map(np.array, pj.block.draw(6, "open", seed=8))
    cases.ball.vel[1, 0] *= -1.0  # flies away
    cases.ball.pos[2] = np.nan
    cases.rates[3] = (0.3, -0.2, 0.1, 0.2, -0.4, 0.5)
    planner = pj.block.planner("direct", points=6)
    plans = jax.device_get(pj.plan(planner, jax.tree.map(jnp.asarray, cases)))
    verdict = pj.block.judge(cases, plans)
    assert list(plans.status[[1, 2]]) == [pj.Status.OUT_OF_REACH, pj.Status.BAD_INPUT]
    np.testing.assert_array_equal(verdict.success, pj.are_solved(plans))
    assert pj.are_solved(plans)[[0, 3, 4, 5]].all()
    np.testing.assert_allclose(verdict.execution_time[3:], plans.cost[3:], rtol=1e-5)
    cases.limits.acceleration[:] = 0.5
    late = jax.device_get(pj.plan(planner, jax.tree.map(jnp.asarray, cases)))
    assert (late.status[[0, 3, 4, 5]] == pj.Status.INFEASIBLE).all()


@pytest.mark.slow
def test_edges_are_free_if_all_their_samples_are():
    case = pj.take(jax.tree.map(np.asarray, pj.block.draw(1, seed=8)), 0)
    free = FreeSpace(case, 0.003)
    ends = case.angles + np.random.default_rng(0).uniform(-1.0, 1.0, (30, 6))
    ends[0] = case.angles
    found = free.are_edges_free(case.angles, ends)
    lines = case.angles + np.linspace(0.0, 1.0, 401)[:, None, None] * (ends - case.angles)
    exact = free.is_free(lines.reshape(-1, 6)).reshape(401, 30).all(axis=0)
    assert found[0] and 3 < found.sum() < 27
    assert (found == exact).sum() >= 29  # Edges are sampled only.
    coeffs = np.stack([np.broadcast_to(case.angles, ends.shape), ends - case.angles], axis=1)
    for k in range(30):
        assert free.is_motion_free(coeffs[k : k + 1], np.ones(1)) == found[k]
    assert not free.is_free(case.arm.upper[None] + 0.01).any()


def test_a_straight_path_takes_the_time_of_its_closed_form():
    require_peers("toppra")
    velocity, acceleration = (x.astype(float) for x in (LIMITS.velocity, LIMITS.acceleration))
    for far in (0.1, 1.5):
        points = np.array([np.zeros(6), far * np.array([1.0, -0.5, 0.3, 0.2, 0.1, 1.0])])
        fastest = (velocity / np.abs(points[1])).min()
        hardest = (acceleration / np.abs(points[1])).min()
        ramps = min(fastest**2 / hardest, 1.0)
        expected = 2.0 * np.sqrt(ramps / hardest) + (1.0 - ramps) / fastest
        motion = time_path(points, velocity, acceleration)
        assert motion is not None
        assert motion[1].sum() == pytest.approx(expected, rel=5e-3)


def test_paths_with_corners_are_timed_within_limits():
    require_peers("toppra")
    velocity, acceleration = (x.astype(float) for x in (LIMITS.velocity, LIMITS.acceleration))
    points = np.cumsum(np.random.default_rng(1).normal(0.0, 0.4, (7, 6)), axis=0)
    motion = time_path(points, velocity, acceleration)
    assert motion is not None
    coeffs, durations = motion
    assert len(durations) <= PIECES
    powers = np.arange(coeffs.shape[1])
    ends = (coeffs * durations[:, None, None] ** powers[:, None]).sum(axis=1)
    np.testing.assert_allclose(coeffs[0, 0], points[0], atol=1e-9)
    np.testing.assert_allclose(ends[-1], points[-1], atol=1e-9)
    np.testing.assert_allclose(ends[:-1], coeffs[1:, 0], atol=1e-9)
    for share in np.linspace(0.0, 1.0, 31):
        time = share * durations[:, None]
        rate = sum(k * coeffs[:, k] * time ** (k - 1) for k in range(1, 7))
        rise = sum(k * (k - 1) * coeffs[:, k] * time ** (k - 2) for k in range(2, 7))
        assert (np.abs(rate) <= 1.0005 * velocity).all()
        assert (np.abs(rise) <= 1.0005 * acceleration).all()


def test_planners_on_the_host_report_why_there_is_no_plan():
    cases = jax.tree.map(np.array, pj.block.draw(5, "open", seed=8))
    cases.scene.floor[0] = 0.5  # The floor is above the shield.
    cases.ball.vel[1, 0] *= -1.0  # flies away
    cases.rates[2] = 0.1  # The arm moves already.
    cases.limits.acceleration[3] = 0.5
    cases.ball.pos[4] = np.nan
    plans = pj.plan(pj.block.planner("insat", **QUICK), jax.tree.map(jnp.asarray, cases))
    expected = ("BLOCKED", "OUT_OF_REACH", "INFEASIBLE", "INFEASIBLE", "BAD_INPUT")
    assert [pj.Status(status).name for status in plans.status] == list(expected)
    assert np.isinf(plans.violation).all()
    hurried = pj.block.planner("insat", points=6, budget=1e-9)
    plan = pj.plan(hurried, pj.take(pj.block.draw(5, "open", seed=8), 4))
    assert plan.status == pj.Status.NO_PATH and plan.iterations == 0
    with pytest.raises(ValueError, match="^budget and longest must be > 0, got 0 and 0.05$"):
        pj.block.planner("insat", budget=0.0)


@pytest.mark.parametrize(("name", "package"), [("rrt-connect", "ompl"), ("epase", "toppra")])
def test_without_the_extra_the_error_names_it(name, package, monkeypatch):
    if name == "rrt-connect":
        require_peers("toppra")
    monkeypatch.setitem(sys.modules, package, None)
    how = re.escape(install_line("arm-peers"))
    message = rf"^rrt-connect or epase needs {package}: {how}$"
    with pytest.raises(MissingExtra, match=message):
        pj.block.planner(name)
    others = BlockSweep(TASK).other_planners(BlockSettings(planner="online"))
    assert name not in others and {"direct", "insat"} <= others.keys()


def plan_and_confirm(name, regime, **options):
    """Plan blocks of two throws; return cases, plans and verdicts, which must be successes."""
    cases = jax.tree.map(np.array, pj.block.draw(2, "open", seed=8, regime=regime))
    plans = pj.plan(pj.block.planner(name, **QUICK, **options), cases)
    verdict: Any = pj.block.judge(cases, plans)
    assert verdict.success.all(), verdict.sentence(0)
    assert (plans.status == pj.Status.FEASIBLE).all()
    return cases, plans, verdict


@pytest.mark.slow
@pytest.mark.parametrize("regime", ["R1", "R2"])
@pytest.mark.parametrize("name", ["rrt-connect", "epase"])
def test_timed_paths_are_confirmed_by_the_referee(name, regime):
    require_peers("ompl", "toppra")
    _, plans, verdict = plan_and_confirm(name, regime)
    np.testing.assert_allclose(verdict.execution_time, plans.cost, rtol=1e-5)
    quickest = pj.plan(pj.block.planner("direct", points=6), pj.block.draw(2, "open", seed=8))
    assert regime == "R1" or (plans.cost > 0.99 * quickest.cost).all()


@pytest.mark.parametrize("regime", ["R1", "R2"])
def test_splines_are_confirmed_by_the_referee(regime):
    cases, plans, verdict = plan_and_confirm("insat", regime)
    rests = cases.ends_at_rest
    ends = jnp.sum(plans.motion.durations, axis=1)
    last = jax.jit(jax.vmap(lambda motion, time: evaluate(motion, time, 1)))(plans.motion, ends)
    np.testing.assert_array_equal(np.abs(last).max(axis=1) < 1e-2, rests)
    if not rests.any():
        np.testing.assert_allclose(verdict.execution_time, plans.contact_time, rtol=1e-5)
        assert (plans.cost < 0.9 * verdict.execution_time).all()


def test_the_best_spline_of_one_joint_takes_nearly_the_least_time_of_its_control_points():
    case = pj.take(jax.tree.map(np.array, pj.block.draw(5, "open", seed=8)), 0)
    turn, limit = 0.2, float(case.limits.acceleration[5])
    # At the least time T the turn is as great as accelerations up to limit * T^2 at the control
    # points allow. Two control points at each end are equal, so that the joint rests there.
    bends = np.concatenate([hodograph(3, 2, 7), -hodograph(3, 2, 7)])
    ends = np.eye(7)[[0, 1, 6]] - np.eye(7)[[6, 0, 5]]
    far = linprog(ends[0], bends, np.ones(len(bends)), ends[1:], [0, 0], bounds=(None, None))
    least = np.sqrt(turn / (limit * -far.fun))
    goal = np.array(case.angles) + turn * np.eye(6)[5]
    planner, free = pj.block.planner("insat", **QUICK), FreeSpace(case, 0.0)
    planner.compile(case)

    def spline_within(available):
        end, aim = goal.astype(float), Goal(goal, available)
        first = planner.open_states(case, aim).pop()
        return planner.lifts(case, free, aim, [State(end, np.inf, first[0])], True)

    (found,) = spline_within(1.0)
    ends = found.points[[0, 1, -2, -1]]
    np.testing.assert_allclose(ends, [case.angles] * 2 + [goal] * 2, atol=1e-6)
    assert 0.999 * least <= found.time <= 1.1 * least
    assert found.length == pytest.approx(turn, rel=1e-3)
    assert not spline_within(0.99 * least)


def test_pinsat_of_width_one_is_insat_and_wider_searches_are_confirmed():
    """A pole stands between the arm and some balls, so that searches expand states."""
    cases = jax.tree.map(np.array, pj.block.draw(3, "pole", seed=0, regime="R1"))
    options = {"points": 4, "budget": 4.0, "longest": 4.0}
    one, same, wide, late = (
        pj.plan(pj.block.planner(name, **options, **more), cases)
        for name, more in (
            ("insat", {}),
            ("pinsat", {"width": 1}),
            ("pinsat", {"width": 4}),
            ("insat", {"lift": "expansion"}),
        )
    )
    solved = np.flatnonzero(pj.are_solved(one))
    assert_same(pj.take(one, solved), pj.take(same, solved))
    for plans in (one, wide, late):
        assert pj.are_solved(plans).any()
        np.testing.assert_array_equal(pj.block.judge(cases, plans).success, pj.are_solved(plans))


def test_motions_between_published_poses_are_confirmed_by_the_referee_of_reaches():
    folder = Path(__file__).parents[2] / "shared" / "data" / "foreign" / "pinsat"
    if not folder.is_dir():
        pytest.skip("the start and goal poses of nrkumar93/pinsat are not in ../shared")
    starts, goals = (np.loadtxt(folder / f"{name}.txt")[::50] for name in ("starts", "goals"))
    scene = pj.reach.make_scene(floor=-0.45)
    reaches = [
        pj.reach.case(goal, angles=start, scene=scene)
        for start, goal in zip(starts, goals, strict=True)
    ]
    some = jax.tree.map(np.array, pj.block.draw(1, "open", seed=8, regime="R3"))
    planner = InsatBlock(duration=(0.1, 5.0))
    solved = free_ones = 0
    for reach in reaches:
        case = dataclasses.replace(
            pj.take(some, 0), arm=reach.arm, limits=reach.limits, scene=reach.scene
        )
        case, goal = dataclasses.replace(case, angles=reach.angles), Goal(reach.goals[0], 5.0)
        planner.compile(case)
        free, until = FreeSpace(case, 0.003), time.perf_counter() + 5.0
        if not free.is_free(np.stack([reach.angles, reach.goals[0]])).all():
            continue
        free_ones += 1
        found = planner.find_spline(case, free, goal, lambda end=until: end - time.perf_counter())
        if found is None:
            continue
        limits = (np.asarray(x, float) for x in (reach.limits.velocity, reach.limits.acceleration))
        steps, duration = find_steps(found.points, 20, *limits)
        motion = polynomial(
            case.angles, jnp.zeros(6), jnp.asarray(steps, jnp.float32), jnp.float32(duration)
        )
        plan = dataclasses.replace(pj.plan(pj.reach.planner(), reach), motion=motion)
        verdict: Any = pj.reach.judge(reach, plan)
        assert verdict.success, verdict.sentence()
        solved += 1
    assert solved > 0.5 * free_ones > 0


@pytest.mark.parametrize("name", ["direct", "insat", "epase"])
def test_an_arm_at_the_contact_pose_stays(name):
    if name == "epase":
        require_peers("toppra")
    cases = jax.tree.map(np.array, pj.block.draw(2, "open", seed=8))
    motion = pj.plan(pj.block.planner("direct", points=6), cases).motion
    ends = np.sum(motion.durations, axis=1)
    cases.angles[:] = jax.jit(jax.vmap(evaluate))(motion, ends)
    options = {"points": 6} if name == "direct" else QUICK
    plans = pj.plan(pj.block.planner(name, **options), cases)
    verdict: Any = pj.block.judge(cases, plans)
    assert verdict.success.all(), verdict.sentence(0)
    assert (plans.cost < 0.11).all()  # The shortest spline takes 0.1 s.
