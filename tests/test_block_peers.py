"""Published baselines of blocks: bang-bang motions, torques, plans that the referee confirms."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.robot.arm import REGIMES
from planner_jax.robot.arm_dynamics import inverse_dynamics, motion_torques
from planner_jax.robot.arm_mjcf import irb1600
from planner_jax.trajectory.bang_bang import bang_bang, least_times
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

LIMITS = REGIMES["R2"].limits


@jax.jit
def quickest(turn, rate, stretch):
    """The motion with a duration of so many times the least, sampled, and the least times."""
    times = least_times(turn, rate, LIMITS.velocity, LIMITS.acceleration)
    duration = stretch * jnp.max(times)
    motion = bang_bang(jnp.zeros(6), rate, turn, duration, jnp.asarray(LIMITS.acceleration))
    at = jax.vmap(
        lambda share: jnp.stack([evaluate(motion, share * duration, k) for k in range(3)])
    )
    return at(jnp.linspace(0.0, 1.0, 400)), times


def test_joints_from_rest_take_the_times_of_closed_forms(float64):
    """2 sqrt(d / a) below the greatest rate v, else d / v + v / a."""
    v, a = LIMITS.velocity.astype(float), LIMITS.acceleration.astype(float)
    turn = np.array([0.1, -0.2, 0.0, 1.5, -2.5, 4.0])
    times = quickest(turn, np.zeros(6), 1.0)[1]
    far = np.abs(turn) / v + v / a
    expected = np.where(np.abs(turn) > v**2 / a, far, 2.0 * np.sqrt(np.abs(turn) / a))
    np.testing.assert_allclose(times, expected, rtol=1e-12)
    assert (np.abs(turn) > v**2 / a).any()


@pytest.mark.parametrize("stretch", [1.0, 1.3, 3.0])
def test_joints_arrive_together_at_rest_within_their_limits(stretch, float64):
    """From rest and in motion, towards the goal, away from it and too fast to stop before it."""
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
        assert np.abs(steps).max() < 0.2  # no jump between pieces


@jax.jit
def torques(arm, motion, gravity):
    return motion_torques(arm, motion, gravity, samples=64)


def test_an_arm_that_stands_exerts_what_gravity_asks(float64):
    arm: Any = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), irb1600())
    still = PiecewisePolynomial(coeffs=arm.home[None, None], durations=jnp.array([0.7]))
    found = torques(arm, still, 9.81)
    expected = np.abs(inverse_dynamics(arm, arm.home, jnp.zeros(6), jnp.zeros(6)))
    np.testing.assert_allclose(found.rms, expected, atol=1e-9)
    np.testing.assert_allclose(found.peak, expected, atol=1e-9)
    np.testing.assert_allclose(torques(arm, still, 0.0).peak, 0.0, atol=1e-9)


def test_torques_of_even_ramps_are_those_of_inertia(float64):
    """Joint 1 alone, half of the time forwards and half back, without gravity."""
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


def test_direct_is_confirmed_by_the_referee_and_says_what_became_of_each_ball():
    cases = jax.tree.map(np.array, pj.block.draw(6, "open", seed=8))
    cases.ball.vel[1, 0] *= -1.0  # flies away
    cases.ball.pos[2] = np.nan
    cases.rates[3] = (0.3, -0.2, 0.1, 0.2, -0.4, 0.5)
    planner = pj.block.planner("direct", points=6)
    plans = pj.plan(planner, cases)
    verdict = pj.block.judge(cases, plans)
    assert plans.status[1] == plans.status[2] == pj.Status.OUT_OF_REACH
    np.testing.assert_array_equal(verdict.success, pj.solved(plans))
    assert pj.solved(plans)[[0, 3, 4, 5]].all()
    np.testing.assert_allclose(verdict.execution_time[3:], plans.cost[3:], rtol=1e-5)
    cases.limits.acceleration[:] = 0.5
    late = pj.plan(planner, cases)
    assert (late.status[[0, 3, 4, 5]] == pj.Status.INFEASIBLE).all()
