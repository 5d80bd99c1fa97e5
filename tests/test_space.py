"""Distances of segments, rectangles and boxes in space."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences
from scipy.optimize import lsq_linear

from planner_jax.space import distances as space
from tests.trees import as_numpy

NUM = 60  # pairs of every kind, so that rare arrangements occur
DISTANCES = {
    "segments": space.segment_to_segment,
    "rectangle": space.segment_to_rectangle,
    "box": space.segment_to_box,
}
every_distance = pytest.mark.parametrize("name", DISTANCES)


def gap_of(name, bodies):
    if name == "segments":
        (a, a_end), (b, b_end) = bodies
        return a - b, [a_end - a, b - b_end]
    if name == "rectangle":
        (a, a_end), middle, (e, f) = bodies
        return a - middle - e - f, [a_end - a, 2.0 * e, 2.0 * f]
    (a, a_end), lower, upper = bodies
    return a - lower, [a_end - a, *np.diag(lower - upper)]


def least_distances(name, bodies):
    results = []
    for pair in zip(*(np.asarray(body, float) for body in bodies), strict=True):
        first, columns = gap_of(name, pair)
        matrix = np.stack(columns, axis=1)
        shares = lsq_linear(matrix, -first, bounds=(0.0, 1.0), method="bvls", tol=1e-14).x
        results.append(np.linalg.norm(first + matrix @ shares))
    return np.array(results)


def segments(rng, kind):
    ends = rng.uniform(-1.0, 1.0, (NUM, 2, 3))
    if kind == "points":
        ends[:, 1] = ends[:, 0]
    if kind == "along":  # nearly along an axis, down to the last bit in float32
        ends[:, 1, :2] = ends[:, 0, :2] + 10.0 ** rng.uniform(-8.0, -2.0, (NUM, 2))
    if kind == "grid":  # along axes, through corners, in faces, of zero length
        ends = rng.integers(-2, 3, (NUM, 2, 3)) / 4.0
    return ends


def pairs(name, kind, seed=0):
    rng = np.random.default_rng(seed)
    ends = segments(rng, kind)
    place, middle = rng.uniform(-0.7, 0.7, (NUM, 2)), rng.uniform(-0.3, 0.3, (NUM, 3))
    axes = np.linalg.qr(rng.normal(size=(NUM, 3, 3)))[0]
    edges = axes[:, :2] * rng.uniform(0.1, 0.6, (NUM, 2, 1))
    upper = rng.uniform(0.0, 0.6, (NUM, 3))
    if kind in ("along", "grid"):
        upper = np.round(4.0 * upper) / 4.0
        edges, middle = np.broadcast_to(np.eye(3)[1:] / 4.0, (NUM, 2, 3)), np.zeros((NUM, 3))
        place[: NUM // 2] = np.round(4.0 * place[: NUM // 2]) / 4.0
    other = np.concatenate([ends[: NUM // 2] + place[: NUM // 2, :1, None], ends[NUM // 2 :][::-1]])
    bodies = {
        "segments": (ends, other),
        "rectangle": (ends, middle, edges),
        "box": (ends, -upper, upper),
    }[name]
    return tuple(np.asarray(body, np.float32) for body in bodies)


@functools.cache
def measure(name):
    distance = DISTANCES[name]
    count = len(pairs(name, "any"))
    return jax.jit(jax.vmap(jax.value_and_grad(distance, argnums=tuple(range(count)))))


def distances(name, bodies):
    return np.asarray(measure(name)(*bodies)[0])


@every_distance
@pytest.mark.parametrize("kind", ["any", "points", "along", "grid"])
def test_a_distance_is_the_least_over_all_points_in_float32(name, kind):
    bodies = pairs(name, kind)
    value, slopes = measure(name)(*bodies)
    np.testing.assert_allclose(value, least_distances(name, bodies), atol=2e-6)
    # The gradient with respect to all coordinates has at most the length sqrt(2), also if bodies
    # touch or are parallel.
    for slope in slopes:
        assert np.isfinite(slope).all()
        assert (np.linalg.norm(slope.reshape(NUM, -1), axis=1) <= np.sqrt(2.0) + 1e-5).all()


def smooth_pairs(name):
    bodies = pairs(name, "any")
    smooth = distances(name, bodies) > 0.05
    if name == "segments":
        smooth[: NUM // 2] = False
    assert smooth.sum() > 10
    return [body[smooth].astype(np.float64) for body in bodies]


@every_distance
def test_a_gradient_matches_finite_differences(name, float64):
    total = lambda bodies: jnp.sum(jax.vmap(DISTANCES[name])(*bodies))  # noqa: E731
    assert_gradient_matches_differences(total, smooth_pairs(name), step=1e-7, rtol=1e-6)


@pytest.mark.parametrize("name", ["segments", "rectangle", "box"])
def test_a_second_derivative_includes_the_motion_of_the_nearest_points(name, float64):
    ends, *others = smooth_pairs(name)
    direction = np.random.default_rng(1).normal(size=ends.shape)
    many = jax.vmap(DISTANCES[name])

    def slope(ends):
        return jnp.sum(jax.jvp(lambda ends: many(ends, *others), (ends,), (direction,))[1])

    assert_gradient_matches_differences(slope, ends, step=1e-7, rtol=1e-6)


@pytest.mark.parametrize("name", [*DISTANCES, "low segment", "low rectangle"])
def test_an_approach_gives_the_derivative_by_a_rotation_and_a_translation(name, float64):
    if name == "low segment":
        distance, first, others = space.lowest_of_segment, smooth_pairs("segments")[:1], ()
    elif name == "low rectangle":
        distance, first, others = space.lowest_of_rectangle, smooth_pairs("rectangle")[1:], ()
    else:
        distance, bodies = DISTANCES[name], smooth_pairs(name)
        first, others = bodies[:1], bodies[1:]

    def slopes(first, others):
        def at(twist):
            turn, move = twist[:3], twist[3:]
            body, *edges = first  # edges only turn
            moved = [
                body + jnp.cross(turn, body) + jnp.broadcast_to(move, body.shape),
                *(e + jnp.cross(turn, e) for e in edges),
            ]
            return distance(*moved, *others)

        _, nearest = space.nearest_points(distance, *first, *others)
        line = space.approach(distance, nearest, *first, *others)
        expected = jax.grad(at)(jnp.zeros(6))
        return expected, jnp.concatenate([jnp.stack(line.moment), jnp.stack(line.direction)])

    expected, found = jax.jit(jax.vmap(slopes))(tuple(first), tuple(others))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(found[:, :3]).max() > 0.1


@pytest.mark.parametrize("name", ["rectangle", "box"])
def test_crossing_bodies_have_exactly_zero_distance_and_gradient(name):
    bodies = pairs(name, "any")
    crosses = least_distances(name, bodies) < 1e-7
    assert 3 < crosses.sum() < NUM - 3
    value, slopes = as_numpy(measure(name)(*bodies))
    assert (value[crosses] == 0.0).all() and (value[~crosses] > 0.0).all()
    for slope in slopes:
        assert (slope[crosses] == 0.0).all()


def test_a_segment_nearly_along_an_edge_of_a_box_is_exact_in_float32_too():
    rng = np.random.default_rng(0)
    ends = rng.uniform(-1.0, 1.0, (1000, 2, 3)) * [0.9, 4e-4, 4e-4] + [0.0, 0.3, 0.1]
    upper = np.broadcast_to(np.asarray([0.6, 0.3, 0.1], np.float32), (1000, 3))
    bodies = (ends.astype(np.float32), -upper, upper)
    np.testing.assert_allclose(distances("box", bodies), least_distances("box", bodies), atol=5e-7)


def test_the_lowest_points_are_corners():
    rng = np.random.default_rng(0)
    ends, edges = rng.normal(size=(2, NUM, 2, 3))
    middle = rng.normal(size=(NUM, 3))
    corners = [middle + a * edges[:, 0] + b * edges[:, 1] for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    low = jax.jit(jax.vmap(space.lowest_of_rectangle))(middle, edges)
    np.testing.assert_allclose(low, np.min(corners, axis=0)[:, 2], atol=1e-6)
    low = jax.jit(jax.vmap(space.lowest_of_segment))(ends)
    np.testing.assert_allclose(low, ends[..., 2].min(axis=1), rtol=1e-6)
