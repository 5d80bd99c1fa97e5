"""Flights with drag between two points, against an integration in small steps."""

import functools

import jax
import numpy as np
import pytest

from planner_jax.ball.arc import fly_between
from planner_jax.ball.flight import BallState, fly

START, GRAVITY = np.array([0.3, -0.2, 1.4]), np.array(9.8)
FLIGHTS = jax.jit(jax.vmap(fly_between, (None, 0, None, 0, None)))
EXACT = jax.jit(jax.vmap(functools.partial(fly, num_steps=400), (0, None, 0, None)))
TARGETS = np.array([[1.2, 0.3, 1.7], [0.3, -0.2, 1.4], [2.0, 1.0, 4.0], [0.5, 0.0, -6.0]])


@pytest.mark.parametrize(("drag", "error"), [(0.0, 1e-9), (0.0616, 1e-4), (0.2, 3e-3)])
def test_a_ball_with_the_velocity_of_an_arc_meets_the_target(float64, drag, error):
    time, drag = np.array(1.1), np.full(len(TARGETS), drag)
    first, last, top = FLIGHTS(START, TARGETS, time, drag, GRAVITY)
    balls = BallState(np.tile(START, (len(TARGETS), 1)), first)
    end, path = EXACT(balls, time, drag, GRAVITY)
    np.testing.assert_allclose(end.pos, TARGETS, atol=error)
    np.testing.assert_allclose(end.vel, last, atol=4.0 * error)
    highest = np.maximum(np.asarray(path.pos)[..., 2].max(axis=1), START[2])
    np.testing.assert_allclose(top, highest, atol=1e-4 + error)


def test_derivatives_of_an_arc_agree_with_finite_differences(float64):
    def value(x):
        return np.arange(1.0, 8.0) @ jax.numpy.hstack(fly_between(x[:3], x[3:6], *x[6:]))

    at = np.array([*START, *TARGETS[0], 1.1, 0.0616, 9.8])
    value_of, slopes = jax.jit(value), jax.jit(jax.grad(value))(at)
    steps = 1e-6 * np.eye(at.size)
    numeric = [(value_of(at + step) - value_of(at - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(slopes, numeric, rtol=1e-6, atol=1e-6)
