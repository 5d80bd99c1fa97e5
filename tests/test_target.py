"""Paths of targets: where they are, how fast, and that any class of that kind can be caught."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from jax import Array
from scipy.integrate import solve_ivp

import planner_jax as pj
from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath, HarmonicPath
from planner_jax.core.protocol import is_solved
from planner_jax.optimise.settings import LbfgsConfig, Round
from planner_jax.planning.plan import plan
from planner_jax.referee.catch import referee_catches
from planner_jax.task.catch.default_planner import ExactCatch

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
    """How fast the position changes with time."""
    return jax.jvp(lambda t: path.at(t).pos, (time,), (jnp.ones_like(time),))[1]


def test_ball_flies_as_its_equation_of_motion_says(float64):
    drag = np.array([0.5, 0.0, 3.0])

    def rate(_, state):
        return np.concatenate([state[3:], -drag * state[3:] - [0.0, 0.0, GRAVITY]])

    start = np.concatenate([POS, VEL])
    flown = solve_ivp(rate, (0.0, TIMES[-1]), start, t_eval=TIMES, rtol=1e-10, atol=1e-12).y.T
    found = states(ball_path(drag), TIMES)
    np.testing.assert_allclose(found.pos, flown[:, :3], atol=1e-8)
    np.testing.assert_allclose(found.vel, flown[:, 3:], atol=1e-8)


@pytest.mark.parametrize("drag", [0.0, 1e-9])
def test_ball_without_drag_flies_a_parabola(float64, drag):
    found = states(ball_path(np.full(3, drag)), TIMES)
    t = TIMES[:, None]
    pull = np.array([0.0, 0.0, -GRAVITY])
    np.testing.assert_allclose(found.pos, POS + VEL * t + 0.5 * pull * t**2, atol=1e-7)
    np.testing.assert_allclose(found.vel, VEL + pull * t, atol=1e-7)


def test_swing_returns_after_a_period_but_for_its_drift(float64):
    path, period = harmonic_path(), 2.0 * np.pi / 2.1
    now, later = states(path, TIMES), states(path, TIMES + period)
    np.testing.assert_allclose(later.pos, now.pos + VEL * period, atol=1e-12)
    np.testing.assert_allclose(later.vel, now.vel, atol=1e-12)
    np.testing.assert_allclose(now.pos[0], POS + np.sin(0.7) * path.amplitude, atol=1e-12)


@pytest.mark.parametrize(
    "make",
    [
        lambda: ball_path(np.array([0.5, 0.0, 3.0])),
        lambda: ball_path(np.zeros(3)),
        harmonic_path,
    ],
    ids=["drag", "no drag", "harmonic"],
)
def test_velocity_is_the_gradient_of_the_position_in_time(float64, make):
    path = make()
    found = states(path, TIMES)
    ahead, behind = states(path, TIMES + 1e-5), states(path, TIMES - 1e-5)
    np.testing.assert_allclose(found.vel, (ahead.pos - behind.pos) / 2e-5, rtol=1e-6, atol=1e-8)
    for vel, time in zip(found.vel, TIMES, strict=True):
        np.testing.assert_allclose(derivative(path, time), vel, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("make", [lambda: ball_path(np.zeros(3)), harmonic_path])
def test_gradient_in_every_leaf_is_finite_also_at_time_zero_and_without_drag(make):
    total = lambda path, time: jnp.sum(path.at(time).pos) + jnp.sum(path.at(time).vel)  # noqa: E731
    slopes = jax.jit(jax.grad(total, argnums=(0, 1)))(make(), jnp.zeros(()))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


@struct.dataclass
class Corkscrew:
    """A target of a user's own: it sinks evenly along a circle."""

    centre: Array  # (3,) [m], at time 0
    radius: Array  # () [m]
    rate: Array  # () [rad/s]
    sink: Array  # () [m/s]

    def at(self, time):
        angle, down = self.rate * time, jnp.array([0.0, 0.0, -1.0])
        sine, cosine, zero = jnp.sin(angle), jnp.cos(angle), jnp.zeros_like(angle)
        out, along = jnp.stack([cosine, sine, zero]), jnp.stack([-sine, cosine, zero])
        return BallState(
            pos=self.centre + self.radius * out + self.sink * time * down,
            vel=self.radius * self.rate * along + self.sink * down,
        )


@pytest.mark.slow
def test_a_path_of_a_users_own_class_is_caught():
    leaves = [[0.8, -0.5, 4.5]], [0.4], [2.5], [2.5]
    targets = Corkscrew(*(np.asarray(leaf, np.float32) for leaf in leaves))
    case = pj.catch.case(targets, np.full(1, 1.6))
    case = case.replace(times=np.ones(1, np.float32))
    planner = ExactCatch(rounds=(Round(1, LbfgsConfig(max_steps=40, memory=3)),))
    found = plan(planner, case)
    assert is_solved(found.status)

    def flown(_, order, times):
        """The same path in NumPy, for the referee: positions and velocities (B, N, 3)."""
        assert order.tolist() == [[0]]
        angle = 2.5 * times
        zero = np.zeros_like(times)
        out = np.stack([np.cos(angle), np.sin(angle), zero], axis=-1)
        along = np.stack([-np.sin(angle), np.cos(angle), zero], axis=-1)
        down = np.array([0.0, 0.0, -2.5])
        pos = np.array([0.8, -0.5, 4.5]) + 0.4 * out + times[..., None] * down
        return pos, 0.4 * 2.5 * along + down

    one = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (case, found))
    verdict = referee_catches(*one, target_states=flown)
    assert verdict.success.all(), verdict.sentence(0)


def test_a_case_is_made_inside_of_a_compiled_function():
    ball = BallState(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    path = BallPath(ball, drag=jnp.zeros((1, 3)), gravity=jnp.full(1, 9.81))
    made = jax.jit(lambda speed: pj.catch.case(path, np.ones(1), speed=3.0).limits.speed * speed)
    assert made(2.0) == 6.0
