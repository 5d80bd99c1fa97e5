"""How far segments and rectangles in space are from each other, from boxes and from poles.

Closed forms for ONE pair of bodies, without loops or branches; `jax.vmap` makes many. A capsule is
a segment with a radius: its distance is that of the segment less the radius. World frame or any
other, SI units; the ground is the plane of x and y.

Each distance is |gap| at the nearest points, and these are where the gap is shortest. Moving them
along their bodies therefore changes the distance only in second order, so its slope is that of the
gap between points that are held (the envelope theorem). `_shortest` says so to JAX: slopes cost
little more than values, and need no division by the sine of two bodies that are nearly parallel.
Bodies that cross have distance 0 and slope 0. Where several points are nearest, as between
parallel bodies, the slope is that for one pair of them. `approach` gives the line through both,
from which the slopes by many turns and moves follow in a few products.

Vectors are tuples of components here, so that everything is one elementwise loop over the lanes.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

Vector = tuple[Array, ...]

# [m^2] and its like: what is below is zero, such as the square of a segment without length.
_TINY = 1e-24


def segment_to_segment(ends_a: Array, ends_b: Array) -> Array:
    """Distance of two segments.

    Args:
        ends_a: (2, 3) [m], which may be the same point twice.
        ends_b: likewise.

    Returns:
        () [m].
    """
    return _shortest(_nearest_of_segments, _gap_of_segments, (ends_a, ends_b))


def segment_to_rectangle(ends: Array, middle: Array, edges: Array) -> Array:
    """Distance of a segment and a flat rectangle, 0 where they cross.

    Args:
        ends: (2, 3) [m], which may be the same point twice.
        middle: (3,) [m], of the rectangle.
        edges: (2, 3) [m], halves of its edges as vectors from the middle, at right angles and
            longer than zero.

    Returns:
        () [m].
    """
    return _shortest(_nearest_of_rectangle, _gap_to_rectangle, (ends, middle, edges))


def segment_to_box(ends: Array, lower: Array, upper: Array) -> Array:
    """Distance of a segment and a box along the axes, 0 where any of the segment is inside.

    Args:
        ends: (2, 3) [m], which may be the same point twice.
        lower: (3,) [m], the box's corner of the least coordinates.
        upper: (3,) [m], that of the greatest, none below the least.

    Returns:
        () [m].
    """
    return _shortest(_nearest_of_box, _gap_to_box, (ends, lower, upper))


def segment_to_vertical_line(ends: Array, place: Array) -> Array:
    """Distance of a segment and an endless vertical line, such as the axis of a tall pole.

    Args:
        ends: (2, 3) [m], which may be the same point twice or stand upright.
        place: (2,) [m], where the line goes through the ground.

    Returns:
        () [m], within the plane of x and y.
    """
    return _shortest(_nearest_to_line, _gap_to_line, (ends, place))


def rectangle_to_vertical_line(middle: Array, edges: Array, place: Array) -> Array:
    """Distance of a flat rectangle and an endless vertical line, 0 where the line crosses it.

    Args:
        middle: (3,) [m], of the rectangle.
        edges: (2, 3) [m], halves of its edges as vectors from the middle, in any directions: any
            parallelogram will do, also one that stands upright.
        place: (2,) [m], where the line goes through the ground.

    Returns:
        () [m], within the plane of x and y.
    """
    return _shortest(_nearest_of_projection, _gap_of_projection, (middle, edges, place))


def lowest_of_segment(ends: Array) -> Array:
    """Height () [m] of the lowest point of a segment (2, 3) [m]."""
    return jnp.minimum(ends[0, 2], ends[1, 2])


def lowest_of_rectangle(middle: Array, edges: Array) -> Array:
    """Height () [m] of the lowest point of a rectangle, given as for `segment_to_rectangle`."""
    return middle[2] - jnp.abs(edges[0, 2]) - jnp.abs(edges[1, 2])


class Approach(NamedTuple):
    """The line through the nearest points of two bodies, in Pluecker's coordinates."""

    direction: Vector  # 3 times (), unit, from the second body to the first; 0 where they cross
    moment: Vector  # 3 times () [m], point x direction, of any point of the line


def approach(distance: Callable, *bodies: Array) -> Approach:
    """Where bodies have a distance of this module.

    If the first body turns about an axis a through a point o, its distance changes by
    a . (moment - o x direction) a radian; if the second one does, by as much the other way.

    Args:
        distance: a function of this module. Of the lowest points, the second body is the ground.
        bodies: its arguments.
    """
    nearest_of, gap_of, point_of = _SIDES[distance]
    nearest = nearest_of(*bodies)
    point, gap = point_of(nearest, *bodies), gap_of(nearest, *bodies)
    # Within the plane of x and y it has two components.
    gap = (*gap, *[jnp.zeros_like(gap[0])] * (3 - len(gap)))
    # Quotients in the end: XLA works such out once, and what is no division once for each use.
    length = _length(gap)
    length = jnp.where(length > 0.0, length, jnp.inf)
    direction, moment = (tuple(x / length for x in each) for each in (gap, cross(point, gap)))
    return Approach(direction, moment)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _shortest(nearest: Callable, gap: Callable, bodies: tuple[Array, ...]) -> Array:
    """Return the distance () [m] of bodies.

    `nearest` returns what names the nearest points, such as shares of segments, and `gap` the
    vector between these points, to the first body's.
    """
    return _length(gap(nearest(*bodies), *bodies))


@_shortest.defjvp
def _shortest_jvp(nearest: Callable, gap: Callable, primals: Any, tangents: Any) -> Any:
    (bodies,) = primals
    # Held, since every slope would work it out anew.
    held = lax.optimization_barrier(nearest(*bodies))
    return jax.jvp(lambda bodies: _length(gap(held, *bodies)), primals, tangents)


def _nearest_of_segments(ends_a: Array, ends_b: Array) -> tuple[Array, Array]:
    """Shares of both segments where they are nearest.

    First the share at which the lines are nearest, then for each segment in turn that nearest to
    the point of the other, which ends at the optimum (C. Ericson, Real-Time Collision Detection,
    2005, 5.1.9). The first is computed from the normal u x v and not from products of dots, so
    that in float32 it is right for lines at any angle.
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


def _nearest_of_box(ends: Array, lower: Array, upper: Array) -> Array:
    """The share of the segment that is nearest to the box."""
    start, end = _rows(ends)
    return _share_nearest_to_slabs(
        [
            _slab(low - x, high - x, speed, speed * speed)
            for x, speed, low, high in zip(start, _minus(end, start), lower, upper, strict=True)
        ]
    )


def _gap_to_box(share: Array, ends: Array, lower: Array, upper: Array) -> Vector:
    point = _point(ends, share)
    return tuple(
        x - jnp.clip(x, low, high) for x, low, high in zip(point, lower, upper, strict=True)
    )


def _nearest_of_rectangle(ends: Array, middle: Array, edges: Array) -> Any:
    """Shares of the segment and of both half-edges, from -1 to 1, and whether the bodies part.

    The rectangle is a box without thickness along axes of its own: of the half-edges e and f and
    of e x f. Squared lengths are all in units of |e|^2 |f|^2, which saves divisions.
    """
    (start, end), (e, f) = _rows(ends), _rows(edges)
    step, away = _minus(end, start), _minus(start, tuple(middle))
    squares = dot(e, e), dot(f, f)
    places = [(dot(away, axis), dot(step, axis)) for axis in (e, f)]
    normal = cross(e, f)
    height, climb = dot(away, normal), dot(step, normal)
    plane = _slab(-height, -height, climb, climb * climb)
    slabs = [
        _slab(-square - place, square - place, speed, speed * speed * other)
        for (place, speed), square, other in zip(places, squares, squares[::-1], strict=True)
    ]
    share = _share_nearest_to_slabs([*slabs, plane])
    through = plane.enters
    crosses = (plane.weight > 0.0) & (through >= 0.0) & (through <= 1.0)
    for (place, speed), square in zip(places, squares, strict=True):
        crosses = crosses & (jnp.abs(place + through * speed) <= square)
    of_edges = [
        jnp.clip(_ratio(place + share * speed, square), -1.0, 1.0)
        for (place, speed), square in zip(places, squares, strict=True)
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
    """What lies between two parallel planes, as a segment meets it."""

    enters: Array  # () share of the segment at which its line enters
    leaves: Array  # () the same where it leaves, at least `enters`
    weight: Array  # () squared length of the segment across the slab; 0 if it lies along


def _slab(to_low: Array, to_high: Array, speed: Array, weight: Array) -> _Slab:
    """A slab by the ways () from a segment's start to both planes, and its length across."""
    moves = weight > _TINY
    step = jnp.where(moves, speed, 1.0)
    # Not times the inverse: a product may be fused with a later difference, which then is not 0.
    first, last = to_low / step, to_high / step
    return _Slab(
        enters=jnp.minimum(first, last),
        leaves=jnp.maximum(first, last),
        weight=jnp.where(moves, weight, 0.0),
    )


def _share_nearest_to_slabs(slabs: list[_Slab]) -> Array:
    """Share () of a segment that is nearest to what three slabs at right angles have in common.

    The squared distance of the segment's points is a sum over the slabs of squared ways back into
    them. It is convex, and half its slope by the share s,

        sum_i  weight_i (max(s - leaves_i, 0) - max(enters_i - s, 0)),

    is piecewise linear, with bends where the segment's line enters and leaves the slabs. It never
    falls: its zero lies between the last bend with no more than 0 and the first with no less, and
    is found there by interpolation. Where it is 0 on a whole interval, the middle is taken.

    Written so, a slab adds exactly 0 at its own bends in float32 too. Computed from coordinates it
    would add the rounding of a segment that runs across it, beside which the slope of the others,
    if the segment is nearly along them, is nothing: the zero would be found elsewhere.
    """

    def slope(s: Array | float) -> Array:
        a, b, c = (
            slab.weight * (jnp.maximum(s - slab.leaves, 0.0) - jnp.maximum(slab.enters - s, 0.0))
            for slab in slabs
        )
        return a + b + c

    low = jnp.where(slope(1.0) <= 0.0, 1.0, 0.0)
    high = jnp.where(slope(0.0) >= 0.0, 0.0, 1.0)
    for slab in slabs:
        for bend in (_unit(slab.enters), _unit(slab.leaves)):
            value = slope(bend)
            low = jnp.where(value <= 0.0, jnp.maximum(low, bend), low)
            high = jnp.where(value >= 0.0, jnp.minimum(high, bend), high)
    fall, rise = slope(low), slope(high)
    rises = rise > fall
    between = jnp.where(rises, low * rise - high * fall, 0.5 * (low + high))
    return between / jnp.where(rises, rise - fall, 1.0)


def _nearest_to_line(ends: Array, place: Array) -> Array:
    start, end = _ground(ends)
    step = _minus(end, start)
    return _unit(_ratio(dot(_minus(tuple(place), start), step), dot(step, step)))


def _gap_to_line(share: Array, ends: Array, place: Array) -> Vector:
    return _minus(_point(ends, share)[:2], tuple(place))


def _nearest_of_projection(middle: Array, edges: Array, place: Array) -> Any:
    """Shares of both half-edges, from -1 to 1, and whether the line parts from the rectangle.

    They are those of the nearest point of the four edges of the rectangle's projection.
    """
    e, f = _ground(edges)
    to_x, to_y = to = tuple(x - m for x, m in zip(place, middle[:2], strict=True))
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
    # A projection without width has points far off on its line that the areas do not tell apart.
    inside = inside & (dot(to, to) <= squares[0] + squares[1] + 2.0 * jnp.abs(product))
    return p, q, ~inside


def _gap_of_projection(nearest: Any, middle: Array, edges: Array, place: Array) -> Vector:
    p, q, apart = nearest
    e, f = _ground(edges)
    return tuple(
        jnp.where(apart, m + p * a + q * b - x, 0.0)
        for m, a, b, x in zip(middle[:2], e, f, place, strict=True)
    )


def _length(vector: Vector) -> Array:
    """Length () of a vector; 0, with slope 0, of one that is too short to have a direction."""
    square = dot(vector, vector)
    apart = square > _TINY
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)


def _ratio(top: Array, square: Array) -> Array:
    """The quotient of two numbers (), 0 where the second, a square, is 0."""
    there = square > _TINY
    return jnp.where(there, top / jnp.where(there, square, 1.0), 0.0)


def _unit(share: Array) -> Array:
    return jnp.clip(share, 0.0, 1.0)


def _point(ends: Array, share: Array) -> Vector:
    """The point of a segment (2, 3) at a share () of it."""
    start, end = _rows(ends)
    return tuple(a + share * (b - a) for a, b in zip(start, end, strict=True))


def _rows(pair: Array) -> tuple[Vector, Vector]:
    """Two vectors (2, 3), each as its components."""
    return tuple(pair[0]), tuple(pair[1])


def _ground(pair: Array) -> tuple[Vector, Vector]:
    """Two vectors (2, 3) projected onto the ground, each as its components."""
    return tuple(pair[0, :2]), tuple(pair[1, :2])


def _minus(a: Vector, b: Vector) -> Vector:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def dot(a: Vector, b: Vector) -> Array:
    """The scalar product of two vectors."""
    first, *others = (x * y for x, y in zip(a, b, strict=True))
    return sum(others, first)


def cross(a: Vector, b: Vector) -> Vector:
    """The cross product of two vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _area(a: Vector, b: Vector) -> Array:
    """Signed area () of the parallelogram of two vectors in the plane."""
    return a[0] * b[1] - a[1] * b[0]


def _nearest_end(ends: Array) -> Vector:
    """The lower end of a segment."""
    start, end = _rows(ends)
    return tuple(jnp.where(start[2] < end[2], a, b) for a, b in zip(start, end, strict=True))


def _nearest_corner(middle: Array, edges: Array) -> Vector:
    """The lowest point of a rectangle."""
    p, q = -jnp.sign(edges[0, 2]), -jnp.sign(edges[1, 2])
    return _point_of_rectangle((p, q), middle, edges)


def _gap_to_ground(lowest: Vector, *bodies: Array) -> Vector:
    """Upwards, of any length."""
    return (jnp.zeros_like(lowest[0]), jnp.zeros_like(lowest[0]), jnp.ones_like(lowest[0]))


def _point_of_rectangle(nearest: Any, middle: Array, edges: Array, *other: Array) -> Vector:
    (e, f), (p, q, *_) = _rows(edges), nearest
    return tuple(m + p * a + q * b for m, a, b in zip(middle, e, f, strict=True))


def _point_of_first(shares: Any, ends: Array, *other: Array) -> Vector:
    return _point(ends, shares[0])


def _point_of_share(share: Array, ends: Array, *other: Array) -> Vector:
    return _point(ends, share)


def _point_itself(lowest: Vector, *bodies: Array) -> Vector:
    return lowest


# Of each distance: what names the nearest points, the gap between them, the first body's point.
_SIDES: dict[Callable, tuple[Callable, Callable, Callable]] = {
    segment_to_segment: (_nearest_of_segments, _gap_of_segments, _point_of_first),
    segment_to_rectangle: (_nearest_of_rectangle, _gap_to_rectangle, _point_of_first),
    segment_to_box: (_nearest_of_box, _gap_to_box, _point_of_share),
    segment_to_vertical_line: (_nearest_to_line, _gap_to_line, _point_of_share),
    rectangle_to_vertical_line: (_nearest_of_projection, _gap_of_projection, _point_of_rectangle),
    lowest_of_segment: (_nearest_end, _gap_to_ground, _point_itself),
    lowest_of_rectangle: (_nearest_corner, _gap_to_ground, _point_itself),
}
