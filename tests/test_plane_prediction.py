"""Predicted target positions: fits, selection of a model, and Cramer-Rao bound."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import positions_on
from derivatives import assert_gradient_matches_differences
from scipy.optimize import least_squares
from scipy.special import ellipe

from planner_jax.benchmarks.prediction_bounds import cramer_rao, mean_distance, share_within
from planner_jax.plane.target import PolynomialPath, TurningPath
from planner_jax.sims.prediction.observed import centre
from planner_jax.sims.prediction.polynomial_fit import fit_polynomial
from planner_jax.sims.prediction.select_path import log_density, select
from planner_jax.sims.prediction.turn_fit import best_turn, path_of

TIMES = np.arange(-14.0, 1.0)
NOISE, AHEAD = 0.1, 10.0
NUM = 300  # targets of a batch; the first half moves straight
ONES = np.ones(15)

float64 = pytest.mark.usefixtures("float64")


def path(pos, vel, rate):
    return TurningPath(*(np.asarray(leaf, float) for leaf in (pos, vel, rate)))


TURN, LINE = (path([3.0, 4.0], [0.3, -0.2], rate) for rate in (0.06, 0.0))


def noisy(path, times=TIMES):
    return positions_on(path, times) + np.random.default_rng(0).normal(0.0, NOISE, (len(times), 2))


def draw_targets():
    rng = np.random.default_rng(1)
    heading = rng.uniform(-np.pi, np.pi, NUM)
    vel = rng.uniform(0.2, 0.5, (NUM, 1)) * np.stack([np.cos(heading), np.sin(heading)], 1)
    rate = rng.uniform(0.03, 0.1, NUM) * rng.choice([-1.0, 1.0], NUM)
    rate[: NUM // 2] = 0.0
    true = path(rng.uniform(0.0, 8.0, (NUM, 2)), vel, rate)
    positions = positions_on(true, np.append(TIMES, AHEAD))
    return positions[:, -1], positions[:, :-1] + rng.normal(0.0, NOISE, (NUM, 15, 2))


@jax.jit
def fits(times, seen, weights):
    return [fit_polynomial(times, seen, degree, weights) for degree in (1, 2, 3)]


@jax.jit
def turn(times, seen):
    centred = centre(times, seen, None, 3)
    return path_of(centred, best_turn(centred))


predict = jax.jit(select, static_argnums=2)
bound_of = jax.jit(cramer_rao, static_argnames="turning")


def at(polynomial, times):
    coeffs = np.asarray(polynomial.coeffs, float)[::-1]
    passed = np.asarray(times) - float(polynomial.origin)
    return np.stack([np.polyval(column, passed) for column in coeffs.T], -1)


@float64
def test_a_polynomial_minimises_the_weighted_squares():
    seen, weights = noisy(TURN), np.linspace(0.5, 2.0, 15)
    for degree, found in enumerate(fits(TIMES, seen, weights), start=1):
        expected = np.polyfit(TIMES, seen, degree, w=np.sqrt(weights))
        for time in (0.0, AHEAD):
            position = [np.polyval(column, time) for column in expected.T]
            np.testing.assert_allclose(at(found, time), position, rtol=1e-9)


def test_cubics_are_fitted_in_single_precision_far_from_the_origin_of_time():
    coeffs = np.array([[3.0, 4.0], [0.3, -0.2], [0.01, 0.02], [1e-3, -2e-3]])
    cubic = PolynomialPath(coeffs, np.array(2000.0))
    times = TIMES + 2000.0
    found = jax.jit(fit_polynomial, static_argnums=2)(times, at(cubic, times), 3)
    assert found.coeffs.dtype == jnp.float32
    np.testing.assert_allclose(at(found, 2000.0 + AHEAD), at(cubic, 2000.0 + AHEAD), atol=2e-3)


@pytest.mark.slow
@float64
def test_absent_observations_have_no_effect():
    seen, weights, times = noisy(TURN), ONES.copy(), TIMES.copy()
    seen[2], weights[5], times[9] = np.nan, 0.0, np.inf
    present = np.delete(np.arange(15), [2, 5, 9])
    cubic = fits(times, seen, weights)[2]
    expected = np.polyfit(TIMES[present], seen[present], 3)
    np.testing.assert_allclose(at(cubic, AHEAD), expected.T @ AHEAD ** np.arange(3, -1, -1.0))
    # The prediction depends neither on the order of observations nor on values marked as absent.
    other = np.isin(TIMES, TIMES[present]).astype(float)
    wild, order = noisy(TURN), np.random.default_rng(3).permutation(15)
    wild[other == 0.0] = 9.0
    again = predict(TIMES[order], wild[order], NOISE, other[order])
    found = predict(times, seen, NOISE, weights)
    chex.assert_trees_all_close(found, again, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_a_turn_without_noise_is_fitted_at_any_rate(precision):
    tolerance = 1e-9 if precision == "double" else 3e-4
    with jax.enable_x64(precision == "double"):
        for rate in (-0.93, -0.07, 0.0, 0.004, 0.31):
            true = path([3.0, 4.0], [0.3, -0.2], rate)
            found = jax.tree.map(np.asarray, turn(TIMES, positions_on(true, TIMES)))
            np.testing.assert_allclose(found.turn_rate, rate, atol=tolerance)
            ahead = positions_on(found, [AHEAD])
            np.testing.assert_allclose(ahead, positions_on(true, [AHEAD]), atol=9 * tolerance)


@float64
def test_a_turn_with_noise_minimises_the_squares():
    seen = noisy(TURN)

    def residuals(x):
        return np.ravel(positions_on(path(x[:2], x[2:4], x[4]), TIMES) - seen)

    best = least_squares(residuals, [3.0, 4.0, 0.3, -0.2, 0.06], xtol=1e-12, ftol=1e-12).x
    expected = path(best[:2], best[2:4], best[4])
    chex.assert_trees_all_close(turn(TIMES, seen), expected, rtol=1e-5)


def test_few_straight_targets_count_as_turning_and_few_predictions_are_far_off():
    truth, seen = draw_targets()
    found = jax.jit(jax.vmap(lambda seen: select(TIMES, seen, NOISE)))(seen.astype(np.float32))
    straight, turning = np.split(np.asarray(found.turn_rate) != 0.0, 2)
    assert straight.mean() < 0.05 and turning.mean() > 0.9
    ahead = np.asarray(jax.vmap(lambda path: path.at(AHEAD).pos)(found))
    off = np.linalg.norm(ahead - truth, axis=1)
    shares = [(half <= 0.3).mean() for half in np.split(off, 2)]
    assert shares[0] > 0.9 and shares[1] > 0.4
    bounds = [bound_of(LINE, TIMES, NOISE, AHEAD, turning=False)]
    bounds += [bound_of(TURN, TIMES, NOISE, AHEAD)]
    least = np.array([mean_distance(bound) for bound in bounds])
    assert np.all(np.mean(np.split(off, 2), axis=1) < 1.3 * least)


@pytest.mark.slow
def test_a_batch_in_single_precision_equals_its_targets_one_by_one_in_double():
    seen = draw_targets()[1][:: NUM // 4]
    many = jax.jit(jax.vmap(lambda seen: select(TIMES, seen, NOISE)))
    found = many(seen)
    assert found.pos.dtype == jnp.float32
    with jax.enable_x64(True):
        for k in range(len(seen)):
            one = predict(TIMES, seen[k], NOISE)
            of_batch = jax.tree.map(lambda leaf, k=k: leaf[k], found)
            chex.assert_trees_all_close(of_batch, one, rtol=2e-3, atol=1e-3)


@float64
def test_the_bound_for_a_straight_target_is_the_variance_of_a_fitted_line():
    middle = TIMES.mean()
    variance = NOISE**2 * (1 / 15 + (AHEAD - middle) ** 2 / np.sum((TIMES - middle) ** 2))
    bound = bound_of(LINE, TIMES, NOISE, AHEAD, turning=False)
    np.testing.assert_allclose(bound, variance * np.eye(2), rtol=1e-12, atol=1e-15)


@float64
def test_the_bound_inverts_the_information_of_all_five_numbers():
    centre, step = np.array([3.0, 4.0, 0.3, -0.2, 0.06]), 1e-6 * np.eye(5)

    def positions(x):
        return np.ravel(positions_on(path(x[:2], x[2:4], x[4]), np.append(TIMES, AHEAD)))

    ends = [(positions(centre + h), positions(centre - h)) for h in step]
    slopes = np.stack([(after - before) / 2e-6 for after, before in ends], axis=1)
    seen, ahead = slopes[:-2], slopes[-2:]
    expected = ahead @ np.linalg.inv(seen.T @ seen / NOISE**2) @ ahead.T
    np.testing.assert_allclose(bound_of(TURN, TIMES, NOISE, AHEAD), expected, rtol=1e-6)


@float64
def test_mean_and_share_of_a_gaussian_error_have_closed_forms():
    large, small = 0.5, 0.2
    round_error = large**2 * np.eye(2)
    np.testing.assert_allclose(mean_distance(round_error), large * np.sqrt(0.5 * np.pi))
    np.testing.assert_allclose(share_within(round_error, 0.3), -np.expm1(-0.5 * 0.6**2))
    turned = np.array([[0.8, -0.6], [0.6, 0.8]])
    long_error = turned @ np.diag([large**2, small**2]) @ turned.T
    expected = large * np.sqrt(2.0 / np.pi) * ellipe(1.0 - (small / large) ** 2)
    np.testing.assert_allclose(mean_distance(long_error), expected, rtol=1e-9)


@float64
@pytest.mark.parametrize("num", [0, 1, 2])
def test_too_few_observations_are_predicted_to_move_straight(num):
    seen, weights = noisy(TURN), np.where(np.arange(15) < num, 1.0, 0.0)
    found = jax.tree.map(np.asarray, predict(TIMES, seen, NOISE, weights))
    assert found.turn_rate == 0.0
    last = positions_on(found, TIMES[[num - 1]])[0]
    np.testing.assert_allclose(last, seen[num - 1] if num else [0.0, 0.0], atol=1e-9)


@float64
def test_the_density_of_turn_rates_integrates_to_one_and_is_symmetric():
    rates = np.linspace(-3.0, 3.0, 60001)
    density = np.exp(jax.jit(log_density)(rates))
    np.testing.assert_allclose(np.trapezoid(density, rates), 1.0, rtol=1e-6)
    np.testing.assert_allclose(density, density[::-1])
    assert density[30000] == 0.0


@float64
@pytest.mark.parametrize("fits_turn", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_turns_and_predictions_can_be_differentiated_by_the_observations(fits_turn):
    times = TIMES.copy()  # JAX may cache the constant itself in double precision

    def total(seen):
        found = turn(times, seen) if fits_turn else select(times, seen, NOISE)
        return jnp.sum(found.at(AHEAD).pos)

    assert_gradient_matches_differences(total, noisy(TURN), step=1e-6, rtol=1e-5)


FEW, MANY = (TIMES[:2], np.zeros((2, 2))), (TIMES, np.zeros((15, 2)))


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (select, (*FEW, NOISE), "times must be of at least 3 observations, got 2"),
        (fit_polynomial, (*FEW, 2), "times must be of at least 3 observations, got 2"),
        (fit_polynomial, (*MANY, 4), "degree must be 1, 2 or 3, got 4"),
        (fit_polynomial, (*MANY, 0), "degree must be 1, 2 or 3, got 0"),
        (select, (TIMES, np.zeros((15, 3)), NOISE), r"\(L, 2\), got \(15,\) and \(15, 3\)"),
        (select, (*MANY, NOISE, np.ones(3)), r"must be \(L,\) as times \(15,\), got \(3,\)"),
        (select, (*MANY, 0.0), "noise must be > 0, got 0"),
    ],
)
def test_arguments_without_a_fit_are_rejected_in_one_line(function, arguments, message):
    with pytest.raises(ValueError, match=message):
        function(*arguments)
