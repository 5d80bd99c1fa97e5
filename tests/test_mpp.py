"""The planner `mpp` of catches, which samples trajectories and selects the cheapest of them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.baselines.catch.mpp import MppCatch, falling_time
from planner_jax.core.protocol import Status, is_solved, take
from planner_jax.referee.catch import referee_catches
from planner_jax.task.catch.context import order_targets, targets_at

NUM = 16
MPP = MppCatch()


@pytest.fixture(scope="module")
def throws():
    suites = [pj.catch.draw(NUM // 2, name, 4, num_targets=3) for name in ("throws", "hard")]
    cases = jax.tree.map(lambda *leaves: np.concatenate(leaves), *suites)
    return cases, pj.plan(MPP, cases)


@pytest.fixture(scope="module")
def pairs():
    cases = pj.catch.draw(NUM, "parabola2", 4, num_targets=3)
    order = np.tile([0, 1, 2], (NUM, 1))
    order[:2] = [1, 0, 2]
    cases = dataclasses.replace(cases, order=order.astype(np.int32))
    return jax.tree.map(np.asarray, cases), pj.plan(MPP, cases)


def heights(cases, plans):
    ordered = jax.vmap(order_targets)(cases).targets
    return np.asarray(jax.jit(jax.vmap(targets_at))(ordered, plans.times).pos)[..., 2]


def test_the_net_is_on_the_ball_and_faces_it_at_the_fixed_height(throws):
    cases, plans = throws
    verdict = referee_catches(cases, plans)
    assert verdict.net_distance[:, 0].max() < 1e-4
    assert verdict.angle[:, 0].max() < 1e-3
    assert verdict.head_error.max() < 1e-5
    assert verdict.continuity_error.max() < 1e-4
    np.testing.assert_allclose(heights(cases, plans)[:, 0], MPP.height, atol=1e-4)
    np.testing.assert_allclose(verdict.catch_times[:, 0], plans.times[:, 0], atol=1e-6)


def test_a_plan_that_passes_the_check_afterwards_passes_the_referee(throws):
    cases, plans = throws
    verdict, solved = referee_catches(cases, plans), is_solved(plans.status)
    assert verdict.success[solved].all()
    assert set(verdict.failed_limit[~solved]) <= {"speed", "body rate", "thrust low", "thrust high"}
    assert (plans.violation[~solved] > 0.0).all()
    assert 0 < solved.sum() < NUM, "limits are not planned for"
    assert (plans.iterations == 0).all()


def test_the_kept_candidate_is_the_cheapest(throws):
    cases, plans = throws

    @jax.jit
    def try_candidates(case):
        context = order_targets(case)
        times, _ = MPP.times(context)
        ball = jax.tree.map(lambda leaf: leaf[0], targets_at(context.targets, times))
        return MPP.candidates(case.head_state, ball, times[0], case)

    for lane in (0, 7):
        candidates = try_candidates(take(cases, lane))
        assert candidates.cost.shape == (81,)
        costs, coeffs = np.asarray(candidates.cost), plans.trajectory.coeffs[lane, :2]
        np.testing.assert_allclose(plans.cost[lane], costs.min(), rtol=1e-4)
        cheapest = candidates.trajectory.coeffs[costs.argmin()]
        np.testing.assert_allclose(coeffs, cheapest, rtol=1e-3, atol=1e-2)
        np.testing.assert_allclose(costs, mean_squared_jerk(candidates.trajectory), rtol=1e-3)


def mean_squared_jerk(trajectory):
    nodes, weights = np.polynomial.legendre.leggauss(5)
    coeffs, durations = (np.asarray(x, float) for x in (trajectory.coeffs, trajectory.durations))
    t = 0.5 * durations[..., None] * (1.0 + nodes)  # (K, 2, 5)
    powers = np.stack([6.0 * t**0, 24.0 * t, 60.0 * t**2], axis=-1)
    jerk = np.einsum("kpni,kpix->kpnx", powers, coeffs[:, :, 3:])
    integral = 0.5 * ((jerk**2).sum(-1) * weights).sum(-1) * durations
    return integral.sum(axis=1) / durations.sum(axis=1)


def test_targets_are_caught_one_after_the_other_but_for_those_absent_or_in_wrong_order(pairs):
    cases, plans = pairs
    verdict = referee_catches(cases, plans)
    right = np.arange(2, NUM)
    assert plans.trajectory.coeffs.shape == (NUM, 6, 6, 3)
    assert verdict.net_distance[right, :2].max() < 1e-3
    assert verdict.angle[right, :2].max() < 1e-3
    np.testing.assert_allclose(heights(cases, plans)[right, :2], MPP.height, atol=1e-4)
    assert (np.diff(plans.times[right, :2], axis=1) > 0.0).all()
    np.testing.assert_array_equal(plans.times[:, 2], plans.times[:, 1])
    assert not plans.trajectory.durations[:, 4:].any()
    assert verdict.success[is_solved(plans.status)].all()
    assert set(np.asarray(plans.status)[:2]) == {Status.INFEASIBLE}
    assert (plans.violation[:2] > 0.0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(plans))


def test_a_target_that_never_falls_through_the_height_is_not_solved(throws):
    throws, plans = throws
    pos, vel = np.array(throws.targets.ball.pos), np.array(throws.targets.ball.vel)
    pos[0, 0, 2], vel[0, 0, 2] = 0.8, -1.0
    vel[1, 0, 2] = 30.0
    pos[3] = np.nan
    gravity, drag = np.array(throws.targets.gravity), np.array(throws.targets.drag)
    vel[2], gravity[2], drag[2] = 0.0, 0.0, 0.0
    changes = {"ball": pj.BallState(pos, vel), "gravity": gravity, "drag": drag}
    targets = dataclasses.replace(throws.targets, **changes)
    broken = dataclasses.replace(throws, targets=targets)
    found = jax.device_get(pj.plan(MPP, jax.tree.map(jnp.asarray, broken)))
    assert set(found.status[:3]) == {Status.INFEASIBLE}
    assert found.status[3] == Status.BAD_INPUT
    assert all(np.isfinite(leaf[:3]).all() for leaf in jax.tree.leaves(found))
    for old, new in zip(jax.tree.leaves(plans), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(old[4:], new[4:])


def test_the_first_fall_of_a_swing_is_found():
    targets = pj.catch.draw(8, "harmonic2", 1).targets
    middle = targets.pos[..., 2]

    @jax.jit
    @jax.vmap
    @jax.vmap
    def first(path, height):
        return falling_time(path, height, jnp.asarray(7.0), 128)

    time, found = first(targets, middle)
    assert found.all()
    turn = np.mod(np.pi - np.asarray(targets.phase), 2.0 * np.pi)  # a sine falls through 0 at pi
    np.testing.assert_allclose(time, turn / np.asarray(targets.rate), atol=1e-4)
