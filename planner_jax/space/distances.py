"""Differentiable distances between segments, rectangles, boxes, cylinders and the ground.

With them an arm that blocks a ball keeps its links and shield clear of obstacles. Every function
takes ONE pair of bodies; use `jax.vmap` for many pairs. The distance of a capsule is the distance
of its axis minus its radius. Any frame, SI units; the ground is the x-y plane. Bodies are:

* a segment: `ends` (2, 3) [m], which may coincide;
* a rectangle: its `middle` (3,) [m] and `edges` (2, 3) [m], halves of its edges as vectors from the
  middle, at right angles and longer than zero;
* a box along the axes: its corners `lower` and `upper` (3,) [m], `lower` <= `upper`;
* a turned box: its `middle` (3,) [m], its `axes` (3, 3), unit vectors along the edges, and `half`
  (3,) [m], halves of the edges' lengths;
* a cylinder: the `ends` (2, 3) [m] of its axis, which do not coincide, and its `radius` () [m].

A distance is the least length |gap| of a vector between points of two bodies. The derivative of the
distance is the derivative of |gap| with the nearest points fixed on their bodies (the envelope
theorem). `_shortest` declares this rule to JAX. Derivatives then cost little more than values, and
need no division by the sine of the angle between nearly parallel bodies. Bodies that cross have
distance 0 and derivative 0. Parallel bodies can have several pairs of nearest points; the
derivative then belongs to one of these pairs. `approach` returns the line through the nearest
points. Derivatives of the distance by rotations and translations of a body follow from this line.

Vectors are tuples of components here, so that XLA compiles one elementwise loop over the batch.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import PyTree

Vector = tuple[Array, ...]

_HALVINGS = 18  # bisections for the point of a segment that is nearest to a cylinder
_TINY = 1e-24  # a smaller squared length [m^2] or squared area [m^4] counts as zero


def segment_to_segment(ends_a: Array, ends_b: Array) -> Array:
    """Return the distance () [m] between two segments, each given by its ends (2, 3) [m]."""
    return _shortest(_nearest_of_segments, _gap_of_segments, (ends_a, ends_b))


def segment_to_rectangle(ends: Array, middle: Array, edges: Array) -> Array:
    """Return the distance () [m] between a segment and a flat rectangle; it is 0 if they cross."""
    return _shortest(_nearest_of_rectangle, _gap_to_rectangle, (ends, middle, edges))


def segment_to_box(ends: Array, lower: Array, upper: Array) -> Array:
    """Return the distance () [m] between a segment and a box; it is 0 if they intersect."""
    return _shortest(_nearest_of_box, _gap_to_box, (ends, lower, upper))


def segment_to_turned_box(ends: Array, middle: Array, axes: Array, half: Array) -> Array:
    """Return the distance () [m] between a segment and a turned box; it is 0 if they intersect."""
    return _shortest(_nearest_of_turned_box, _gap_to_turned_box, (ends, middle, axes, half))


def segment_to_cylinder(ends: Array, axis_ends: Array, radius: Array) -> Array:
    """Return the distance () [m] between a segment and a cylinder; it is 0 if they intersect."""
    return _shortest(_nearest_of_cylinder, _gap_to_cylinder, (ends, axis_ends, radius))


def lowest_of_segment(ends: Array) -> Array:
    """Return the height () [m] of the lowest point of a segment above the ground."""
    return jnp.minimum(ends[0, 2], ends[1, 2])


def lowest_of_rectangle(middle: Array, edges: Array) -> Array:
    """Return the height () [m] of the lowest point of a rectangle above the ground."""
    return middle[2] - jnp.abs(edges[0, 2]) - jnp.abs(edges[1, 2])


class Approach(NamedTuple):
    """The line through the nearest points of two bodies, in Pluecker coordinates."""

    # Components () of the unit vector from the second body to the first; 0 if the bodies cross.
    direction: Vector
    moment: Vector  # three components () [m], p x direction for any point p of the line


def nearest_points(distance: Callable, *bodies: Array) -> tuple[Array, PyTree]:
    """Return a distance () [m], and the parameters of the nearest points for `approach`.

    A parameter is for example the fraction, from 0 to 1, at which the point lies along a segment.

    Args:
        distance: function of this module that returns a distance or a height.
        bodies: the arguments of the function `distance`.
    """
    nearest_of, gap_of, _ = _PARTS[distance]
    # Without the barrier XLA would compute the nearest points again for every use.
    nearest = lax.optimization_barrier(nearest_of(*bodies))
    if gap_of is _gap_to_ground:
        return distance(*bodies), nearest
    return _length(gap_of(nearest, *bodies)), nearest


def approach(distance: Callable, nearest: PyTree, *bodies: Array) -> Approach:
    """Return the line through the nearest points of two bodies.

    If the first body rotates about an axis a through a point o, the derivative of the distance by
    the angle is a . (moment - o x direction). If the second body rotates, the sign is the opposite.

    Args:
        distance: function of this module that returns a distance or a height. For a height the
            second body is the ground.
        nearest: parameters of the nearest points, from `nearest_points`.
        bodies: the arguments of the function `distance`.
    """
    _, gap_of, point_of = _PARTS[distance]
    point, gap = point_of(nearest, *bodies), gap_of(nearest, *bodies)
    # Divide last: XLA computes a quotient only once, but repeats cheaper arithmetic for each use.
    length = _length(gap)
    length = jnp.where(length > 0.0, length, jnp.inf)
    direction, moment = (tuple(x / length for x in each) for each in (gap, cross(point, gap)))
    return Approach(direction, moment)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _shortest(nearest: Callable, gap: Callable, bodies: tuple[Array, ...]) -> Array:
    """Return the distance () [m] between two bodies.

    `nearest` returns the parameters of the nearest points, such as fractions from 0 to 1 along
    segments. `gap` returns the vector between these points, from the second body to the first.
    """
    return _length(gap(nearest(*bodies), *bodies))


@_shortest.defjvp
def _shortest_jvp(nearest: Callable, gap: Callable, primals: tuple, tangents: tuple) -> PyTree:
    (bodies,) = primals
    # Without the barrier XLA would compute the nearest points again for every derivative.
    fixed = lax.optimization_barrier(nearest(*bodies))
    return jax.jvp(lambda bodies: _length(gap(fixed, *bodies)), primals, tangents)


def _nearest_of_segments(ends_a: Array, ends_b: Array) -> tuple[Array, Array]:
    """Return the fractions, from 0 to 1, along both segments at which they are nearest.

    The first segment's fraction is taken where the infinite lines are nearest, clipped to [0, 1].
    Then the point of the second segment nearest to this point is computed, and last the point of
    the first segment nearest to the second point. This is exact (C. Ericson, Real-Time Collision
    Detection, 2005, 5.1.9). The first step uses the cross product of the segments' directions
    instead of dot products, so that it is accurate in float32 for lines at any angle.
    """
    (start_a, end_a), (start_b, end_b) = _rows(ends_a), _rows(ends_b)
    u, v, between = _minus(end_a, start_a), _minus(end_b, start_b), _minus(start_b, start_a)
    normal = cross(u, v)
    share_a = _unit(_ratio(dot(cross(between, v), normal), dot(normal, normal)))
    along = dot(u, v)
    share_b = _unit(_ratio(share_a * along - dot(between, v), dot(v, v)))
    share_a = _unit(_ratio(share_b * along + dot(between, u), dot(u, u)))
    return share_a, share_b


def _gap_of_segments(shares: tuple[Array, Array], ends_a: Array, ends_b: Array) -> Vector:
    return _minus(_point(ends_a, shares[0]), _point(ends_b, shares[1]))


def _nearest_of_box(ends: Array, lower: Array, upper: Array) -> tuple[Array]:
    start, end = _rows(ends)
    slabs = [
        _slab(low - x, high - x, speed, speed * speed)
        for x, speed, low, high in zip(start, _minus(end, start), lower, upper, strict=True)
    ]
    return (_share_nearest_to_slabs(slabs),)


def _gap_to_box(shares: tuple[Array], ends: Array, lower: Array, upper: Array) -> Vector:
    point = _point(ends, shares[0])
    return tuple(
        x - jnp.clip(x, low, high) for x, low, high in zip(point, lower, upper, strict=True)
    )


def _into_box(point: Vector, middle: Array, axes: Array) -> Vector:
    away = _minus(point, tuple(middle))
    return tuple(dot(away, tuple(axis)) for axis in axes)


def _nearest_of_turned_box(ends: Array, middle: Array, axes: Array, half: Array) -> tuple[Array]:
    start, end = (_into_box(point, middle, axes) for point in _rows(ends))
    slabs = [
        _slab(-reach - x, reach - x, speed, speed * speed)
        for x, speed, reach in zip(start, _minus(end, start), half, strict=True)
    ]
    return (_share_nearest_to_slabs(slabs),)


def _gap_to_turned_box(
    shares: tuple[Array], ends: Array, middle: Array, axes: Array, half: Array
) -> Vector:
    inside = _into_box(_point(ends, shares[0]), middle, axes)
    x, y, z = (each - jnp.clip(each, -h, h) for each, h in zip(inside, half, strict=True))
    return tuple(x * axes[0][k] + y * axes[1][k] + z * axes[2][k] for k in range(3))


def _split_by_axis(point: Vector, axis_ends: Array) -> tuple[Array, Vector, Vector, Array]:
    """Split the vector from a cylinder's middle to a point into parts along and across the axis.

    Returns:
        height: (), the part along the axis.
        across: the part across the axis.
        axis: the unit vector along the axis.
        half: (), half of the cylinder's length.
    """
    low, high = _rows(axis_ends)
    step = _minus(high, low)
    length = jnp.sqrt(dot(step, step))
    axis = tuple(each / length for each in step)
    away = tuple(x - 0.5 * (a + b) for x, a, b in zip(point, low, high, strict=True))
    height = dot(away, axis)
    across = tuple(x - height * a for x, a in zip(away, axis, strict=True))
    return height, across, axis, 0.5 * length


def _nearest_of_cylinder(ends: Array, axis_ends: Array, radius: Array) -> tuple[Array]:
    """Return the fraction along the segment at which it is nearest to the cylinder.

    The squared distance of the segment's point at a fraction is convex, so that bisection finds the
    zero of its derivative.
    """
    start, end = _rows(ends)
    height, across, axis, half = _split_by_axis(start, axis_ends)
    step = _minus(end, start)
    climb = dot(step, axis)
    drift = tuple(x - climb * a for x, a in zip(step, axis, strict=True))

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        share = 0.5 * (low + high)
        level = height + share * climb
        beside = tuple(x + share * y for x, y in zip(across, drift, strict=True))
        outside = jnp.maximum(
            1.0 - radius * lax.rsqrt(jnp.maximum(dot(beside, beside), _TINY)), 0.0
        )
        slope = (level - jnp.clip(level, -half, half)) * climb + outside * dot(beside, drift)
        return jnp.where(slope < 0.0, share, low), jnp.where(slope < 0.0, high, share)

    none = jnp.zeros_like(height * radius + climb)
    low, high = lax.fori_loop(0, _HALVINGS, halve, (none, none + 1.0))
    return (0.5 * (low + high),)


def _gap_to_cylinder(shares: tuple[Array], ends: Array, axis_ends: Array, radius: Array) -> Vector:
    height, across, axis, half = _split_by_axis(_point(ends, shares[0]), axis_ends)
    away = jnp.sqrt(jnp.maximum(dot(across, across), _TINY))
    outside = jnp.maximum(1.0 - radius / away, 0.0)
    beyond = height - jnp.clip(height, -half, half)
    return tuple(outside * x + beyond * a for x, a in zip(across, axis, strict=True))


def _nearest_of_rectangle(ends: Array, middle: Array, edges: Array) -> PyTree:
    """Return the parameters of the nearest points of a segment and a rectangle.

    They are the fraction along the segment (0 to 1), the multiples of both half-edges (-1 to 1),
    and whether the bodies are apart. The rectangle is treated as a box without thickness, whose
    axes are the half-edges e and f and their cross product.
    """
    (start, end), (e, f) = _rows(ends), _rows(edges)
    step, away = _minus(end, start), _minus(start, tuple(middle))
    squares = dot(e, e), dot(f, f)
    dots = [(dot(away, axis), dot(step, axis)) for axis in (e, f)]
    normal = cross(e, f)
    height, climb = dot(away, normal), dot(step, normal)
    plane = _slab(-height, -height, climb, climb * climb)
    slabs = [
        _slab(-square - offset, square - offset, speed, speed * speed * other)
        for (offset, speed), square, other in zip(dots, squares, squares[::-1], strict=True)
    ]
    share = _share_nearest_to_slabs([*slabs, plane])
    through = plane.enters
    crosses = (plane.weight > 0.0) & (through >= 0.0) & (through <= 1.0)
    for (offset, speed), square in zip(dots, squares, strict=True):
        crosses = crosses & (jnp.abs(offset + through * speed) <= square)
    of_edges = [
        jnp.clip(_ratio(offset + share * speed, square), -1.0, 1.0)
        for (offset, speed), square in zip(dots, squares, strict=True)
    ]
    return share, of_edges, ~crosses


def _gap_to_rectangle(nearest: PyTree, ends: Array, middle: Array, edges: Array) -> Vector:
    share, (p, q), apart = nearest
    away = _minus(_point(ends, share), tuple(middle))
    e, f = _rows(edges)
    return tuple(
        jnp.where(apart, x - p * a - q * b, 0.0) for x, a, b in zip(away, e, f, strict=True)
    )


class _Slab(NamedTuple):
    """The part of a segment's line inside a slab, the space between two parallel planes."""

    enters: Array  # () fraction of the segment at which its line enters the slab
    leaves: Array  # () fraction at which the line leaves the slab, at least `enters`
    weight: Array  # () squared length of the segment across the slab; 0 if they are parallel


def _slab(to_low: Array, to_high: Array, speed: Array, weight: Array) -> _Slab:
    moves = weight > _TINY
    step = jnp.where(moves, speed, 1.0)
    # Do not multiply by 1 / step: XLA may fuse a product with the later subtraction s - enters,
    # whose result must be exactly 0 at the fraction s = enters.
    first, last = to_low / step, to_high / step
    return _Slab(
        enters=jnp.minimum(first, last),
        leaves=jnp.maximum(first, last),
        weight=jnp.where(moves, weight, 0.0),
    )


def _share_nearest_to_slabs(slabs: list[_Slab]) -> Array:
    """Return the fraction () along a segment nearest to the intersection of orthogonal slabs.

    A slab is the space between two parallel planes. The segment's line is in slab i from the
    fraction enters_i to the fraction leaves_i, and weight_i is the squared length of the segment
    across the slab. The squared distance of the segment's point at the fraction s is the sum of its
    squared distances from three slabs. It is convex in s, and half its derivative,

        sum_i  weight_i (max(s - leaves_i, 0) - max(enters_i - s, 0)),

    is piecewise linear and never falls. Its zero is interpolated between the last of the fractions
    enters_i and leaves_i with a value <= 0 and the first with a value >= 0. If the derivative is 0
    on an interval, the interval's middle is returned.
    """

    def half_derivative(s: Array | float) -> Array:
        a, b, c = (
            slab.weight * (jnp.maximum(s - slab.leaves, 0.0) - jnp.maximum(slab.enters - s, 0.0))
            for slab in slabs
        )
        return a + b + c

    low = jnp.where(half_derivative(1.0) <= 0.0, 1.0, 0.0)
    high = jnp.where(half_derivative(0.0) >= 0.0, 0.0, 1.0)
    for slab in slabs:
        for kink in (_unit(slab.enters), _unit(slab.leaves)):
            value = half_derivative(kink)
            low = jnp.where(value <= 0.0, jnp.maximum(low, kink), low)
            high = jnp.where(value >= 0.0, jnp.minimum(high, kink), high)
    fall, rise = half_derivative(low), half_derivative(high)
    rises = rise > fall
    between = jnp.where(rises, low * rise - high * fall, 0.5 * (low + high))
    return between / jnp.where(rises, rise - fall, 1.0)


def _length(vector: Vector) -> Array:
    """Return the length () of a vector; 0, with derivative 0, if it is below 1e-12."""
    square = dot(vector, vector)
    apart = square > _TINY
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)


def _ratio(top: Array, square: Array) -> Array:
    is_positive = square > _TINY
    return jnp.where(is_positive, top / jnp.where(is_positive, square, 1.0), 0.0)


def _unit(share: Array) -> Array:
    return jnp.clip(share, 0.0, 1.0)


def _point(ends: Array, share: Array) -> Vector:
    start, end = _rows(ends)
    return tuple(a + share * (b - a) for a, b in zip(start, end, strict=True))


def _rows(pair: Array) -> tuple[Vector, Vector]:
    return tuple(pair[0]), tuple(pair[1])


def _minus(a: Vector, b: Vector) -> Vector:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def dot(a: Vector, b: Vector) -> Array:
    """Return the scalar product of two vectors."""
    first, *others = (x * y for x, y in zip(a, b, strict=True))
    return sum(others, first)


def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product of two vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _lowest_end(ends: Array) -> Vector:
    start, end = _rows(ends)
    return tuple(jnp.where(start[2] < end[2], a, b) for a, b in zip(start, end, strict=True))


def _lowest_corner(middle: Array, edges: Array) -> Vector:
    p, q = -jnp.sign(edges[0, 2]), -jnp.sign(edges[1, 2])
    return _point_of_rectangle((p, q), middle, edges)


def _gap_to_ground(lowest: Vector, *bodies: Array) -> Vector:
    return (jnp.zeros_like(lowest[0]), jnp.zeros_like(lowest[0]), jnp.ones_like(lowest[0]))


def _point_of_rectangle(nearest: PyTree, middle: Array, edges: Array, *other: Array) -> Vector:
    (e, f), (p, q, *_) = _rows(edges), nearest
    return tuple(m + p * a + q * b for m, a, b in zip(middle, e, f, strict=True))


def _point_of_segment(shares: PyTree, ends: Array, *other: Array) -> Vector:
    return _point(ends, shares[0])


def _point_itself(lowest: Vector, *bodies: Array) -> Vector:
    return lowest


# Distance function -> three functions for `approach`, which return the parameters of the nearest
# points, the gap between these points, and the nearest point of the first body.
_PARTS: dict[Callable, tuple[Callable, Callable, Callable]] = {
    segment_to_segment: (_nearest_of_segments, _gap_of_segments, _point_of_segment),
    segment_to_rectangle: (_nearest_of_rectangle, _gap_to_rectangle, _point_of_segment),
    segment_to_box: (_nearest_of_box, _gap_to_box, _point_of_segment),
    segment_to_turned_box: (_nearest_of_turned_box, _gap_to_turned_box, _point_of_segment),
    segment_to_cylinder: (_nearest_of_cylinder, _gap_to_cylinder, _point_of_segment),
    lowest_of_segment: (_lowest_end, _gap_to_ground, _point_itself),
    lowest_of_rectangle: (_lowest_corner, _gap_to_ground, _point_itself),
}
