"""Rendered images of the arm's scene, and measurements from them; skipped without OpenGL."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.ball.flight import drag_free_flight
from planner_jax.benchmarks.rendered_balls import camera as scene_camera
from planner_jax.benchmarks.rendered_balls.board import calibrate_camera, show_board
from planner_jax.benchmarks.rendered_balls.camera import RenderError, SceneCamera, measure_balls
from planner_jax.benchmarks.rendered_balls.segment import ball_thresholds, sighting
from planner_jax.robot.arm_file import irb1600
from planner_jax.sims.perception.camera import project
from planner_jax.sims.perception.flight_fit import belief_at, error_across, fit_flight
from planner_jax.sims.perception.noise import information, stereo_noise
from planner_jax.sims.perception.observation import mast_camera

CAMERA = mast_camera(size=(640, 360))  # small, as a processor alone may render it
GRAVITY = 9.81
see = jax.jit(sighting)


@pytest.fixture(scope="module")
def scene():
    try:
        with SceneCamera(CAMERA, pj.block.paper_scene()) as scene:
            yield scene
    except RenderError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("place", [(1.2, 0.4, 1.2), (2.5, -1.8, 1.0), (3.0, 3.0, 2.2)])
def test_a_rendered_ball_is_measured_at_its_true_position(scene, place):
    image, depth = scene.take(np.array(place))
    found = see(image, depth, np.ones_like(depth), CAMERA, ball_thresholds())
    pixel, distance = project(CAMERA, jnp.array(place))
    np.testing.assert_allclose(found.pixel, pixel, atol=0.3)
    assert found.depth == pytest.approx(float(distance), abs=0.01)


def test_rendered_depths_match_the_scene(scene):
    image, depth = scene.take(None)
    column, row = np.round(project(CAMERA, jnp.array([0.806, 0.0, 1.5]))[0]).astype(int)
    pole = np.array([0.806, 0.0]) - CAMERA.position[:2]
    expected = CAMERA.rotation[:2, 2] @ pole * (1.0 - 0.05 / np.linalg.norm(pole))
    expected = expected + CAMERA.rotation[2, 2] * (1.5 - CAMERA.position[2])
    assert depth[row, column] == pytest.approx(expected, abs=0.01)
    pixel, expected = project(CAMERA, jnp.array([4.0, -2.0, -0.4826]))
    column, row = np.round(pixel).astype(int)
    assert depth[row, column] == pytest.approx(float(expected), rel=0.02)


def test_a_ball_behind_the_pole_or_out_of_view_is_not_seen(scene):
    camera = np.asarray(CAMERA.position)
    behind = camera + 3.0 * (np.array([0.806, 0.0, 1.5]) - camera)
    half_hidden = behind + 0.5 * 0.15 * np.asarray(CAMERA.rotation)[:, 0]
    for place in (behind, half_hidden, np.array([-4.0, 0.0, 1.0]), None):
        image, depth = scene.take(place)
        found = see(image, depth, np.ones_like(depth), CAMERA, ball_thresholds())
        assert found.pixels == 0 and np.isnan(found.place).all()


@pytest.mark.slow
def test_the_error_of_a_flight_fitted_to_images_matches_its_estimated_error(scene):
    cases = pj.block.draw(1, "short", seed=1)
    ball = jax.tree.map(lambda leaf: leaf[0], cases.ball)
    noise = stereo_noise()
    # Only late in the flight does the ball cover enough pixels of this small image.
    times = jnp.arange(10) / 30.0 + 0.4
    places = jax.vmap(drag_free_flight, (None, 0, None))(ball, times, GRAVITY).pos
    seen = measure_balls(scene, np.asarray(places), noise, ball_thresholds(), seed=3)
    assert np.isfinite(seen).all(axis=1).sum() >= 8
    fit = jax.jit(fit_flight)(times, seen, information(CAMERA, noise, jnp.asarray(seen)), GRAVITY)
    truth = drag_free_flight(ball, times[-1], GRAVITY)
    belief = belief_at(fit, times[-1], GRAVITY)
    assert error_across(belief, truth) < 0.05
    assert 0.4 < fit.misfit < 1.8


def test_missing_opengl_is_reported_in_one_line(monkeypatch):
    def none(*_):
        raise ImportError("no library\nmore of it")

    monkeypatch.setattr(scene_camera, "_context_class", lambda: none)
    with pytest.raises(RenderError, match="images need OpenGL .*: no library$") as caught:
        SceneCamera(CAMERA, pj.block.paper_scene())
    assert "\n" not in str(caught.value)


def test_the_camera_is_calibrated_from_a_board_on_the_arm():
    arm, noise = irb1600(), stereo_noise()
    found, calibration = calibrate_camera(arm, CAMERA, noise, 12)
    np.testing.assert_allclose(found.position, CAMERA.position, atol=0.002)
    np.testing.assert_allclose(found.rotation, CAMERA.rotation, atol=0.002)
    assert calibration.residual == pytest.approx(1.0, abs=0.1)
    with pytest.raises(ValueError, match="sees the board in .* of 50 poses, not 40"):
        show_board(arm, CAMERA, noise, 40, draws=50)
