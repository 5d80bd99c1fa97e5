"""Smoothing of paths: gradients, a lower cost, fixed ends, and paths that are not changed."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dubins import dubins, sample_dubins

from planner_jax.baselines.intercept import path_smoothing
from planner_jax.plane.make_obstacles import obstacles
from planner_jax.plane.obstacles import separation

CURVATURE, BODY = 2.0, (-0.05, 0.35, 0.125)
NUM = 65
SETTINGS = path_smoothing.Smoothing(stride=2, iterations=60)
WALLS = [[(0.8, 4.0), (1.6, 4.0), (1.2, 4.8)], [(3.0, 0.6), (4.0, 0.6), (3.5, 1.0)]]
START = np.array([0.8, 2.0, 0.2])
GOALS = np.array([[6.0, 2.5, -0.4], [6.0, 4.5, 1.0], [5.5, 0.8, -2.0], [3.5, 6.0, 2.0]])


def walls_of(polygons=WALLS):
    return obstacles(polygons, dtype=jnp.result_type(float))


def paths(goals):
    def one(goal):
        path = dubins(jnp.asarray(START), goal, 0.8 * CURVATURE)
        poses = sample_dubins(path, NUM)
        spacing = path.length / (NUM - 1)
        curvatures = jnp.diff(poses[:, 2]) / spacing
        return poses, jnp.append(curvatures, curvatures[-1]), path.length

    return jax.vmap(one)(goals)


def smooth(poses, curvatures, length, walls):
    car = {"curvature": jnp.asarray(CURVATURE), "body": BODY}
    box = {"lower": jnp.zeros(2), "upper": jnp.full(2, 8.0)}
    path = poses, curvatures, length
    return path_smoothing.smooth_path(*path, walls, **car, **box, settings=SETTINGS)


@jax.jit
def cost(points, unit, walls):
    return path_smoothing.smoothing_cost(points, unit, walls, CURVATURE)


cost_and_slope = jax.jit(jax.value_and_grad(cost))


@jax.jit
def descend(points, walls):
    settings = path_smoothing.Smoothing(iterations=5)
    return path_smoothing.smooth_points(points, walls, CURVATURE, settings)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None))
def gaps(poses, walls):
    x, y, heading = poses.T
    return separation(walls.vertices(0.0), walls.present, x[None], y[None], heading, BODY)


all_smooth = jax.jit(jax.vmap(smooth, in_axes=(0, 0, 0, None)))


@pytest.fixture(scope="module")
def batch():
    given = jax.jit(paths)(jnp.asarray(GOALS, jnp.float32))
    return jax.tree.map(np.asarray, (given, all_smooth(*given, walls_of())))


@pytest.fixture
def crooked():
    rng = np.random.default_rng(0)
    line = np.stack([np.linspace(0.5, 5.5, 24), np.full(24, 1.3)], axis=1)
    return line + rng.normal(0.0, 0.06, line.shape)


def test_the_gradient_of_the_cost_matches_finite_differences(crooked, float64):
    walls = walls_of()
    unit = np.float64(0.21)
    slope = np.asarray(cost_and_slope(crooked, unit, walls)[1])
    for direction in np.random.default_rng(1).normal(size=(20, *crooked.shape)):
        moved = (crooked + step * direction for step in (1e-6, -1e-6))
        ahead, back = (float(cost_and_slope(points, unit, walls)[0]) for points in moved)
        assert np.sum(slope * direction) == pytest.approx((ahead - back) / 2e-6, rel=1e-5)


def test_terms_have_their_closed_forms(float64):
    nothing, settings = walls_of([]), path_smoothing.Smoothing()
    line = np.stack([np.arange(9.0), np.zeros(9)], axis=1)
    assert cost(line, 1.0, nothing) == 0.0
    # The path turns by 90 degrees, so that the unit vectors along it differ by sqrt(2) there.
    steps = 0.5 * np.arange(-4.0, 5.0)
    corner = np.stack([np.minimum(steps, 0.0), np.maximum(steps, 0.0)], axis=1)
    excess = np.pi / 2 - CURVATURE * 0.5
    expected = settings.curvature * excess**2 + settings.smoothness * 2.0
    assert cost(corner, 0.5, nothing) == pytest.approx(expected)
    wall = walls_of([[(-9.0, -1.0), (9.0, -1.0), (9.0, 0.0), (-9.0, 0.0)]])
    found = cost(line + [0.0, 0.2], 0.1, wall)
    assert found == pytest.approx(settings.obstacle * 9 * (5.0 - 2.0) ** 2)


def test_smoothing_lowers_the_cost_and_holds_the_ends(crooked, float64):
    walls, unit = walls_of(), np.linalg.norm(np.diff(crooked, axis=0), axis=1).mean()
    costs, moved = [cost_and_slope(crooked, unit, walls)[0]], crooked
    for times in (1, 11):
        for _ in range(times):
            moved = descend(moved, walls)
        np.testing.assert_array_equal(moved[:2], crooked[:2])
        np.testing.assert_array_equal(moved[-2:], crooked[-2:])
        costs.append(cost_and_slope(moved, unit, walls)[0])
    assert costs[0] > 2.0 * costs[1] > 2.0 * costs[2] > 0.0


def test_the_spline_of_an_arc_is_that_arc(float64):
    angle = np.linspace(0.0, 2.0, 17)
    given = np.stack([np.sin(angle), 1.0 - np.cos(angle), angle], axis=1)

    @jax.jit
    def spline(poses):
        points = path_smoothing.control_points(poses, jnp.ones(17))
        return path_smoothing.resample(points, 0.0, 2.0, 41)

    poses, curvature, length = jax.tree.map(np.asarray, spline(given))
    even = np.linspace(0.0, 2.0, 41)
    expected = np.stack([np.sin(even), 1.0 - np.cos(even), even], axis=1)
    np.testing.assert_allclose(poses, expected, atol=2e-3)
    np.testing.assert_allclose(poses[::40], expected[::40], atol=1e-12)
    np.testing.assert_allclose(curvature, 1.0, atol=0.02)
    assert length == pytest.approx(2.0, abs=1e-3)


@pytest.mark.slow
def test_smooth_paths_have_their_ends_and_keep_clear_within_the_curvature(batch):
    (given, _, _), found = batch
    assert found.is_smooth.all() and (found.share > 0.0).any()
    np.testing.assert_allclose(found.poses[:, 0], given[:, 0], atol=1e-5)
    np.testing.assert_allclose(found.poses[:, -1, :2], given[:, -1, :2], atol=1e-5)
    turned = found.poses[:, -1, 2] - given[:, -1, 2]
    np.testing.assert_allclose(np.sin(0.5 * turned), 0.0, atol=1e-5)
    assert (np.abs(found.curvature) <= CURVATURE * 1.001).all()
    assert np.asarray(gaps(found.poses, walls_of())).min() > 0.0


def test_poses_are_equally_far_apart_and_turn_by_their_curvature(batch):
    found = batch[1]
    spacing = found.length[:, None] / (NUM - 1)
    steps = np.diff(found.poses, axis=1)
    lengths = np.hypot(steps[..., 0], steps[..., 1])
    np.testing.assert_allclose(lengths, spacing * np.ones(64), rtol=0.01)
    mean = 0.5 * (found.curvature[:, 1:] + found.curvature[:, :-1])
    np.testing.assert_allclose(steps[..., 2], mean * spacing, atol=0.01)


def test_a_path_that_cannot_be_smoothed_is_returned_and_others_stay(batch):
    (poses, curvatures, length), found = batch
    poses, length = poses.copy(), length.copy()
    poses[1] = poses[0] + np.array([0.0, -1.4, 0.0])
    poses[2], length[2] = np.nan, np.inf
    again = jax.tree.map(np.asarray, all_smooth(poses, curvatures, length, walls_of()))
    np.testing.assert_array_equal(again.is_smooth, [True, False, False, True])
    np.testing.assert_array_equal(again.poses[1], poses[1])
    assert np.isnan(again.poses[2]).all() and again.length[2] == np.inf
    np.testing.assert_allclose(again.poses[[0, 3]], found.poses[[0, 3]], atol=1e-5)


def test_an_invalid_number_of_poses_is_rejected():
    with pytest.raises(ValueError, match="poses must be 2 k"):
        smooth(jnp.zeros((64, 3)), jnp.zeros(64), jnp.asarray(1.0), walls_of())
