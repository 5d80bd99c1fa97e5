"""Observation of balls: camera, stereo noise, colour masks, fitted paths, hand-eye calibration."""

import colorsys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from planner_jax.ball.estimation import EkfModel, ekf_init, ekf_predict, ekf_update
from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.benchmarks.rendered_balls import segment
from planner_jax.benchmarks.rendered_balls.calibrate import calibrate, hand_eye, pose, rigid_motion
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
sighting_one = jax.jit(segment.sighting)


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


def test_hue_saturation_and_value_are_those_of_the_standard_library():
    rng = np.random.default_rng(0)
    greys, pure = np.repeat([[0], [7], [255]], 3, 1), np.eye(3) * 255
    colours = np.concatenate([rng.integers(0, 256, (300, 3)), greys, pure]).astype(np.float32) / 255
    found = jax.jit(segment.hue_saturation_value)(colours)
    expected = [colorsys.rgb_to_hsv(*map(float, colour)) for colour in colours]
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("hues", [(0.02, 0.13), (0.9, 0.1)])
def test_the_mask_compares_hue_saturation_and_value(hues):
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (40, 50, 3)).astype(np.uint8)
    look = segment.ball_thresholds((hues[0], 0.4, 0.3), (hues[1], 0.9, 0.95))
    hsv = np.asarray(segment.hue_saturation_value(image.astype(np.float32) / 255.0), float)
    edges = np.stack([look.lower, look.upper])
    near = (np.abs(hsv[:, :, None] - edges) < 1e-5).any(axis=(2, 3))  # rounding decides there
    combine = np.logical_or if hues[0] > hues[1] else np.logical_and
    hue = combine(hsv[..., 0] >= hues[0], hsv[..., 0] <= hues[1])
    others = [(hsv[..., k] >= look.lower[k]) & (hsv[..., k] <= look.upper[k]) for k in (1, 2)]
    expected = hue & others[0] & others[1]
    found = np.asarray(segment.colour_mask(image, look))
    np.testing.assert_array_equal(found[~near], expected[~near])
    assert 20 < expected.sum() < 1000


def ball_frame(place, radius=0.05):
    """Render image and depth of an orange ball at a position (3,) [m] before a grey wall."""
    column, row = np.meshgrid(*(np.arange(size) for size in CAMERA.size))
    across = (np.stack([column, row], axis=-1) - CAMERA.centre[None, None]) / CAMERA.focal
    ray = np.concatenate([across, np.ones((*across.shape[:2], 1))], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    middle = np.asarray(CAMERA.rotation).T @ (place - np.asarray(CAMERA.position))
    along = ray @ middle
    gap = radius**2 - (middle @ middle - along**2)
    hit = gap > 0.0
    distance = along - np.sqrt(np.where(hit, gap, 0.0))
    depth = np.where(hit, distance * ray[..., 2], 13.0).astype(np.float32)
    image = np.full((*depth.shape, 3), 128, np.uint8)
    image[hit] = (240, 110, 10)
    return image, depth


@pytest.mark.parametrize("place", [(1.5, 0.4, 1.2), (4.0, 1.0, 1.5), (3.0, -2.0, 2.0)])
def test_a_ball_is_seen_where_it_is(place):
    image, depth = ball_frame(np.array(place))
    found = sighting_one(image, depth, np.ones_like(depth), CAMERA, segment.ball_thresholds())
    pixel, distance = project(CAMERA, jnp.array(place))
    np.testing.assert_allclose(found.pixel, pixel, atol=0.35)
    assert found.depth == pytest.approx(float(distance), abs=0.02)


def test_pixels_of_little_confidence_or_another_depth_are_dropped():
    place = np.array([2.0, 0.3, 1.3])
    image, depth = ball_frame(place)
    clean = sighting_one(image, depth, np.ones_like(depth), CAMERA, segment.ball_thresholds())
    ball = np.argwhere(depth < 12.0)
    wrong = ball[:: len(ball) // 6]
    spoiled, trust = depth.copy(), np.ones_like(depth)
    spoiled[tuple(wrong[::2].T)] *= 1.8  # confident, but elsewhere
    spoiled[tuple(wrong[1::2].T)] *= 1.02
    trust[tuple(wrong[1::2].T)] = 0.1
    image[:3, :2] = image[tuple(ball[0])]  # as if something far away had the colour
    found = sighting_one(image, spoiled, trust, CAMERA, segment.ball_thresholds())
    assert found.pixels == clean.pixels - len(wrong)
    np.testing.assert_allclose(found.place, clean.place, atol=0.02)


def test_a_frame_without_the_ball_shows_nothing():
    image, depth = ball_frame(np.array([2.0, 0.3, 1.3]))
    trust, grey, unknown = np.ones_like(depth), np.full_like(image, 90), np.full_like(depth, np.nan)
    frames = [(grey, depth, trust), (image, unknown, trust), (image, depth, 0.0 * trust)]
    for frame in (*frames, (image, 20.0 * depth, trust)):
        found = sighting_one(*frame, CAMERA, segment.ball_thresholds())
        assert found.pixels == 0 and np.isnan(found.place).all() and np.isnan(found.depth)


def test_noisy_depth_images_have_the_noise_that_is_asked_for():
    noise = stereo_noise(disparity_std=0.0, speckle_std=0.05, mismatch=0.02, dropout=0.1)
    depth = jnp.full((192, 320), 3.0)
    found, trust = jax.jit(segment.noisy_depth)(jax.random.key(0), CAMERA, noise, depth)
    assert np.isnan(found).mean() == pytest.approx(0.1, abs=0.01)
    believed_in = np.asarray(found)[(np.asarray(trust) > 0.6) & np.isfinite(found)]
    expected = 9.0 * 0.05 / (CAMERA.focal * 0.12)
    assert believed_in.std() == pytest.approx(float(expected), rel=0.05)
    common = stereo_noise(speckle_std=0.0, mismatch=0.0, dropout=0.0)
    found, _ = jax.jit(segment.noisy_depth)(jax.random.key(0), CAMERA, common, depth)
    assert found.std() < 1e-5 and abs(found[0, 0] - 3.0) > 1e-3


def views(rng, std, num=12):
    facing = Rotation.from_matrix(np.asarray(CAMERA.rotation, float)).as_matrix()
    camera = pose(facing, np.asarray(CAMERA.position, float))
    board = pose(Rotation.from_rotvec([0.2, -0.4, 1.0]).as_matrix(), np.array([0.02, 0.05, 0.1]))
    turns = Rotation.from_rotvec(rng.uniform(-0.8, 0.8, (num, 3))).as_matrix()
    places = rng.uniform([0.4, -0.5, 0.5], [1.2, 0.5, 1.2], (num, 3))
    flange = pose(turns, places)
    grid = np.arange(4) * 0.08
    points = np.stack([*np.meshgrid(grid, grid), np.zeros((4, 4))], axis=-1).reshape(-1, 3)
    to_camera = np.linalg.inv(camera) @ flange @ board
    where = points @ np.swapaxes(to_camera[:, :3, :3], 1, 2) + to_camera[:, None, :3, 3]
    return camera, board, flange, points, where + std * rng.normal(size=where.shape)


def test_calibration_finds_camera_and_board_exactly():
    camera, board, flange, points, where = views(np.random.default_rng(0), 0.0)
    found = calibrate(flange, points, where)
    np.testing.assert_allclose(found.camera, camera, atol=1e-9)
    np.testing.assert_allclose(found.board, board, atol=1e-9)
    boards = np.stack([rigid_motion(points, each) for each in where])
    np.testing.assert_allclose(hand_eye(flange, boards), camera, atol=1e-9)


def test_refinement_is_nearer_than_the_closed_form_and_knows_its_noise():
    rng = np.random.default_rng(1)
    std = np.array([0.001, 0.001, 0.006])  # [m], along the camera's axes
    off = []
    for _ in range(10):
        camera, _, flange, points, where = views(rng, std)
        found = calibrate(flange, points, where, std)
        closed = hand_eye(flange, np.stack([rigid_motion(points, each) for each in where]))
        turns = [each[:3, :3].T @ camera[:3, :3] for each in (found.camera, closed)]
        moved = [np.linalg.norm((each - camera)[:3, 3]) for each in (found.camera, closed)]
        off.append([Rotation.from_matrix(turns).magnitude(), moved])
        assert found.residual == pytest.approx(1.0, abs=0.15)
    (turned, moved) = np.median(off, axis=0)
    assert turned[0] < 0.5 * turned[1] and moved[0] < 0.5 * moved[1]
    assert turned[0] < 2e-3 and moved[0] < 2e-3


def test_too_little_to_calibrate_from_is_refused_in_a_line():
    camera, _, flange, points, where = views(np.random.default_rng(2), 0.0)
    with pytest.raises(ValueError, match="turn about different axes, got 2"):
        calibrate(flange[:2], points, where[:2])
    with pytest.raises(ValueError, match="must not lie on one line"):
        rigid_motion(points[:4], where[0, :4])
    turns = Rotation.from_rotvec(np.outer(np.linspace(0.0, 1.0, 8), [0.0, 0.0, 1.0])).as_matrix()
    about_z = pose(turns, np.zeros((8, 3)))
    with pytest.raises(ValueError, match="turn about different axes, got 8"):
        hand_eye(about_z, np.linalg.inv(camera) @ about_z)
