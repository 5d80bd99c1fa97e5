"""Estimates of a ball's drag: K_D from lost energy, and coefficients of linear drag by fits."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from serve import DRAG, GRAVITY, assert_close, float64, pick, serve

from planner_jax.ball.estimation import EkfModel, ekf_init, ekf_predict, ekf_update
from planner_jax.ball.flight import BallState, fly
from planner_jax.ball.linear_drag import linear_drag_flight
from planner_jax.perception.drag import RlsState, drag_by_rls, measure_drag
from planner_jax.perception.linear_fit import (
    fit_linear_drag,
    refine_model,
    window_init,
    window_update,
)

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


TIMES, STD = 0.01 * np.arange(1, 31), 0.005
PRIOR = np.array([0.4, 0.4, 0.4])
linear_path = jax.jit(
    jax.vmap(lambda t, drag, ball: linear_drag_flight(ball, t, drag, GRAVITY).pos, (0, None, None))
)


@functools.partial(jax.jit, static_argnames="shared")
def fit_many(times, paths, ball, drag, std, prior_std=np.inf, **options):
    options |= {"gravity": GRAVITY, "observation_std": std, "prior_std": prior_std}
    return jax.vmap(lambda path: fit_linear_drag(times, path, ball, drag, **options))(paths)


def fits(drags, noise=0.0, prior_std=np.inf, **options):
    ball = serve()
    drags = np.broadcast_to(drags, (len(drags), 3)).astype(float)
    paths = np.stack([linear_path(TIMES, drag, ball) for drag in drags])
    paths = paths + noise * np.random.default_rng(3).normal(size=paths.shape)
    return paths, fit_many(TIMES, paths, ball, PRIOR, STD, prior_std, **options)


@float64
@pytest.mark.parametrize("shared", [False, True])
def test_the_fit_of_exact_positions_is_exact(shared):
    drags = np.array([[0.0], [0.05], [0.4], [2.0]])
    fit = fits(drags, shared=shared)[1]
    np.testing.assert_allclose(fit.drag, np.broadcast_to(drags, (4, 3)), atol=1e-6)
    assert np.all(fit.residual < 1e-9)
    rank = 1 if shared else 3
    assert all(np.linalg.matrix_rank(covariance) == rank for covariance in fit.covariance)


@float64
def test_the_fit_is_that_of_scipy():
    paths, fit = fits(np.full((4, 1), 0.3), noise=STD, prior_std=0.2)

    def residuals(drag, path):
        away = (np.asarray(linear_path(TIMES, drag, serve())) - path) / STD
        return np.append(away.ravel(), (drag - PRIOR) / 0.2)

    for path, drag in zip(paths, fit.drag, strict=True):
        found = scipy.optimize.least_squares(residuals, PRIOR, args=(path,), xtol=1e-12)
        np.testing.assert_allclose(drag, found.x, atol=1e-6)


@float64
def test_the_variance_of_the_fit_is_the_cramer_rao_bound():
    fit = fits(np.full((2000, 1), 0.5), noise=STD)[1]
    step = 1e-4
    slope = sum(
        sign * np.asarray(linear_path(TIMES, 0.5 + sign * step * np.ones(3), serve()))
        for sign in (1.0, -1.0)
    ) / (2.0 * step)
    bound = STD**2 / np.sum(slope**2, axis=0)
    np.testing.assert_allclose(np.var(fit.drag, axis=0), bound, rtol=0.2)
    stated = np.diagonal(fit.covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(np.median(stated, axis=0), bound, rtol=0.05)
    np.testing.assert_allclose(np.mean(fit.residual), STD, rtol=0.05)


def test_missing_rows_and_axes_without_information_keep_the_prior():
    times, lost = TIMES.astype(np.float32), np.full((30, 3), np.nan, np.float32)
    ball = serve(vel=(-6.5, 0.0, 5.5), dtype=np.float32)
    drag = np.full(3, 0.4, np.float32)
    seen = np.array(linear_path(times, 2.0 * drag, ball))
    seen[::3] = np.nan
    paths = np.stack([seen, lost])
    fit = fit_many(times, paths, ball, drag, np.float32(STD))
    np.testing.assert_allclose(fit.drag[0], [0.8, 0.4, 0.8], atol=2e-3)
    np.testing.assert_array_equal(fit.drag[1], drag)
    assert fit.residual[1] == 0.0 and np.isinf(np.diag(fit.covariance[1])).all()
    assert np.isinf(fit.covariance[0, 1, 1]) and np.isfinite(fit.covariance[0, 2, 2])


@float64
def test_the_gradient_of_the_fit_agrees_with_finite_differences():
    path = fits(np.full((1, 1), 0.3), noise=STD)[0][0]

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def summed(shift):
        ball = BallState(serve().pos + shift[0], serve().vel - shift[1])
        seen = path * (1.0 + shift[2] * jnp.sin(jnp.arange(30.0))[:, None])
        options = {"observation_std": STD, "prior_std": 0.2, "max_steps": 12}
        fit = fit_linear_drag(TIMES, seen, ball, PRIOR + shift[3], gravity=GRAVITY, **options)
        return jnp.sum(fit.drag * jnp.arange(1.0, 4.0))

    step = 1e-4
    values, gradients = summed(step * np.concatenate([np.eye(4), -np.eye(4), np.zeros((1, 4))]))
    np.testing.assert_allclose(gradients[8], (values[:4] - values[4:8]) / (2 * step), rtol=1e-4)


@float64
def test_the_online_window_corrects_the_filters_drag():
    true = np.array([0.6, 0.5, 0.7])
    path = np.array(linear_path(np.append(0.0, TIMES), true, serve()))
    path[7] = np.nan
    start = ekf_init(serve().pos, serve().vel, pos_std=1e-3, vel_std=1e-3)
    model = EkfModel(PRIOR, np.asarray(GRAVITY), np.asarray(1e-6), np.asarray(1e-3))

    def advance(carry, seen):
        state, window, model = carry
        state = ekf_update(ekf_predict(state, 0.01, model), seen, model)
        mean = jnp.where(jnp.isfinite(seen[0]), state.mean, jnp.nan)
        window = window_update(window, 0.01, state.replace(mean=mean))
        return (state, window, refine_model(window, model, PRIOR, 1.0)), None

    first = window_update(window_init(dtype=float), 0.0, start)
    filled = jax.jit(functools.partial(jax.lax.scan, advance))((start, first, model), path[1:])
    window, model = filled[0][1:]
    np.testing.assert_allclose(window.ages, 0.01 * np.arange(19, -1, -1), atol=1e-12)
    assert np.abs(model.drag - true).max() < 0.5 * np.abs(PRIOR - true).max()
