"""Estimates of a ball's drag: K_D from lost energy, and coefficients of linear drag by fits."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from serve import DRAG, GRAVITY, assert_close, float64, pick, serve

from planner_jax.ball.flight import BallState, fly
from planner_jax.perception.drag import RlsState, drag_by_rls, measure_drag

measure_many = jax.jit(jax.vmap(measure_drag, in_axes=(0, 0, None, None)))
fly_many = jax.jit(jax.vmap(functools.partial(fly, num_steps=40), in_axes=(None, 0, None, None)))


def states(period, num=60, dtype=np.float64):
    times = (period * np.arange(num)).astype(dtype)
    return fly_many(serve(dtype=dtype), times, dtype(DRAG), dtype(GRAVITY))[0]


def measurements(period, dtype=np.float64, num=60):
    path = states(period, num, dtype)
    before, after = (pick(path, rows) for rows in (slice(None, -1), slice(1, None)))
    return np.asarray(measure_many(before, after, dtype(period), dtype(GRAVITY)))


@float64
def test_lost_energy_measures_the_drag_with_an_error_of_second_order():
    coarse, fine = (measurements(period) / DRAG - 1.0 for period in (0.01, 0.005))
    assert np.abs(coarse).max() < 1e-3 and abs(coarse.mean()) < 1e-4
    np.testing.assert_allclose(coarse[0] / fine[0], 4.0, rtol=0.05)


def test_lost_energy_measures_the_drag_in_float32():
    assert abs(measurements(0.01, np.float32).mean() / DRAG - 1.0) < 1e-3


@float64
def test_a_wide_prior_of_the_drag_leads_to_the_running_mean():
    path, found = states(0.01), measurements(0.01)

    def advance(state, pair):
        state = drag_by_rls(state, *pair, 0.01, GRAVITY)
        return state, state

    pairs = (pick(path, slice(None, -1)), pick(path, slice(1, None)))
    prior = RlsState(jnp.asarray(1.0), jnp.asarray(1e9))
    history = jax.jit(functools.partial(jax.lax.scan, advance))(prior, pairs)[1]
    num = np.arange(1, found.size + 1)
    np.testing.assert_allclose(history.estimate, np.cumsum(found) / num, rtol=1e-6)
    np.testing.assert_allclose(history.variance, 1.0 / num, rtol=1e-6)


def test_states_without_speed_or_with_nan_leave_the_drag():
    prior = RlsState(jnp.float32(0.05), jnp.float32(1.0))
    still = BallState(np.zeros(3, np.float32), np.zeros(3, np.float32))
    lost = BallState(np.full(3, np.nan, np.float32), np.ones(3, np.float32))
    for state in (still, lost):
        assert_close(drag_by_rls(prior, state, state, 0.01, GRAVITY), prior)


@pytest.mark.parametrize("vel", [np.zeros(3, np.float32), np.ones(3, np.float32)])
def test_the_gradient_of_the_estimate_is_finite(vel):
    def estimate(vel):
        ball, later = BallState(jnp.zeros(3), vel), BallState(jnp.zeros(3), 0.9 * vel)
        return drag_by_rls(RlsState(0.05, 1.0), ball, later, 0.01, GRAVITY).estimate

    assert np.isfinite(jax.grad(estimate)(vel)).all()
