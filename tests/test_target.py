"""Paths of targets in space: positions, velocities and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import planner_jax as pj
from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath, HarmonicPath

GRAVITY = 9.81
POS, VEL = np.array([3.0, -0.2, 2.5]), np.array([-2.5, 0.3, 4.0])
TIMES = np.array([0.0, 0.02, 0.3, 0.9, 1.6])


def ball_path(drag):
    ball = BallState(jnp.asarray(POS), jnp.asarray(VEL))
    return BallPath(ball, jnp.asarray(drag), jnp.asarray(GRAVITY))


def harmonic_path():
    swing = jnp.array([0.0, 0.3, 0.8])
    return HarmonicPath(
        jnp.asarray(POS), jnp.asarray(VEL), swing, jnp.asarray(2.1), jnp.asarray(0.7)
    )


@jax.jit
def states(path, times):
    return jax.vmap(path.at)(times)


@jax.jit
def derivative(path, time):
    """Return the derivative of the position by time."""
    return jax.jvp(lambda t: path.at(t).pos, (time,), (jnp.ones_like(time),))[1]


def test_a_ball_obeys_its_equation_of_motion(float64):
    drag = np.array([0.5, 0.0, 3.0])

    def rate(_, state):
        return np.concatenate([state[3:], -drag * state[3:] - [0.0, 0.0, GRAVITY]])

    start = np.concatenate([POS, VEL])
    flown = solve_ivp(rate, (0.0, TIMES[-1]), start, t_eval=TIMES, rtol=1e-10, atol=1e-12).y.T
    found = states(ball_path(drag), TIMES)
    np.testing.assert_allclose(found.pos, flown[:, :3], atol=1e-8)
    np.testing.assert_allclose(found.vel, flown[:, 3:], atol=1e-8)


@pytest.mark.parametrize("drag", [0.0, 1e-9])
def test_a_ball_without_drag_flies_a_parabola(float64, drag):
    found, t = states(ball_path(np.full(3, drag)), TIMES), TIMES[:, None]
    pull = np.array([0.0, 0.0, -GRAVITY])
    np.testing.assert_allclose(found.pos, POS + VEL * t + 0.5 * pull * t**2, atol=1e-7)
    np.testing.assert_allclose(found.vel, VEL + pull * t, atol=1e-7)


def test_a_swing_returns_after_a_period_except_for_its_drift(float64):
    path, period = harmonic_path(), 2.0 * np.pi / 2.1
    now, later = states(path, TIMES), states(path, TIMES + period)
    np.testing.assert_allclose(later.pos, now.pos + VEL * period, atol=1e-12)
    np.testing.assert_allclose(later.vel, now.vel, atol=1e-12)
    np.testing.assert_allclose(now.pos[0], POS + np.sin(0.7) * path.amplitude, atol=1e-12)


PATHS = {
    "drag": lambda: ball_path(np.array([0.5, 0.0, 3.0])),
    "no drag": lambda: ball_path(np.zeros(3)),
    "harmonic": harmonic_path,
}


@pytest.mark.parametrize("name", PATHS)
def test_the_velocity_is_the_derivative_of_the_position(float64, name):
    path = PATHS[name]()
    found = states(path, TIMES)
    ahead, behind = states(path, TIMES + 1e-5), states(path, TIMES - 1e-5)
    np.testing.assert_allclose(found.vel, (ahead.pos - behind.pos) / 2e-5, rtol=1e-6, atol=1e-8)
    for vel, time in zip(found.vel, TIMES, strict=True):
        np.testing.assert_allclose(derivative(path, time), vel, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["no drag", "harmonic"])
def test_gradients_by_every_leaf_are_finite_at_time_zero_and_without_drag(name):
    total = lambda path, time: jnp.sum(path.at(time).pos) + jnp.sum(path.at(time).vel)  # noqa: E731
    slopes = jax.jit(jax.grad(total, argnums=(0, 1)))(PATHS[name](), jnp.zeros(()))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


def test_a_case_can_be_made_inside_a_compiled_function():
    ball = BallState(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    path = BallPath(ball, drag=jnp.zeros((1, 3)), gravity=jnp.full(1, 9.81))
    scale = jax.jit(lambda speed: pj.catch.case(path, np.ones(1), speed=3.0).limits.speed * speed)
    assert scale(2.0) == 6.0
