"""Observation of balls: camera, stereo noise and fitted paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from planner_jax.ball.estimation import EkfModel, ekf_init, ekf_predict, ekf_update
from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.sims.perception import flight_fit
from planner_jax.sims.perception.camera import back_project, in_view, looking_at, project
from planner_jax.sims.perception.noise import IsotropicNoise, information, sightings, stereo_noise

GRAVITY = 9.81
NUM = 16
TIMES = np.arange(NUM, dtype=np.float32) / 60.0
STD = 0.02  # [m]
AHEAD = 0.8  # [s], at which flights are compared
BALL = BallState(pos=np.float32([6.8, -1.5, 0.4]), vel=np.float32([-7.7, 1.6, 4.6]))
VIEW = {"size": (320, 192), "field_of_view": np.deg2rad(110.0)}
CAMERA = looking_at((-0.5, 0.1, 1.7), (5.0, 0.4, 1.0), **VIEW)

paths = jax.jit(jax.vmap(drag_free_flight, (None, 0, None)))
fit_one = jax.jit(flight_fit.fit_flight)
fit_many = jax.jit(jax.vmap(flight_fit.fit_flight, (0, 0, 0, None)))
believed = jax.jit(flight_fit.belief_at)


@jax.jit
def errors(fits, truth):
    beliefs = jax.vmap(flight_fit.belief_at, (0, None, None))(fits, AHEAD, GRAVITY)
    stds = jax.vmap(flight_fit.across_std)(beliefs)
    return beliefs, stds, jax.vmap(flight_fit.error_across, (0, None))(beliefs, truth)


def draw_positions(num, rng, std=STD):
    places = np.asarray(paths(BALL, TIMES, GRAVITY).pos)
    return (places + std * rng.normal(size=(num, *places.shape))).astype(np.float32)


def test_float32_finds_a_flight_whose_depths_are_much_less_certain():
    turn = Rotation.from_rotvec([0.4, -0.8, 0.3]).as_matrix()
    weights = turn @ np.diag([1e6, 1e6, 1e2]) @ turn.T
    weights = np.tile(weights.astype(np.float32), (NUM, 1, 1))
    fit = fit_one(TIMES, paths(BALL, TIMES, GRAVITY).pos, weights, GRAVITY)
    ahead = believed(fit, AHEAD, GRAVITY)
    truth = drag_free_flight(BALL, AHEAD, GRAVITY)
    np.testing.assert_allclose(ahead.mean[:3], truth.pos, atol=1e-4)
    assert fit.misfit < 0.05


@pytest.mark.slow
def test_the_covariance_is_that_of_many_fits():
    rng = np.random.default_rng(0)
    num = 4000
    weights = np.full(num, np.float32(STD**-2))
    fits = fit_many(np.tile(TIMES, (num, 1)), draw_positions(num, rng), weights, GRAVITY)
    truth = drag_free_flight(BALL, AHEAD, GRAVITY)
    beliefs, stds, off = errors(fits, truth)
    off_mean = np.asarray(beliefs.mean) - np.concatenate([truth.pos, truth.vel])
    expected = np.asarray(beliefs.covariance[0])
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(off_mean.T) / scale, expected / scale, atol=0.06)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(float(stds[0]), rel=0.04)
    assert np.sqrt(np.mean(fits.misfit**2)) == pytest.approx(1.0, abs=0.02)


def test_the_estimate_is_that_of_polynomials():
    """With equal weights, lines in time fit x, y and z + g t^2 / 2 [Natarajan2024, eq. 8]."""
    places = draw_positions(1, np.random.default_rng(1))[0]
    fit = fit_one(TIMES, places, 1.0, GRAVITY)
    assert fit.status == flight_fit.Sight.SEEN and fit.num == NUM
    there = believed(fit, 0.0, GRAVITY)
    fallen = places.astype(float)
    fallen[:, 2] += 0.5 * GRAVITY * TIMES**2
    slopes, heights = np.polyfit(TIMES, fallen, 1)
    np.testing.assert_allclose(there.mean, np.concatenate([heights, slopes]), rtol=1e-4, atol=1e-4)


def test_what_is_not_seen_leaves_no_trace():
    places, weights = draw_positions(1, np.random.default_rng(2))[0], np.ones(NUM, np.float32)
    keep = np.delete(np.arange(NUM), [3, 8, 12])
    alone = fit_one(TIMES[keep], places[keep], weights[keep], GRAVITY)
    places[3], places[8, 1], weights[12] = np.nan, np.inf, 0.0
    fit = fit_one(TIMES, places, weights, GRAVITY)
    assert fit.num == len(keep)
    np.testing.assert_allclose(fit.belief.mean, alone.belief.mean, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(fit.belief.covariance, alone.belief.covariance, rtol=1e-3, atol=1e-5)


def test_a_ball_that_is_not_seen_at_two_times_has_a_status_and_a_sentence():
    places = draw_positions(1, np.random.default_rng(4))[0]
    never, once = np.full_like(places, np.nan), np.full_like(places, np.nan)
    once[7] = places[7]
    for given, status in ((never, flight_fit.Sight.NEVER_SEEN), (once, flight_fit.Sight.SEEN_ONCE)):
        fit = fit_one(TIMES, given, 1.0, GRAVITY)
        assert fit.status == status and np.isnan(fit.belief.mean).all() and np.isnan(fit.misfit)
    assert "never sees the ball" in flight_fit.Sight.NEVER_SEEN.message
    same_time = np.full_like(TIMES, 0.3)
    assert fit_one(same_time, places, 1.0, GRAVITY).status == flight_fit.Sight.SEEN_ONCE


@pytest.mark.parametrize("away", [0.0, np.array([5e5, 4e6, 0.0])], ids=["here", "UTM"])
@pytest.mark.parametrize("begin", [0.0, 1e6, 1.7e9])
def test_a_flight_at_any_time_and_place_has_the_same_fit(begin, away):
    places = draw_positions(1, np.random.default_rng(7))[0].astype(float)
    places[:2] = np.nan
    times = np.arange(NUM) / 64.0
    usual = flight_fit.fit_flight(times, places, STD**-2, GRAVITY)
    fit = flight_fit.fit_flight(times + begin, places + away, STD**-2, GRAVITY)
    assert fit.status == flight_fit.Sight.SEEN
    np.testing.assert_allclose(fit.belief.mean[3:], usual.belief.mean[3:], atol=2e-5)
    there = flight_fit.belief_at(fit, begin + AHEAD, GRAVITY).mean[:3]
    np.testing.assert_allclose(there - away, believed(usual, AHEAD, GRAVITY).mean[:3], atol=2e-5)
    np.testing.assert_allclose(fit.misfit, usual.misfit, rtol=1e-3)


@pytest.mark.parametrize("begin, away", [(1e6, 0.0), (1.7e9, 0.0), (0.0, 4e6)])
def test_a_fit_that_float32_makes_wrong_is_not_called_seen(begin, away):
    places = draw_positions(1, np.random.default_rng(7))[0]
    fit = fit_one(TIMES + np.float32(begin), places + np.float32(away), STD**-2, GRAVITY)
    assert fit.status != flight_fit.Sight.SEEN
    assert "float64" in flight_fit.Sight.IMPRECISE.message


def test_the_fit_is_what_a_kalman_filter_with_a_wide_prior_comes_to(float64):
    places = jnp.asarray(draw_positions(1, np.random.default_rng(5))[0], jnp.float64)
    model = EkfModel(jnp.zeros(3), jnp.asarray(GRAVITY), jnp.asarray(0.0), jnp.asarray(STD))
    state = ekf_init(places[0], jnp.zeros(3), pos_std=jnp.asarray(1e3), vel_std=jnp.asarray(1e4))

    def advance(state, given):
        duration, place = given
        return ekf_update(ekf_predict(state, duration, model), place, model), None

    filtered, _ = jax.jit(lambda: jax.lax.scan(advance, state, (jnp.full(NUM, 1 / 60.0), places)))()
    fit = fit_one(jnp.arange(NUM) / 60.0, places, STD**-2, GRAVITY)
    last = believed(fit, (NUM - 1) / 60.0, GRAVITY)
    np.testing.assert_allclose(filtered.mean, last.mean, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(filtered.covariance, last.covariance, rtol=1e-5, atol=1e-8)


def test_gradients_of_a_fit_are_finite_with_and_without_a_ball():
    places = draw_positions(1, np.random.default_rng(6))[0]
    places[3] = np.nan

    def across(places):
        fit = flight_fit.fit_flight(TIMES, places, 1.0, GRAVITY)
        ahead = flight_fit.belief_at(fit, AHEAD, GRAVITY)
        return flight_fit.across_std(ahead) + jnp.sum(fit.ball.pos)

    found = jax.jit(jax.grad(across))(places)
    assert np.isfinite(found).all() and np.abs(found[4]).max() > 0.01
    np.testing.assert_allclose(found[3], 0.0)


def test_points_come_back_from_their_pixels_and_the_target_is_in_the_middle():
    rng = np.random.default_rng(0)
    points = rng.uniform([0.5, -4.0, -1.0], [12.0, 4.0, 4.0], (50, 3)).astype(np.float32)
    np.testing.assert_allclose(back_project(CAMERA, *project(CAMERA, points)), points, atol=2e-5)
    pixel, depth = project(CAMERA, jnp.array([5.0, 0.4, 1.0]))
    np.testing.assert_allclose(pixel, CAMERA.centre, atol=1e-3)
    assert depth == pytest.approx(np.linalg.norm([5.5, 0.3, -0.7]), rel=1e-5)
    left, _ = project(CAMERA, jnp.array([5.0, 1.4, 1.0]))  # it looks along +x
    above, _ = project(CAMERA, jnp.array([5.0, 0.4, 2.0]))
    assert left[0] < pixel[0] and above[1] < pixel[1]
    assert np.linalg.det(CAMERA.rotation) == pytest.approx(1.0, abs=1e-5)


def test_the_field_of_view_ends_where_it_should():
    half, far = np.deg2rad(55.0), 10.0
    forward = np.asarray(CAMERA.rotation) @ np.array([0.0, 0.0, far])
    right = np.asarray(CAMERA.rotation) @ np.array([far * np.tan(half), 0.0, 0.0])
    points = CAMERA.position + np.stack([forward + share * right for share in (0.99, 1.01, -0.99)])
    behind = CAMERA.position - forward
    found = in_view(CAMERA, jnp.asarray(np.vstack([points, behind]), jnp.float32))
    assert found.tolist() == [True, False, True, False]


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (looking_at, {"target": (1.0, 2.0, 9.0)}, "target must be beside the camera"),
        (looking_at, {"field_of_view": 3.5}, "field_of_view must be between 0 and pi, got 3.5"),
        (looking_at, {"size": (0, 4)}, "size must be >= 1"),
        (stereo_noise, {"baseline": 0.0}, "baseline must be > 0, got 0"),
        (stereo_noise, {"dropout": 1.0}, "dropout must be < 1, got 1"),
        (stereo_noise, {"pixel_std": -0.1}, "pixel_std must be >= 0, got -0.1"),
    ],
)
def test_a_camera_or_noise_that_cannot_be_is_refused_in_a_line(make, options, message):
    usual = {"position": (1.0, 2.0, 3.0), "target": (5.0, 0.0, 1.0), **VIEW}
    with pytest.raises(ValueError, match=message) as caught:
        make(**(usual if make is looking_at else {}) | options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "noise", [stereo_noise(dropout=0.0, disparity_std=0.02), IsotropicNoise(std=jnp.asarray(0.02))]
)
def test_the_information_of_a_sighting_is_the_inverse_of_its_covariance(noise):
    place = jnp.array([4.0, 1.0, 1.5])
    many = jax.jit(sightings)(jax.random.key(0), CAMERA, noise, jnp.broadcast_to(place, (40000, 3)))
    expected = np.linalg.inv(np.asarray(information(CAMERA, noise, place), float))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(many.T) / scale, expected / scale, atol=0.03)
    if isinstance(noise, IsotropicNoise):
        np.testing.assert_allclose(expected, 4e-4 * np.eye(3), rtol=1e-5)


def test_what_is_lost_or_out_of_view_is_not_seen():
    see, key = jax.jit(sightings), jax.random.key(1)
    inside = jnp.broadcast_to(jnp.array([4.0, 1.0, 1.5]), (2000, 3))
    lost = np.isnan(see(key, CAMERA, stereo_noise(dropout=0.3), inside)).any(axis=1)
    assert lost.mean() == pytest.approx(0.3, abs=0.04)
    behind = inside * jnp.array([[-1.0, 1.0, 1.0]])
    assert np.isnan(see(key, CAMERA, stereo_noise(), behind)).all()
