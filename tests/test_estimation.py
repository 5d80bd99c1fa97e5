"""Ball estimation: the Kalman filter, the linear-drag fit, and K_D by energy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from planner_jax.ball.estimation import (
    EkfModel,
    EkfState,
    RlsState,
    drag_measurement,
    ekf_init,
    ekf_predict,
    ekf_update,
    estimate_drag,
    filter_path,
    fit_linear_drag,
    rls_update,
    specific_energy,
)
from planner_jax.ball.flight import (
    BallState,
    fly,
    linear_drag_flight,
    rk4_step,
)

GRAVITY = 9.8
LINEAR_DRAG = (0.4, 0.3, 0.2)  # [1/s]
QUADRATIC_DRAG = 0.0616  # [1/m]
NUM = 121
PERIOD = 0.01  # [s]
NOISE = 0.02  # [m]
SERVE_POS, SERVE_VEL = (4.0, 0.5, 2.0), (-6.5, 0.7, 5.5)

float64 = pytest.mark.usefixtures("float64")

# Compiled once for all tests of equal shapes and dtype; "many" have a row of observations a ball.
predict_one = jax.jit(ekf_predict, static_argnames="flight")
update_one = jax.jit(ekf_update)
filter_one = jax.jit(filter_path, static_argnames="flight")
fit_one = jax.jit(fit_linear_drag)
fit_many = jax.jit(jax.vmap(fit_linear_drag, in_axes=(None, 0, None)))
drag_one = jax.jit(estimate_drag)
drag_many = jax.jit(jax.vmap(estimate_drag, in_axes=(None, 0, None, None)))
fly_one = jax.jit(fly, static_argnames="num_steps")
fly_many = jax.jit(jax.vmap(functools.partial(fly, num_steps=80), in_axes=(0, None, None, None)))


@functools.partial(jax.jit, static_argnames="flight")
def filter_many(initial, times, observations, model, *, flight=linear_drag_flight):
    return jax.vmap(lambda z: filter_path(initial, times, z, model, flight=flight))(observations)


@jax.jit
def linear_flight(ball, elapsed, drag):
    return jax.vmap(lambda t: linear_drag_flight(ball, t, drag, GRAVITY))(elapsed)


# The data are NumPy arrays: no operation on them is compiled, and the dtype is stated.


def times(dtype=np.float32):
    return (3.0 + PERIOD * np.arange(NUM)).astype(dtype)


def serve(dtype=np.float32):
    return BallState(pos=np.array(SERVE_POS, dtype), vel=np.array(SERVE_VEL, dtype))


def model(drag=LINEAR_DRAG, *, density=0.0, std=NOISE, dtype=np.float32):
    return EkfModel(*(np.asarray(x, dtype) for x in (drag, GRAVITY, density, std)))


def wide_prior(dtype=np.float32):
    return EkfState(mean=np.zeros(6, dtype), covariance=100.0 * np.eye(6, dtype=dtype))


def drag_prior(estimate, variance, dtype=np.float32):
    return RlsState(*np.array([estimate, variance], dtype))


def linear_path(dtype=np.float32, ball=None):
    """The ball at every one of `times`."""
    ball = serve(dtype) if ball is None else ball
    path = linear_flight(ball, times(dtype) - times(dtype)[0], np.array(LINEAR_DRAG, dtype))
    return jax.tree.map(np.asarray, path)


def quadratic_path(dtype=np.float32, drag=QUADRATIC_DRAG):
    """The same by eight Runge-Kutta steps between two of them."""
    ball = serve(dtype)
    _, fine = fly_one(ball, PERIOD * (NUM - 1), drag, GRAVITY, num_steps=8 * (NUM - 1))
    return jax.tree.map(lambda x0, x: np.concatenate([x0[None], x[7::8]]), ball, fine)


def noisy(positions, seed, std=NOISE):
    noise = np.random.default_rng(seed).normal(size=positions.shape)
    return positions + (std * noise).astype(positions.dtype)


def noisy_balls(positions, num=100, std=NOISE):
    return np.stack([noisy(positions, seed, std) for seed in range(num)])


def without(positions, *rows):
    seen = positions.copy()
    seen[rows] = np.nan
    return seen


def textbook_kalman(mean, covariance, observations, drag, density, std):
    """Affine Kalman filter of the linear-drag flight in NumPy, with matrix inverses."""
    e, K = np.exp(-drag * PERIOD), drag
    ramp = (1.0 - e) / K
    F = np.block([[np.eye(3), np.diag(ramp)], [np.zeros((3, 3)), np.diag(e)]])
    g = np.array([0.0, 0.0, -GRAVITY])
    offset = np.concatenate([g / K * (PERIOD - ramp), g * ramp])
    per_axis = np.array([[PERIOD**3 / 3, PERIOD**2 / 2], [PERIOD**2 / 2, PERIOD]])
    Q = density * np.kron(per_axis, np.eye(3))
    H, R = np.eye(3, 6), std**2 * np.eye(3)
    for k, z in enumerate(observations):
        if k > 0:
            mean, covariance = F @ mean + offset, F @ covariance @ F.T + Q
        gain = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + R)
        mean = mean + gain @ (z - H @ mean)
        covariance = (np.eye(6) - gain @ H) @ covariance
    return mean, covariance


# The Kalman filter


@float64
def test_filter_of_linear_flight_is_the_textbook_kalman_filter():
    observations = noisy(linear_path(np.float64).pos, seed=1)
    prior = wide_prior(np.float64)
    states, _ = filter_one(
        prior, times(np.float64), observations, model(density=0.5, dtype=np.float64)
    )
    mean, covariance = textbook_kalman(
        prior.mean, prior.covariance, observations, np.array(LINEAR_DRAG), 0.5, NOISE
    )
    np.testing.assert_allclose(states.mean[-1], mean, atol=1e-9)
    np.testing.assert_allclose(states.covariance[-1], covariance, atol=1e-10)


@float64
@pytest.mark.parametrize("flight", [linear_drag_flight, rk4_step])
def test_filter_recovers_the_exact_state_from_exact_observations(flight):
    linear = flight is linear_drag_flight
    path = linear_path(np.float64) if linear else quadratic_path(np.float64)
    belief = model(
        LINEAR_DRAG if linear else QUADRATIC_DRAG, density=1e-9, std=1e-6, dtype=np.float64
    )
    states, _ = filter_one(
        wide_prior(np.float64), times(np.float64), path.pos, belief, flight=flight
    )
    np.testing.assert_allclose(states.ball.pos[-1], path.pos[-1], atol=1e-6)
    np.testing.assert_allclose(states.ball.vel[-1], path.vel[-1], atol=1e-5)


def test_exact_observations_give_the_state_in_float32():
    path = linear_path()
    states, _ = filter_one(wide_prior(), times(), path.pos, model(std=1e-3))
    np.testing.assert_allclose(states.ball.pos[-1], path.pos[-1], atol=1e-4)
    np.testing.assert_allclose(states.ball.vel[-1], path.vel[-1], atol=1e-3)


def test_errors_and_innovations_agree_with_the_covariances():
    """Over 100 balls drawn from the prior, NEES (6 degrees) and NIS (3) have their means."""
    rng = np.random.default_rng(2)
    balls = jax.tree.map(lambda x: (x + rng.normal(size=(100, 3))).astype(x.dtype), serve())
    prior = ekf_init(serve().pos, serve().vel, pos_std=1.0, vel_std=1.0)
    paths = [linear_path(ball=BallState(*ball)) for ball in zip(balls.pos, balls.vel, strict=True)]
    path = jax.tree.map(lambda *x: np.stack(x), *paths)
    observations = noisy(path.pos, seed=3)
    states, innovations = filter_many(prior, times(), observations, model())

    def mean_square(error, covariance):
        error, covariance = np.asarray(error, np.float64), np.asarray(covariance, np.float64)
        return np.mean(np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], -1))

    error = np.concatenate([path.pos, path.vel], axis=-1) - np.asarray(states.mean)
    # The standard deviation of the mean of 100 is 0.35 for the NEES at one instant; the
    # innovations of different instants are independent, so that their mean is much sharper.
    assert mean_square(error[:, -1], states.covariance[:, -1]) == pytest.approx(6.0, abs=1.0)
    assert mean_square(innovations.residual, innovations.covariance) == pytest.approx(3.0, abs=0.1)
    raw = np.sqrt(np.mean((observations - path.pos)[:, -1] ** 2))
    filtered = np.sqrt(np.mean(error[:, -1, :3] ** 2))
    assert filtered < 0.4 * raw


@pytest.mark.parametrize("std", [3e-4, 0.02])
def test_covariance_stays_symmetric_and_positive_definite_in_float32(std):
    zero = np.zeros(3, np.float32)
    prior = ekf_init(zero, zero, pos_std=100.0, vel_std=30.0)
    states, _ = filter_one(prior, times(), quadratic_path().pos, model(density=0.01, std=std))
    P = np.asarray(states.covariance, np.float64)
    np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2))
    size = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    correlation = P / (size[:, :, None] * size[:, None, :])
    assert np.linalg.eigvalsh(correlation).min() > 0.0


@pytest.mark.parametrize("missing", [(np.nan, np.nan, np.nan), (1.0, np.nan, 2.0)])
def test_a_dropped_observation_leaves_the_prediction(missing):
    predicted = predict_one(wide_prior(), 0.03, model(density=1.0))
    after, innovation = update_one(predicted, np.array(missing, np.float32), model())
    np.testing.assert_array_equal(after.mean, predicted.mean)
    np.testing.assert_array_equal(after.covariance, predicted.covariance)
    assert not innovation.observed and not np.any(innovation.residual)


def test_uncertainty_grows_in_a_gap_and_the_estimate_flies_on():
    path = linear_path()
    gap = slice(60, 80)
    states, innovations = filter_one(
        wide_prior(), times(), without(path.pos, gap), model(density=0.1, std=1e-3)
    )
    states, observed = jax.tree.map(np.asarray, (states, innovations.observed))
    assert not np.any(observed[gap]) and np.all(np.delete(observed, np.r_[gap]))
    assert np.all(np.diff(np.trace(states.covariance[gap], axis1=1, axis2=2)) > 0.0)
    np.testing.assert_allclose(states.ball.pos[gap], path.pos[gap], atol=1e-2)


def test_no_time_passed_changes_nothing():
    state = wide_prior()
    for flight, drag in ((linear_drag_flight, LINEAR_DRAG), (rk4_step, QUADRATIC_DRAG)):
        after = predict_one(state, 0.0, model(drag, density=1.0), flight=flight)
        np.testing.assert_array_equal(after.mean, state.mean)
        np.testing.assert_array_equal(after.covariance, state.covariance)


def test_prediction_error_grows_with_the_horizon_and_stays_finite():
    path = quadratic_path()
    belief = model(QUADRATIC_DRAG, density=1e-3)
    states, _ = filter_many(wide_prior(), times(), noisy_balls(path.pos), belief, flight=rk4_step)
    start, horizon = 40, 80
    balls = jax.tree.map(lambda x: np.asarray(x)[:, start], states.ball)
    _, ahead = fly_many(balls, horizon * PERIOD, QUADRATIC_DRAG, GRAVITY)
    missed = np.linalg.norm(np.asarray(ahead.pos) - path.pos[start + 1 :], axis=-1)
    errors = np.sqrt(np.mean(missed**2, axis=0))
    assert np.all(np.isfinite(errors)) and np.all(np.diff(errors[9::10]) > 0.0)
    assert errors[-1] < 0.25


@float64
def test_filter_gradient_is_finite_from_rest_and_matches_finite_differences():
    """With respect to the model and the observations, the first of which are missing."""
    observations = without(noisy(quadratic_path(np.float64).pos, seed=4), slice(3))
    belief = model(QUADRATIC_DRAG, density=0.1, dtype=np.float64)

    def last(belief, observations):
        states, _ = filter_one(
            wide_prior(np.float64), times(np.float64), observations, belief, flight=rk4_step
        )
        return jnp.sum(states.mean[-1])

    last = jax.jit(jax.value_and_grad(last, argnums=(0, 1)))
    _, gradient = last(belief, observations)
    assert not np.any(gradient[1][:3])
    step = 1e-5
    zero_model, wave = model(0.0, std=0.0), np.sin(np.arange(3.0 * NUM)).reshape(NUM, 3)
    for direction in ((belief, 0.0 * wave), (zero_model.replace(gravity=0.0), wave)):
        ends = (
            jax.tree.map(lambda x, dx, h=h: x + h * dx, (belief, observations), direction)
            for h in (step, -step)
        )
        forward, backward = (last(*end)[0] for end in ends)
        pairs = zip(*map(jax.tree.leaves, (gradient, direction)), strict=True)
        slope = sum(np.vdot(a, b) for a, b in pairs)
        np.testing.assert_allclose(slope, (forward - backward) / (2.0 * step), rtol=1e-6)


# The linear-drag fit


@float64
def test_fit_recovers_drag_and_state_in_float64():
    fit = fit_one(times(np.float64), linear_path(np.float64).pos, GRAVITY)
    np.testing.assert_allclose(fit.drag, LINEAR_DRAG, atol=1e-6)
    np.testing.assert_allclose(fit.ball.pos, SERVE_POS, atol=1e-6)
    np.testing.assert_allclose(fit.ball.vel, SERVE_VEL, atol=1e-6)
    assert np.all(fit.converged) and np.all(fit.residual < 1e-9)


def test_fit_recovers_drag_and_state_in_float32():
    """Positions of 5 m are rounded at 2e-7 m; that is what limits K_i."""
    fit = fit_one(times(), linear_path().pos, GRAVITY)
    np.testing.assert_allclose(fit.drag, LINEAR_DRAG, atol=1e-4)
    np.testing.assert_allclose(fit.ball.pos, SERVE_POS, atol=1e-5)
    np.testing.assert_allclose(fit.ball.vel, SERVE_VEL, atol=1e-4)
    assert np.all(fit.converged) and np.all(fit.residual < 1e-5)


@float64
def test_a_ball_without_drag_fits_with_no_drag():
    t = times(np.float64)
    elapsed = (t - t[0])[:, None]
    fall = np.array([0.0, 0.0, -0.5 * GRAVITY]) * elapsed**2
    positions = np.array(SERVE_POS) + np.array(SERVE_VEL) * elapsed + fall
    np.testing.assert_allclose(fit_one(t, positions, GRAVITY).drag, 0.0, atol=1e-9)


@float64
def test_fit_is_the_least_squares_optimum_that_scipy_finds():
    t, positions = times(np.float64), noisy(linear_path(np.float64).pos, seed=5)
    fit = fit_one(t, positions, GRAVITY)
    elapsed = t - t[0]
    for axis, g in enumerate((0.0, 0.0, -GRAVITY)):

        def path(s, pos, vel, drag, g=g):
            return pos + (vel - g / drag) * (1.0 - np.exp(-drag * s)) / drag + g * s / drag

        best, covariance = scipy.optimize.curve_fit(
            path, elapsed, positions[:, axis], p0=(0.0, 1.0, 0.1), ftol=1e-14, xtol=1e-14
        )
        found = [x[axis] for x in (fit.ball.pos, fit.ball.vel, fit.drag)]
        np.testing.assert_allclose(found, best, atol=1e-6)
        np.testing.assert_allclose(fit.drag_std[axis], np.sqrt(covariance[2, 2]), rtol=1e-3)


def test_the_spread_of_fits_is_as_large_as_they_say():
    fit = fit_many(times(), noisy_balls(linear_path().pos), GRAVITY)
    assert np.all(fit.converged)
    np.testing.assert_allclose(np.mean(fit.residual, axis=0), NOISE, rtol=0.05)
    spread = np.sqrt(np.mean((np.asarray(fit.drag) - np.array(LINEAR_DRAG)) ** 2, axis=0))
    np.testing.assert_allclose(spread, np.median(fit.drag_std, axis=0), rtol=0.25)


def test_fit_passes_over_missing_positions():
    positions = without(without(linear_path().pos, 0), slice(30, 60), 1)
    fit = fit_one(times(), positions, GRAVITY)
    np.testing.assert_allclose(fit.drag, LINEAR_DRAG, atol=1e-4)
    np.testing.assert_allclose(fit.ball.pos, SERVE_POS, atol=1e-5)
    assert np.all(fit.residual < 1e-5)


def test_two_positions_do_not_make_a_fit():
    fit = fit_one(times(), without(linear_path().pos, slice(2, None)), GRAVITY)
    assert not np.any(fit.converged)
    assert np.all(np.isfinite(fit.drag))


def test_an_axis_without_motion_says_that_its_drag_is_unknown():
    plane = np.array([1.0, 0.0, 1.0], np.float32)
    ball = jax.tree.map(lambda x: x * plane, serve())
    fit = fit_one(times(), linear_path(ball=ball).pos, GRAVITY)
    assert np.isinf(fit.drag_std[1]) and np.all(np.asarray(fit.drag_std)[[0, 2]] < 1e-3)
    assert np.all(np.isfinite(fit.drag))


@float64
def test_fit_gradient_matches_finite_differences():
    t, positions = times(np.float64), noisy(linear_path(np.float64).pos, seed=6)
    bump = np.random.default_rng(7).normal(size=positions.shape)
    total = jax.jit(jax.value_and_grad(lambda z: jnp.sum(fit_linear_drag(t, z, GRAVITY).drag)))
    _, gradient = total(positions)
    step = 1e-4
    ahead, behind = (total(positions + h * bump)[0] for h in (step, -step))
    slope = (ahead - behind) / (2.0 * step)
    np.testing.assert_allclose(np.vdot(gradient, bump), slope, rtol=1e-7)


# K_D by the loss of energy


@float64
def test_energy_is_kept_without_drag_and_lost_with_it():
    for drag, kept in ((0.0, True), (QUADRATIC_DRAG, False)):
        energy = [
            specific_energy(BallState(*ball), GRAVITY)
            for ball in zip(*jax.tree.leaves(quadratic_path(np.float64, drag)), strict=True)
        ]
        assert np.ptp(energy) < 1e-9 if kept else np.all(np.diff(energy) < 0.0)


@pytest.mark.parametrize("drag", [0.02, QUADRATIC_DRAG, 0.3])
def test_drag_of_a_quadratic_flight_is_found_to_one_percent(drag):
    final, estimates = drag_one(times(), quadratic_path(drag=drag), GRAVITY, drag_prior(0.1, 1e6))
    assert estimates.shape == (NUM - 1,) and estimates[-1] == final.estimate
    np.testing.assert_allclose(estimates[10:], drag, rtol=0.01)


def test_drag_is_found_through_the_filter_from_noisy_positions():
    """Filter with half the true K_D and room for the error, then energy and RLS."""
    observations = noisy_balls(quadratic_path().pos, std=1e-3)
    belief = model(0.5 * QUADRATIC_DRAG, density=1.0, std=1e-3)
    states, _ = filter_many(wide_prior(), times(), observations, belief, flight=rk4_step)
    settled = jax.tree.map(lambda x: np.asarray(x)[:, 20:], states.ball)
    found = drag_many(times()[20:], settled, GRAVITY, drag_prior(0.0, 1e3))[0].estimate
    assert np.mean(found) == pytest.approx(QUADRATIC_DRAG, rel=0.05)
    assert np.all(np.abs(found - QUADRATIC_DRAG) < 0.5 * QUADRATIC_DRAG)


@float64
@pytest.mark.parametrize("forgetting", [1.0, 0.9])
def test_recursive_least_squares_is_the_batch_solution(forgetting):
    """The start counts as one measurement more, of the oldest age."""
    rng = np.random.default_rng(8)
    h, y = rng.normal(size=30), rng.normal(size=30)
    estimate, variance = 0.3, 2.0
    state, update = drag_prior(estimate, variance, np.float64), jax.jit(rls_update)
    for regressor, measurement in zip(h, y, strict=True):
        state = update(state, regressor, measurement, forgetting)
    age = forgetting ** np.arange(30)[::-1]
    information = forgetting**30 / variance + np.sum(age * h**2)
    batch = (forgetting**30 * estimate / variance + np.sum(age * h * y)) / information
    np.testing.assert_allclose(state.estimate, batch, rtol=1e-12)
    np.testing.assert_allclose(state.variance, 1.0 / information, rtol=1e-12)


@float64
def test_estimate_without_prior_or_forgetting_is_the_mean_of_the_measurements():
    t, path = times(np.float64), quadratic_path(np.float64)
    path = path.replace(vel=noisy(path.vel, seed=9))
    speed = np.linalg.norm(path.vel, axis=1)
    energy = 0.5 * speed**2 + GRAVITY * path.pos[:, 2]
    measured = -np.diff(energy) / (PERIOD * (0.5 * (speed[1:] + speed[:-1])) ** 3)
    final, _ = drag_one(t, path, GRAVITY, drag_prior(0.0, 1e15, np.float64))
    np.testing.assert_allclose(final.estimate, np.mean(measured), rtol=1e-9)


def test_forgetting_follows_a_drag_that_changes():
    middle, before = fly_one(serve(), 0.4, 0.03, GRAVITY, num_steps=40)
    _, after = fly_one(middle, 0.4, 0.12, GRAVITY, num_steps=40)
    path = jax.tree.map(lambda *parts: np.concatenate(parts), before, after)
    unknown = drag_prior(0.0, 1e3)
    for forgetting, expected in ((0.8, 0.12), (1.0, 0.075)):
        final, _ = drag_one(times()[:80], path, GRAVITY, unknown, forgetting=forgetting)
        assert final.estimate == pytest.approx(expected, rel=0.03)


def test_undefined_measurements_are_passed_over_with_a_finite_gradient():
    still = BallState(pos=np.zeros(3), vel=np.zeros(3))
    measure = jax.jit(drag_measurement)
    assert np.isnan(measure(still, still, PERIOD, GRAVITY))
    assert np.isnan(measure(serve(), serve(), 0.0, GRAVITY))
    prior, path = drag_prior(0.05, 1.0), quadratic_path()
    assert rls_update(prior, 1.0, np.nan, 0.9).estimate == prior.estimate
    path.pos[:3], path.vel[:3] = 0.0, 0.0  # at rest at first
    gradient = jax.grad(lambda path: drag_one(times(), path, GRAVITY, prior)[0].estimate)(path)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


# One ball or many


def test_batch_equals_loop():
    observations = without(noisy_balls(linear_path().pos), 1, slice(10, 40))
    unknown = drag_prior(0.0, 1.0)
    states, _ = filter_many(wide_prior(), times(), observations, model())
    fit = fit_many(times(), observations, GRAVITY)
    # The first velocities, of which little is known, would only compare roundings.
    settled = jax.tree.map(lambda x: np.asarray(x)[:, 20:], states.ball)
    drag, _ = drag_many(times()[20:], settled, GRAVITY, unknown)
    for k in range(3):
        state, _ = filter_one(wide_prior(), times(), observations[k], model())
        np.testing.assert_allclose(states.mean[k, 20:], state.mean[20:], atol=1e-4)
        alone = fit_one(times(), observations[k], GRAVITY)
        np.testing.assert_allclose(fit.drag[k], alone.drag, atol=1e-4)
        path = jax.tree.map(lambda x, k=k: x[k], settled)
        estimate, _ = drag_one(times()[20:], path, GRAVITY, unknown)
        np.testing.assert_allclose(drag.estimate[k], estimate.estimate, rtol=1e-5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_dtype_of_the_input_is_kept(float64, dtype):
    path, unknown = linear_path(dtype), drag_prior(0.0, 1.0, dtype)

    def everything(path):
        seen = filter_path(wide_prior(dtype), times(dtype), path.pos, model(dtype=dtype))
        fit = fit_linear_drag(times(dtype), path.pos, GRAVITY)
        return seen, fit, estimate_drag(times(dtype), path, GRAVITY, unknown)

    leaves = jax.tree.leaves(jax.eval_shape(everything, path))
    assert all(leaf.dtype in (dtype, np.bool_) for leaf in leaves)
