"""Predictions of targets from noisy observations, and how uncertain they are stated to be."""

import chex
import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.errors import ArgumentError

TIMES = np.arange(-14.0, 1.0)  # [s]
NOISE, SPEED = 0.1, np.array([0.4, 0.0])  # [m], [m/s]
predict = pj.intercept.predict


@jax.jit
def positions_at(paths, time):
    return jax.vmap(lambda path: path.at(time).pos)(paths)


def places(path, time):
    """Return positions of one path, or of a batch of paths, at one time."""
    if path.ahead.shape:
        return np.asarray(positions_at(path, time))
    return np.asarray(positions_at(jax.tree.map(lambda leaf: leaf[None], path), time)[0])


def observe(positions, seed=0):
    return positions + np.random.default_rng(seed).normal(0.0, NOISE, positions.shape)


def straight(times=TIMES):
    return np.asarray(times)[:, None] * SPEED


def turn(times, rate=0.3):
    radius = SPEED[0] / rate
    return radius * np.stack([np.sin(rate * times), 1.0 - np.cos(rate * times)], axis=-1)


STOP = straight(np.minimum(TIMES, -4.0))
REVERSAL = straight(-5.0 - np.abs(TIMES + 5.0))
CORNER = straight(np.minimum(TIMES, -5.0)) + np.maximum(TIMES + 5.0, 0.0)[:, None] * SPEED[::-1]
ENDS = {"stop": [-1.6, 0.0], "reversal": [-8.0, 0.0], "corner": [-2.0, 6.0]}  # [m] at 10 s
MANOEUVRES = {"stop": (STOP, -4.0), "reversal": (REVERSAL, -5.0), "corner": (CORNER, -5.0)}


def test_a_straight_target_is_predicted_with_a_small_disc_and_no_change():
    found = predict(TIMES, observe(straight()))
    error = np.linalg.norm(places(found.path, 10.0) - 10.0 * SPEED)
    assert error < 0.6 and error < found.radius(10.0)
    assert not found.has_changed and np.isnan(found.since)
    assert found.noise == pytest.approx(NOISE, rel=0.5)
    radii = found.radius(np.array([0.0, 1.0, 3.0, 10.0]))
    assert np.all(np.diff(radii) > 0.0) and radii[0] < 3.0 * NOISE
    assert found.radius(3.0, share=0.5) < found.radius(3.0, share=0.99)


@pytest.mark.parametrize("name", MANOEUVRES)
def test_a_manoeuvre_is_noticed_and_the_prediction_follows_the_new_motion(name):
    positions, since = MANOEUVRES[name]
    found = predict(TIMES, np.stack([observe(positions, seed) for seed in range(20)]), NOISE)
    assert np.mean(found.has_changed) >= 0.9
    assert np.nanmedian(found.since) == pytest.approx(since, abs=1.2)
    errors = np.linalg.norm(places(found.path, 10.0) - np.array(ENDS[name]), axis=-1)
    assert np.sqrt(np.mean(errors**2)) < 1.0  # a line through all observations is 2 m or more off
    assert np.mean(errors <= found.radius(np.full(20, 10.0))) >= 0.85


def test_a_steady_turn_is_followed():
    found = predict(TIMES, observe(turn(TIMES)))
    assert found.has_changed and found.since < -13.0
    assert np.linalg.norm(places(found.path, 5.0) - turn(np.array(5.0))) < 0.5


@pytest.mark.parametrize("index", [3, 8, 13, 14])
def test_one_outlier_hardly_moves_the_prediction(index):
    positions = observe(straight())
    clean = places(predict(TIMES, positions).path, 10.0)
    positions[index, 1] += 4.0
    found = predict(TIMES, positions)
    assert np.linalg.norm(places(found.path, 10.0) - clean) < 0.7
    assert not found.has_changed


@pytest.mark.parametrize("scale", [1e3, 1e-3])
def test_units_and_a_distant_origin_do_not_change_the_prediction(scale):
    positions, offset = observe(CORNER), np.array([4.5e5, 5.4e6])
    here, there = predict(TIMES, positions), predict(TIMES + 1e6, scale * (positions + offset))
    np.testing.assert_allclose(there.radius(3.0), scale * here.radius(3.0), rtol=1e-4)
    np.testing.assert_allclose(there.since, here.since, rtol=1e-4)
    moved = there.path.pos - scale * offset
    np.testing.assert_allclose(moved, scale * here.path.pos, atol=1e-5 * scale)
    np.testing.assert_allclose(there.path.vel, scale * here.path.vel, atol=1e-5 * scale)


def test_order_and_absent_observations_do_not_matter():
    rng = np.random.default_rng(1)
    times = np.sort(rng.uniform(-6.0, 0.0, 12))
    positions = observe(straight(times))
    expected = predict(times, positions)
    order = rng.permutation(14)
    more = np.append(times, [np.nan, -1.0])[order]
    seen = np.vstack([positions, [1.0, 1.0], [np.nan, 2.0]])[order]
    found = predict(more, seen)
    chex.assert_trees_all_equal(found.path, expected.path)
    assert found.radius(3.0) == expected.radius(3.0)


def test_a_batch_equals_a_loop_over_its_targets():
    seen = np.stack([observe(each) for each in (straight(), STOP, turn(TIMES), straight(), STOP)])
    seen[3, 4:9], seen[4, 1:], seen[0, 2:] = np.nan, np.nan, np.nan
    batch = predict(TIMES, seen)
    radii = batch.radius(np.full(5, 3.0))
    for k, positions in enumerate(seen):
        one = predict(TIMES, positions)
        assert batch.has_changed[k] == one.has_changed and radii[k] == pytest.approx(
            one.radius(3.0)
        )
        path = jax.tree.map(lambda leaf, k=k: leaf[k], batch.path)
        chex.assert_trees_all_close(path, one.path, rtol=1e-9, atol=1e-12)


def test_a_turn_is_expected_to_last_as_long_again():
    rate, after, vel = 0.4, 5.0, SPEED[0]
    decay = 1.0 / 14.0 - 1j * rate  # the turn has lasted for 14 s
    ended = (1.0 / 14.0) / decay
    expected = vel * (ended * after + (1.0 - ended) * (1.0 - np.exp(-decay * after)) / decay)
    found = places(predict(TIMES, turn(TIMES, rate), 1e-3).path, after)
    np.testing.assert_allclose(found, [expected.real, expected.imag], atol=0.02)


def test_a_sudden_start_after_calm_motion_is_no_outlier():
    positions = straight() + np.maximum(TIMES + 1.0, 0.0)[:, None] * 2.0 * SPEED[::-1]
    found = predict(TIMES, positions)
    # The expected velocity also weighs the hypothesis of an outlier.
    assert found.has_changed and found.path.vel.sum(axis=0)[1] > 0.3 * 2.0 * SPEED[0]


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_a_usual_speed_widens_the_disc_of_a_slow_target_alone(scale):
    still, moving = scale * observe(np.zeros((15, 2))), scale * observe(straight())
    radii = [
        [float(predict(TIMES, seen, speed=speed).radius(3.0)) for speed in (None, 0.3 * scale)]
        for seen in (still, moving)
    ]
    assert radii[0][1] > 1.5 * radii[0][0]
    assert radii[1][1] < radii[1][0]  # the usual speed is known not to exceed the observed one


def test_discs_hold_their_share_of_targets_with_random_accelerations():
    rng, num, step = np.random.default_rng(2), 300, 0.4
    volatility = rng.choice([0.03, 0.1, 0.3], (num, 1, 1))
    vel = np.empty((num, 16, 2))
    vel[:, 0] = rng.normal(0.0, 1.0, (num, 2))
    push = volatility * np.sqrt(step) * rng.normal(0.0, 1.0, vel.shape)
    for i in range(1, vel.shape[1]):
        vel[:, i] = vel[:, i - 1] * np.exp(-0.5 * volatility[:, 0] ** 2 * step) + push[:, i]
    positions = step * np.cumsum(vel, axis=1)
    seen = positions[:, :11] + rng.normal(0.0, 0.03, (num, 11, 2))
    found = predict(step * np.arange(-10.0, 1.0), seen)
    errors = np.linalg.norm(places(found.path, 5 * step) - positions[:, 15], axis=-1)
    for share, least, most in ((0.5, 0.45, 0.75), (0.9, 0.87, 0.98)):
        assert least < np.mean(errors <= found.radius(np.full(num, 5 * step), share)) < most


def test_time_zero_is_the_last_observation_or_now():
    seen = observe(straight())
    last, later = predict(TIMES + 100.0, seen), predict(TIMES + 100.0, seen, now=102.0)
    np.testing.assert_allclose(places(later.path, 1.0), places(last.path, 3.0), rtol=1e-5)
    assert later.radius(1.0) == last.radius(3.0)
    stopped = predict(TIMES + 100.0, observe(STOP), now=102.0)
    assert stopped.since == pytest.approx(-6.0, abs=1.2)
    before = places(last.path, -1.0) - places(last.path, 0.0)
    np.testing.assert_allclose(before, -last.path.vel.sum(axis=0), rtol=1e-4)


def test_the_velocity_of_a_path_is_the_derivative_of_its_position():
    path = predict(TIMES, observe(turn(TIMES))).path
    with jax.enable_x64(True):
        for time in (-1.0, 1e-3, 0.7, 8.0):
            change = path.at(time + 1e-5).pos - path.at(time - 1e-5).pos
            np.testing.assert_allclose(path.at(time).vel, change / 2e-5, rtol=1e-5, atol=1e-7)


def test_one_observation_stands_with_an_infinite_disc():
    for times in ([2.0], [2.0, 2.0]):
        found = predict(times, np.full((len(times), 2), 3.0))
        np.testing.assert_allclose(places(found.path, 5.0), [3.0, 3.0])
        assert np.isinf(found.radius(5.0)) and not found.has_changed
    still = predict(TIMES, np.full((15, 2), 7.0))
    assert still.radius(5.0) < 1e-6
    np.testing.assert_allclose(places(still.path, 5.0), [7.0, 7.0])


def test_a_prediction_is_the_target_of_a_case():
    found = predict(TIMES, observe(straight()), now=0.0)
    case = pj.intercept.case(found.path)
    np.testing.assert_allclose(case.target.at(2.0).pos, places(found.path, 2.0), rtol=1e-5)


SEEN = straight()
TWO = np.stack([SEEN, np.full_like(SEEN, np.nan)])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            (TIMES, SEEN[:, :1]),
            r"positions must be of the shape \(L, 2\) or \(B, L, 2\), got \(15, 1\)",
        ),
        ((TIMES[:3], SEEN), r"times must be of the shape \(15,\), as positions, got \(3,\)"),
        ((TIMES, TWO), "positions must be of at least one observation, got none at index 1"),
        ((TIMES, SEEN[:0]), r"times must be"),
        ((TIMES[:0], SEEN[:0]), "positions must be of at least one observation, got none"),
        ((TIMES, SEEN + np.inf), "positions must be finite, or NaN if absent, got inf"),
        ((TIMES, SEEN, 0.0), "noise must be finite and > 0, got 0"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ArgumentError, match=message):
        predict(*arguments)


def test_times_and_shares_out_of_range_are_named():
    with pytest.raises(ArgumentError, match="now must be finite, got nan"):
        predict(TIMES, SEEN, now=np.nan)
    with pytest.raises(ArgumentError, match="speed must be finite and > 0, got 0"):
        predict(TIMES, SEEN, speed=0.0)
    with pytest.raises(ArgumentError, match="share must be > 0 and < 1, got 1"):
        predict(TIMES, SEEN).radius(1.0, share=1.0)
