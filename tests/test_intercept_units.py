"""Interceptions: tables of poses, paths of targets, regions, arguments, and bounds on distances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import planner_jax as pj
from planner_jax.plane.obstacles import place
from planner_jax.task.intercept.plan import make_plan
from planner_jax.task.intercept.problem.clearance import least_between, nearest_in_region

BOX = np.array([[-1.0, -0.5], [1.0, -0.5], [1.0, 0.5], [-1.0, 0.5]])


def test_a_table_of_poses_is_linear_between_its_times_and_ends_with_them(float64):
    times, poses = [1.0, 2.0, 4.0], [[0.0, 0.0, 3.0], [2.0, 0.0, 3.2], [2.0, 6.0, 3.6]]
    group = pj.obstacles([BOX], paths=[(times, poses)], growth=0.1, dtype=jnp.float64)
    placed = place(group, jnp.array([0.9, 1.5, 3.0, 4.0, 4.1]))
    np.testing.assert_array_equal(placed.present[0], [False, True, True, True, False])
    np.testing.assert_allclose(placed.x[0, 1:4], [1.0, 2.0, 2.0])
    np.testing.assert_allclose(placed.y[0, 1:4], [0.0, 3.0, 6.0], atol=1e-12)
    np.testing.assert_allclose(placed.turn[0][0, 1:4], np.cos([3.1, 3.4, 3.6]))
    np.testing.assert_allclose(placed.turn[2][0, 1:3], [0.2, 0.2])
    np.testing.assert_allclose(placed.radius[0], 0.1 * np.array([0.9, 1.5, 3.0, 4.0, 4.1]))
    corners = group.vertices(2.0)[0, :4]
    cos, sin = np.cos(3.2), np.sin(3.2)
    np.testing.assert_allclose(corners, BOX @ [[cos, sin], [-sin, cos]] + [2.0, 0.0])


@struct.dataclass
class Bare:
    pos: jax.Array

    def at(self, time):
        return self.pos + jnp.stack([jnp.sin(time), time])


def test_the_velocity_of_a_path_that_returns_positions_is_their_derivative():
    case = pj.intercept.case(Bare(jnp.zeros(2)), upper=(20.0, 20.0))
    state = case.target.at(jnp.float32(0.5))
    np.testing.assert_allclose(state.pos, [np.sin(0.5), 0.5], rtol=1e-6)
    np.testing.assert_allclose(state.vel, [np.cos(0.5), 1.0], rtol=1e-6)


def test_a_target_may_be_a_table_of_positions_in_the_plane():
    times = np.linspace(0.0, 10.0, 21)
    table = pj.table_path(times, np.stack([0.3 * times, np.cos(times)], axis=1))
    case = pj.intercept.case(table, lower=(-5.0, -5.0))
    np.testing.assert_allclose(case.target.at(jnp.float32(4.2)).pos, [1.26, np.cos(4.2)], atol=2e-3)


def test_the_vector_from_a_region_is_exact_and_its_slope_is_the_derivative(float64):
    region, nearest_vector = jnp.asarray(BOX), jax.jit(nearest_in_region)
    derivative = jax.jit(jax.jacfwd(lambda point: nearest_in_region(region, point)[0]))
    for point in ([2.0, 0.2], [1.7, 1.4], [-3.0, -0.1], [0.2, -2.0]):
        point = jnp.array(point)
        away, slope = nearest_vector(region, point)
        nearest = np.clip(point, [-1.0, -0.5], [1.0, 0.5])
        np.testing.assert_allclose(away, point - nearest, atol=1e-12)
        np.testing.assert_allclose(slope, derivative(point))
    assert not np.any(nearest_vector(region, jnp.array([0.3, 0.1]))[0])
    away, slope = nearest_vector(jnp.zeros((1, 2)), jnp.array([0.3, 0.1]))
    np.testing.assert_allclose(away, [0.3, 0.1])
    np.testing.assert_allclose(slope, np.eye(2))


@pytest.mark.parametrize(
    "settings, says",
    [
        ({"movers": [BOX], "mover_paths": []}, "mover_paths must have 1 entries"),
        ({"movers": [BOX], "mover_paths": [([0, 1], np.zeros((3, 3)))]}, "mover_paths"),
        ({"movers": [BOX], "mover_paths": [([1, 0], np.zeros((2, 3)))]}, "increasing times"),
        ({"movers": [BOX], "mover_growth": -1.0}, "mover_growth must be >= 0"),
        ({"walls": [pj.intercept.Circle(1.0, 1.0, 0.0)]}, "walls"),
        ({"margin": -0.1}, "margin must be >= 0"),
        ({"end_speed": (np.nan, 1.0)}, "end_speed must be a number"),
        ({"origin": (0.0, 0.0, 0.0)}, "origin must have the shape"),
        ({"start": (5e5, 4e6, 0.0)}, "target must be relative to the argument origin"),
    ],
)
def test_a_wrong_argument_is_named(settings, says):
    with pytest.raises(ValueError, match=says):
        pj.intercept.case(Bare(jnp.zeros(2)), **settings)


@pytest.mark.parametrize("size", [0.4, 4.5, 4500.0])
def test_the_bound_between_samples_is_a_lower_bound_and_exact_for_a_dip(size):
    # Distances |t - c| of two points that pass each other. No sample is at the least distance.
    least = size * np.linspace(0.0, 0.9, 7)
    dips = least[:, None] + size * np.abs(np.arange(9.0) - np.linspace(3.0, 4.0, 7)[:, None])
    assert dips[3].min() > least[3] + 0.4 * size
    np.testing.assert_allclose(least_between(jnp.asarray(dips)), least, atol=1e-5 * size)
    # Distances of random points that pass each other, at fine times and at every 16th of them.
    random = np.random.default_rng(0)
    apart, velocity = random.normal(size=(2, 200, 2, 1))
    fine = size * np.linalg.norm(apart + velocity * np.linspace(-2.0, 2.0, 16 * 40 + 1), axis=1)
    bound = least_between(jnp.asarray(fine[:, ::16]))
    assert (np.asarray(bound) <= fine.min(axis=1) + 1e-5 * size).all()
    assert (np.asarray(bound) >= fine.min(axis=1) - 0.1 * size * np.abs(velocity).sum()).all()


@jax.jit
def evaluate_drive(case, speed, bend):
    return make_plan(case, case.time, speed, bend, samples=16, points=4, steps=jnp.array(0))


@pytest.mark.parametrize("size", [1.0, 11.25])
@pytest.mark.parametrize("gap, is_solved", [(2e-3, True), (-2e-3, False)])
def test_cars_of_any_size_may_pass_walls_and_thin_posts_closely(size, gap, is_solved):
    # The car, `size` times 0.4 m long, drives straight on, past a wall and a thin post beside it.
    side = 0.125 + gap
    walls = [[[1.5, side], [2.5, side], [2.0, side + 0.5]], [[3.0, -side], [2.99, -2], [3.01, -2]]]
    lengths = {"length": 0.4, "width": 0.25, "wheelbase": 0.3, "rear_overhang": 0.05}
    case = pj.intercept.case(
        pj.TurningPath(size * jnp.array([5.15, 0.0]), jnp.zeros(2), jnp.zeros(())),
        start=(0.0, 0.0, 0.0),
        initial_speed=0.5 * size,
        walls=[size * np.array(wall) for wall in walls],
        lower=-np.inf,
        upper=np.inf,
        **{name: size * value for name, value in lengths.items()},
        speed=1.5 * size,
        acceleration=size,
        lateral_acceleration=0.8 * size,
        curvature=2.0 / size,
    )
    speed, bend = jnp.full(33, 0.5 * size), jnp.zeros(33)
    plan = evaluate_drive(case, speed, bend)
    assert (plan.status == pj.Status.CONVERGED) == is_solved
    assert pj.intercept.judge(case, plan).success == is_solved
