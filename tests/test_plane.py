"""Obstacles and targets in the plane, and the states that a car can reach among them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import recursion
from derivatives import assert_gradient_matches_differences

import planner_jax as pj
from planner_jax.plane import reach
from planner_jax.plane.distance_field import distance_field
from planner_jax.plane.obstacles import distances, separation

SQUARE = [[2.0, 2.0], [3.0, 2.0], [3.0, 3.0], [2.0, 3.0]]


def brute_distance(polygon, point, num=4000):
    """Return the distance to the nearest of many points of a polygon's boundary."""
    share = np.linspace(0.0, 1.0, num)[:, None]
    ends = np.roll(polygon, -1, axis=0)
    along = [a + share * (b - a) for a, b in zip(polygon, ends, strict=True)]
    return np.linalg.norm(np.concatenate(along) - point, axis=1).min()


def test_the_distance_of_a_polygon_is_the_distance_to_its_boundary(float64):
    rng = np.random.default_rng(0)
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 5))
    polygon = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    one = pj.obstacles([polygon], dtype=jnp.float64)
    points = rng.uniform(-3.0, 3.0, (200, 2))

    @jax.jit
    def measure(points):
        x, y = points.T
        return distances(one.vertices(0.0), one.present, x[None], y[None])

    distance, away = measure(points)
    outside = np.asarray(distance[0]) > 0.0
    expected = [brute_distance(polygon, point) for point in points[outside]]
    np.testing.assert_allclose(distance[0][outside], expected, atol=1e-5)
    assert outside.any() and not outside.all()
    np.testing.assert_allclose(np.hypot(*away)[0], 1.0, rtol=1e-6)
    assert (distance[1] > 100.0).all()
    step = 1e-6
    for axis in range(2):
        slope = (measure(points + step * np.eye(2)[axis])[0][0] - distance[0]) / step
        assert np.isclose(slope, away[axis][0], atol=1e-4).mean() > 0.99


def test_a_rectangle_is_separate_from_a_polygon_if_no_point_is_in_both(float64):
    rng = np.random.default_rng(1)
    one = pj.obstacles([SQUARE], dtype=jnp.float64)
    x, y = rng.uniform(1.0, 4.0, (2, 400))
    heading = rng.uniform(-np.pi, np.pi, 400)
    body = (-0.1, 0.5, 0.15)
    apart = jax.jit(separation)(one.vertices(0.0), one.present, x[None], y[None], heading, body)[0]
    along, across = np.meshgrid(np.linspace(-0.1, 0.5, 61), np.linspace(-0.15, 0.15, 31))
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    of_x = x[:, None] + along.ravel() * cos - across.ravel() * sin
    of_y = y[:, None] + along.ravel() * sin + across.ravel() * cos
    gap = np.maximum(np.abs(of_x - 2.5), np.abs(of_y - 2.5)).min(axis=1) - 0.5
    sure = np.abs(gap) > 0.02
    np.testing.assert_array_equal((np.asarray(apart) > 0.0)[sure], (gap > 0.0)[sure])


@pytest.mark.parametrize(
    ("polygons", "message"),
    [
        ([[[0, 0], [1, 0]]], r"polygons must have corners .* at index 0$"),
        ([SQUARE, [[0, 0], [1, 1], [1, 0], [0, 1]]], r"crossing near \(0.5, 0.5\) at index 1$"),
        ([[[0, 0], [1, 1], [2, 2]]], "polygons must have an area, .* at index 0$"),
        ([[[0, 0], [1, np.nan], [2, 2]]], "polygons must be finite, .* at index 0$"),
    ],
)
def test_polygons_without_area_or_with_crossing_edges_are_rejected_in_one_line(polygons, message):
    with pytest.raises(ValueError, match=message) as caught:
        pj.obstacles(polygons)
    assert "\n" not in str(caught.value)


def test_corners_may_have_either_sense():
    ours, theirs = pj.obstacles([SQUARE]), pj.obstacles([SQUARE[::-1]])
    corners = [sorted(np.asarray(each.corners[0]).tolist()) for each in (ours, theirs)]
    assert corners[0] == corners[1]
    inside = jnp.array([[2.5]])
    for one in (ours, theirs):
        distance, _ = distances(one.vertices(0.0), one.present, inside, inside)
        np.testing.assert_allclose(distance[0], -0.5, atol=1e-6)


def test_a_turning_path_is_a_circle_and_a_line_without_turning(float64):
    pos, vel = jnp.array([1.0, 2.0]), jnp.array([0.3, 0.4])
    line = pj.TurningPath(pos, vel, jnp.array(0.0)).at(3.0)
    np.testing.assert_allclose(line.pos, [1.9, 3.2], rtol=1e-12)
    circle = pj.TurningPath(pos, vel, jnp.array(0.5))
    round_trip = circle.at(2.0 * np.pi / 0.5)
    np.testing.assert_allclose(round_trip.pos, pos, atol=1e-12)
    half = circle.at(np.pi / 0.5)
    np.testing.assert_allclose(np.linalg.norm(half.pos - pos), 2.0 * 0.5 / 0.5, rtol=1e-12)
    for path in (circle, pj.PolynomialPath(jnp.array([pos, vel, vel**2]), jnp.array(0.5))):
        ahead, behind = path.at(1.0 + 1e-6).pos, path.at(1.0 - 1e-6).pos
        np.testing.assert_allclose((ahead - behind) / 2e-6, path.at(1.0).vel, rtol=1e-7)


def test_a_controlled_path_is_the_recursion_and_straight_between_its_steps(float64):
    random = np.random.default_rng(3)
    state, controls = random.uniform(-1.0, 1.0, 4), random.uniform(-0.4, 0.4, (6, 2))
    path = pj.ControlledPath(*map(jnp.asarray, (state, controls, 0.5)))
    states, at = recursion(state, controls, 0.5), jax.jit(jax.vmap(path.at))
    for time, share in ((0.5 * np.arange(7), 0.0), (0.5 * np.arange(7) + 0.2, 0.2)):
        found = at(jnp.asarray(time))
        np.testing.assert_allclose(found.pos, states[:, :2] + share * states[:, 2:], atol=1e-14)
        np.testing.assert_allclose(found.vel, states[:, 2:], atol=1e-14)
    before, after = path.at(-2.0), path.at(9.0)
    np.testing.assert_allclose(before.pos, state[:2] - 2.0 * state[2:], atol=1e-14)
    np.testing.assert_allclose(after.pos, states[-1, :2] + 6.0 * states[-1, 2:], atol=1e-14)
    still = pj.ControlledPath(path.state, jnp.zeros((0, 2)), path.step).at(3.0)
    np.testing.assert_allclose(still.pos, state[:2] + 3.0 * state[2:], atol=1e-14)


def test_derivatives_of_a_controlled_path_are_its_velocity_and_differences(float64):
    path = pj.ControlledPath(jnp.arange(4.0), jnp.array([[0.0, 0.4], [0.3, -0.1]]), jnp.array(1.0))
    for time in (-0.5, 0.7, 1.0, 1.6, 2.0, 5.0):  # at a step the velocity after it
        moved, state = jnp.asarray(time), path.at(time)
        _, vel = jax.jvp(lambda t: path.at(t).pos, (moved,), (jnp.ones(()),))
        np.testing.assert_array_equal(vel, state.vel)
    assert_gradient_matches_differences(lambda path: jnp.sum(path.at(2.3).pos ** 2), path)


def test_a_case_far_from_the_world_s_origin_moves_a_controlled_path():
    path = pj.ControlledPath(jnp.zeros(4), jnp.ones((2, 2)), jnp.array(1.0))
    case = pj.intercept.case(path, origin=(1000.0, -500.0), start=(1000.8, -496.0, 0.0))
    for time in (0.0, 1.5):
        np.testing.assert_array_equal(
            case.target.at(time).pos - path.at(time).pos, [-1000.0, 500.0]
        )


LATTICE = reach.Lattice(layers=20)
STEP = 10.0 / 19.5  # [s], from layer to layer


def find_layers(target, walls=(), movers=(), velocities=0.0):
    still = pj.TurningPath(jnp.asarray(target, jnp.float32), jnp.zeros(2), jnp.array(0.0))
    obstacles = {"walls": walls, "movers": movers, "mover_velocities": velocities}
    case = pj.intercept.case(still, 10.0, start=(0.8, 4.0, 0.0), **obstacles)
    return np.asarray(_find_layers(case))


@jax.jit
def _find_layers(case):
    grid = reach.grid_of(LATTICE, case.start, case.time, case.limits.speed, case.lower, case.upper)
    ahead, turn_rates = jnp.array([0.05, 0.25]), jnp.array([0.0, 1.0, 0.8, 0.53])
    speeds = case.limits.speed * jnp.linspace(0.0, 1.0, LATTICE.levels)
    vehicle = reach.Vehicle(jnp.array(0.16), ahead, speeds, turn_rates, jnp.array(jnp.inf))
    field = distance_field(case.walls, grid.corner, grid.cell, LATTICE.cells)
    allowed = jnp.ones((LATTICE.headings, *field.values.shape), bool)
    scene = grid, field.values, allowed, case.movers, vehicle
    bits = reach.reach_set(*scene, case.speed, grid.num).bits
    goals = jnp.tile(case.target.pos, (9, 1))
    every = jnp.ones(LATTICE.headings, bool)
    goal_cells = jax.vmap(lambda b: reach.goal_cells(grid, b, goals, 0.0, every)[1])(bits)
    return jnp.any(goal_cells, axis=(1, 2, 3)) & (jnp.arange(LATTICE.layers + 1) <= grid.num)


def upright(low, high):
    return [[3.9, low], [4.1, low], [4.1, high], [3.9, high]]


def test_a_reach_set_meets_a_target_ahead_no_sooner_than_the_greatest_speed_allows():
    is_met = find_layers((5.3, 4.0))
    first = np.argmax(is_met)
    # The car drives 4.5 m, starts at 0.5 m/s and may drive at 1.5 m/s, so 3 s are a lower bound.
    assert is_met.any() and 3.0 <= (first + 0.5) * STEP <= 4.2
    assert is_met[first:20].all()  # it may arrive later, too


def test_a_wall_across_the_map_cannot_be_passed_but_a_wall_with_a_gap_can():
    assert not find_layers((6.0, 4.0), [upright(-0.5, 8.5)]).any()
    is_met = find_layers((6.0, 4.0), [upright(-0.5, 5.0), upright(6.0, 8.5)])
    assert is_met.any()
    assert np.argmax(is_met) > np.argmax(find_layers((6.0, 4.0)))


def test_a_mover_blocks_a_goal_while_it_covers_it():
    lid = [[3.0, 3.0], [5.0, 3.0], [5.0, 5.0], [3.0, 5.0]]
    goal = (4.0, 4.0)
    assert not find_layers(goal, movers=[lid]).any()
    leaving = find_layers(goal, movers=[lid], velocities=(0.0, 0.5))
    assert leaving.any() and (np.argmax(leaving) + 0.5) * STEP >= 2.0
    coming = find_layers(goal, movers=[np.array(lid) + [0.0, 3.0]], velocities=(0.0, -0.5))
    times = (np.arange(21) + 0.5) * STEP
    covered = (times > 4.0) & (times < 8.0)
    assert coming[:8].any() and not coming[covered].any() and coming[16:].any()


def test_a_distance_field_interpolates_distances_and_returns_its_own_derivatives(float64):
    rng = np.random.default_rng(3)
    box = pj.obstacles([[[2.0, 2.0], [5.0, 2.0], [5.0, 4.0], [2.0, 4.0]]], dtype=jnp.float64)
    corner, spacing = jnp.zeros(2), 0.0625
    x, y = jnp.asarray(rng.uniform(0.1, 7.8, (2, 400)))
    apart = jnp.full(2, spacing)
    near = jax.jit(lambda x, y: distance_field(box, corner, apart, (128, 128)).near(x, y))
    far, *slopes = near(x, y)
    exact = distances(box.vertices(0.0), box.present, x[None], y[None])[0][0]
    outside = exact > 0.1
    # At the distance r from a corner bilinear interpolation errs by at most spacing^2 / (4 r).
    np.testing.assert_allclose(far[outside], exact[outside], atol=0.0625**2 / (4.0 * 0.1))
    assert np.all(far >= exact - 1e-3) and np.all(far[exact < -0.1] < 0.0)
    step = 1e-6
    # Use points inside the grid's cells, because the slope jumps at the borders of cells.
    inner = np.all(np.abs(np.mod([x / spacing, y / spacing], 1.0) - 0.5) < 0.49, axis=0)
    for slope, (right, up) in zip(slopes, step * np.eye(2), strict=True):
        change = near(x + right, y + up)[0] - near(x - right, y - up)[0]
        np.testing.assert_allclose(slope[inner], change[inner] / (2.0 * step), atol=1e-6)


def test_the_last_layer_is_at_the_horizon_and_a_cell_at_the_start():
    start, time, speed = jnp.array([0.8, 4.0, 0.3]), jnp.array(4.37), jnp.array(1.5)
    grid = reach.grid_of(LATTICE, start, time, speed, jnp.zeros(2), jnp.full(2, 8.0))
    np.testing.assert_allclose((float(grid.num) + 0.5) * grid.step, 4.37, rtol=1e-6)
    offset = (np.array([0.8, 4.0]) - grid.corner) / grid.cell
    np.testing.assert_allclose(offset, np.round(offset), atol=1e-4)
