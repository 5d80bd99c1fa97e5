"""Distances between segments and rectangles in space, and of both from boxes, poles and the ground.

Every function is a closed form for ONE pair of bodies, without loops or branches; `jax.vmap` makes
many. The distance of a capsule is the distance of its segment less its radius. Any frame, SI units;
the ground is the plane of x and y. The bodies are:

* a segment: `ends` (2, 3) [m], which may coincide;
* a rectangle: its `middle` (3,) [m] and `edges` (2, 3) [m], halves of its edges as vectors from the
  middle, at right angles and longer than zero;
* a box along the axes: its corners `lower` and `upper` (3,) [m], `lower` <= `upper`;
* a vertical line of infinite length, such as the axis of a pole: its `position` (2,) [m] on the
  ground.

A distance is the least length |gap| of a vector between points of both bodies. Moving the nearest
points along their bodies changes it only in second order, so the derivative of the distance is the
derivative of |gap| at fixed nearest points (the envelope theorem). `_shortest` declares this rule
to JAX: derivatives cost little more than values, and need no division by the sine of the angle
between nearly parallel bodies. Bodies that cross have distance 0 and derivative 0. If several pairs
of points are nearest, as between parallel bodies, the derivative belongs to one of them. `approach`
returns the line through the nearest points, from which the derivatives by many rotations and
translations follow in a few products.

Vectors are tuples of components here, so that XLA compiles one elementwise loop over the batch.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

Vector = tuple[Array, ...]

_TINY = 1e-24  # smaller squares of lengths [m^2] or areas [m^4] count as zero


def segment_to_segment(ends_a: Array, ends_b: Array) -> Array:
    """Return the distance () [m] of two segments."""
    return _shortest(_nearest_of_segments, _gap_of_segments, (ends_a, ends_b))


def segment_to_rectangle(ends: Array, middle: Array, edges: Array) -> Array:
    """Return the distance () [m] of a segment and a flat rectangle, 0 if they cross."""
    return _shortest(_nearest_of_rectangle, _gap_to_rectangle, (ends, middle, edges))


def segment_to_box(ends: Array, lower: Array, upper: Array) -> Array:
    """Return the distance () [m] of a segment and a box, 0 if a point of the segment is inside."""
    return _shortest(_nearest_of_box, _gap_to_box, (ends, lower, upper))


def segment_to_vertical_line(ends: Array, position: Array) -> Array:
    """Return the horizontal distance () [m] of a segment and a vertical line."""
    return _shortest(_nearest_to_line, _gap_to_line, (ends, position))


def rectangle_to_vertical_line(middle: Array, edges: Array, position: Array) -> Array:
    """Return the horizontal distance () [m] of a rectangle and a vertical line, 0 if they cross.

    The edges need not be at right angles: any parallelogram is valid, also an upright one.
    """
    return _shortest(_nearest_of_projection, _gap_of_projection, (middle, edges, position))


def lowest_of_segment(ends: Array) -> Array:
    """Return the height () [m] of the lowest point of a segment."""
    return jnp.minimum(ends[0, 2], ends[1, 2])


def lowest_of_rectangle(middle: Array, edges: Array) -> Array:
    """Return the height () [m] of the lowest point of a rectangle."""
    return middle[2] - jnp.abs(edges[0, 2]) - jnp.abs(edges[1, 2])


class Approach(NamedTuple):
    """The line through the nearest points of two bodies, in Pluecker coordinates."""

    direction: Vector  # 3 times (), unit, from the second body to the first; 0 if they cross
    moment: Vector  # 3 times () [m], p x direction for any point p of the line


def approach(distance: Callable, *bodies: Array) -> Approach:
    """Return the line through the nearest points of two bodies.

    If the first body turns about an axis a through a point o, the derivative of the distance by the
    angle is a . (moment - o x direction). If the second body turns, the sign is the opposite.

    Args:
        distance: a distance or a height of this module; for a height the second body is the ground.
        bodies: the arguments of `distance`.
    """
    nearest_of, gap_of, point_of = _PARTS[distance]
    nearest = nearest_of(*bodies)
    point, gap = point_of(nearest, *bodies), gap_of(nearest, *bodies)
    # A horizontal gap has two components.
    gap = (*gap, *[jnp.zeros_like(gap[0])] * (3 - len(gap)))
    # Divide last: XLA computes a quotient once, but other arithmetic once for each use.
    length = _length(gap)
    length = jnp.where(length > 0.0, length, jnp.inf)
    direction, moment = (tuple(x / length for x in each) for each in (gap, cross(point, gap)))
    return Approach(direction, moment)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _shortest(nearest: Callable, gap: Callable, bodies: tuple[Array, ...]) -> Array:
    """Return the distance () [m] of two bodies.

    `nearest` returns the parameters of the nearest points, such as shares of segments. `gap`
    returns the vector from the second body's nearest point to the first body's.
    """
    return _length(gap(nearest(*bodies), *bodies))


@_shortest.defjvp
def _shortest_jvp(nearest: Callable, gap: Callable, primals: Any, tangents: Any) -> Any:
    (bodies,) = primals
    # Without the barrier XLA would compute the nearest points again for every derivative.
    fixed = lax.optimization_barrier(nearest(*bodies))
    return jax.jvp(lambda bodies: _length(gap(fixed, *bodies)), primals, tangents)


def _nearest_of_segments(ends_a: Array, ends_b: Array) -> tuple[Array, Array]:
    """Return the shares of both segments at which they are nearest.

    The first share is where the infinite lines are nearest. Then each segment in turn takes its
    point nearest to the other's point, which ends at the optimum (C. Ericson, Real-Time Collision
    Detection, 2005, 5.1.9). The first share is computed from the normal u x v, not from products of
    dot products, so that it is accurate in float32 for lines at any angle.
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
    """Return the share of the segment at which it is nearest to the box."""
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


def _nearest_of_rectangle(ends: Array, middle: Array, edges: Array) -> Any:
    """Return the shares of the segment and the half-edges, and whether the bodies are apart.

    Shares of half-edges are from -1 to 1. The rectangle is a box without thickness along axes of
    its own: the half-edges e and f, and e x f. Squared lengths are in units of |e|^2 |f|^2, which
    saves divisions.
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


def _gap_to_rectangle(nearest: Any, ends: Array, middle: Array, edges: Array) -> Vector:
    share, (p, q), apart = nearest
    away = _minus(_point(ends, share), tuple(middle))
    e, f = _rows(edges)
    return tuple(
        jnp.where(apart, x - p * a - q * b, 0.0) for x, a, b in zip(away, e, f, strict=True)
    )


class _Slab(NamedTuple):
    """The intersection of a segment's line with the space between two parallel planes."""

    enters: Array  # () share of the segment at which its line enters
    leaves: Array  # () share at which the line leaves, at least `enters`
    weight: Array  # () squared length of the segment across the slab; 0 if it is parallel


def _slab(to_low: Array, to_high: Array, speed: Array, weight: Array) -> _Slab:
    """Make a slab from the distances () of both planes from a segment's start.

    `speed` is the segment's length across the slab, and `weight` its square in a unit that all
    slabs of a problem share.
    """
    moves = weight > _TINY
    step = jnp.where(moves, speed, 1.0)
    # Do not multiply by the inverse: a product may be fused with a later difference, which then
    # is not exactly 0.
    first, last = to_low / step, to_high / step
    return _Slab(
        enters=jnp.minimum(first, last),
        leaves=jnp.maximum(first, last),
        weight=jnp.where(moves, weight, 0.0),
    )


def _share_nearest_to_slabs(slabs: list[_Slab]) -> Array:
    """Return the share () of a segment nearest to the intersection of three orthogonal slabs.

    The squared distance of a point of the segment is the sum over the slabs of its squared distance
    from each. It is convex in the share s, and half its derivative,

        sum_i  weight_i (max(s - leaves_i, 0) - max(enters_i - s, 0)),

    is piecewise linear and never falls, with kinks where the segment's line enters and leaves the
    slabs. Its zero lies between the last kink with a value <= 0 and the first with a value >= 0,
    and is found there by interpolation. If it is 0 on a whole interval, the middle is returned.

    In this form a slab adds exactly 0 at its own kinks, also in float32. Computed from coordinates
    it would add a rounding error in proportion to the segment's length across it. That error hides
    the other terms if the segment is nearly parallel to their slabs, and moves the zero.
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


def _nearest_to_line(ends: Array, position: Array) -> tuple[Array]:
    start, end = _ground(ends)
    step = _minus(end, start)
    return (_unit(_ratio(dot(_minus(tuple(position), start), step), dot(step, step))),)


def _gap_to_line(shares: tuple[Array], ends: Array, position: Array) -> Vector:
    return _minus(_point(ends, shares[0])[:2], tuple(position))


def _nearest_of_projection(middle: Array, edges: Array, position: Array) -> Any:
    """Return the shares of both half-edges, from -1 to 1, and whether the line is outside.

    They belong to the nearest point on the four edges of the rectangle's projection.
    """
    e, f = _ground(edges)
    to_x, to_y = to = tuple(x - m for x, m in zip(position, middle[:2], strict=True))
    squares, product = (dot(e, e), dot(f, f)), dot(e, f)
    ahead = (dot(to, e), dot(to, f))
    nearest = jnp.full_like(product, jnp.inf)
    p = q = jnp.zeros_like(product)
    for side in (-1.0, 1.0):
        on_f = jnp.clip(_ratio(ahead[1] - side * product, squares[1]), -1.0, 1.0)
        on_e = jnp.clip(_ratio(ahead[0] - side * product, squares[0]), -1.0, 1.0)
        for along_e, along_f in ((side, on_f), (on_e, side)):
            gap_x = to_x - along_e * e[0] - along_f * f[0]
            gap_y = to_y - along_e * e[1] - along_f * f[1]
            square = gap_x * gap_x + gap_y * gap_y
            closer = square < nearest
            nearest = jnp.where(closer, square, nearest)
            p, q = jnp.where(closer, along_e, p), jnp.where(closer, along_f, q)
    area = jnp.abs(_area(e, f))
    inside = (jnp.abs(_area(to, f)) < area) & (jnp.abs(_area(e, to)) < area)
    # All areas are 0 for points in line with a projection without width, however far off.
    inside = inside & (dot(to, to) <= squares[0] + squares[1] + 2.0 * jnp.abs(product))
    return p, q, ~inside


def _gap_of_projection(nearest: Any, middle: Array, edges: Array, position: Array) -> Vector:
    p, q, apart = nearest
    e, f = _ground(edges)
    return tuple(
        jnp.where(apart, m + p * a + q * b - x, 0.0)
        for m, a, b, x in zip(middle[:2], e, f, position, strict=True)
    )


def _length(vector: Vector) -> Array:
    """Return the length () of a vector; 0, with derivative 0, if it is too short."""
    square = dot(vector, vector)
    apart = square > _TINY
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)


def _ratio(top: Array, square: Array) -> Array:
    """Return top / square (), or 0 if the square is 0."""
    is_positive = square > _TINY
    return jnp.where(is_positive, top / jnp.where(is_positive, square, 1.0), 0.0)


def _unit(share: Array) -> Array:
    return jnp.clip(share, 0.0, 1.0)


def _point(ends: Array, share: Array) -> Vector:
    """Return the point of a segment (2, 3) at a share ()."""
    start, end = _rows(ends)
    return tuple(a + share * (b - a) for a, b in zip(start, end, strict=True))


def _rows(pair: Array) -> tuple[Vector, Vector]:
    """Split two vectors (2, 3) into their components."""
    return tuple(pair[0]), tuple(pair[1])


def _ground(pair: Array) -> tuple[Vector, Vector]:
    """Project two vectors (2, 3) onto the ground and split them into their components."""
    return tuple(pair[0, :2]), tuple(pair[1, :2])


def _minus(a: Vector, b: Vector) -> Vector:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def dot(a: Vector, b: Vector) -> Array:
    """Return the scalar product of two vectors."""
    first, *others = (x * y for x, y in zip(a, b, strict=True))
    return sum(others, first)


def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product of two vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _area(a: Vector, b: Vector) -> Array:
    """Return the signed area () of the parallelogram of two vectors in the plane."""
    return a[0] * b[1] - a[1] * b[0]


def _lowest_end(ends: Array) -> Vector:
    start, end = _rows(ends)
    return tuple(jnp.where(start[2] < end[2], a, b) for a, b in zip(start, end, strict=True))


def _lowest_corner(middle: Array, edges: Array) -> Vector:
    p, q = -jnp.sign(edges[0, 2]), -jnp.sign(edges[1, 2])
    return _point_of_rectangle((p, q), middle, edges)


def _gap_to_ground(lowest: Vector, *bodies: Array) -> Vector:
    """Return a vector upwards; its length does not matter."""
    return (jnp.zeros_like(lowest[0]), jnp.zeros_like(lowest[0]), jnp.ones_like(lowest[0]))


def _point_of_rectangle(nearest: Any, middle: Array, edges: Array, *other: Array) -> Vector:
    (e, f), (p, q, *_) = _rows(edges), nearest
    return tuple(m + p * a + q * b for m, a, b in zip(middle, e, f, strict=True))


def _point_of_segment(shares: Any, ends: Array, *other: Array) -> Vector:
    return _point(ends, shares[0])


def _point_itself(lowest: Vector, *bodies: Array) -> Vector:
    return lowest


# Distance -> functions for the nearest points' parameters, the gap, and the first body's point.
_PARTS: dict[Callable, tuple[Callable, Callable, Callable]] = {
    segment_to_segment: (_nearest_of_segments, _gap_of_segments, _point_of_segment),
    segment_to_rectangle: (_nearest_of_rectangle, _gap_to_rectangle, _point_of_segment),
    segment_to_box: (_nearest_of_box, _gap_to_box, _point_of_segment),
    segment_to_vertical_line: (_nearest_to_line, _gap_to_line, _point_of_segment),
    rectangle_to_vertical_line: (_nearest_of_projection, _gap_of_projection, _point_of_rectangle),
    lowest_of_segment: (_lowest_end, _gap_to_ground, _point_itself),
    lowest_of_rectangle: (_lowest_corner, _gap_to_ground, _point_itself),
}
