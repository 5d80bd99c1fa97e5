"""Times at which a thrown ball enters the boxes of a scene; it must be met in between."""

import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.ball.flight import BallState, drag_free_fall_time, drag_free_flight
from planner_jax.robot.arm_scene import Box
from planner_jax.task.block.case import BlockCase

# See `rounded_entry_time`: number of advances, gain of speed [m/s] during one, and distance [m].
_ADVANCES, _MORE_SPEED, _REACHED = 32, 1.0, 1e-4


@struct.dataclass
class Flight:
    """Times at which a ball enters an outer and an inner box; it must be met in between."""

    earliest: Array  # () [s], time at which the ball enters the outer box
    latest: Array  # () [s], time at which the ball enters the inner, protected box
    comes: Array  # () bool, whether the ball enters both boxes


def flight_of(case: BlockCase) -> Flight:
    """Compute when a ball enters the outer box, where it may be met, and touches the inner box."""
    scene = case.scene
    earliest, enters = entry_time(scene.outer, case.ball, case.gravity)
    radius = scene.inner_radius + case.ball_radius
    body = scene.inner, radius, case.ball, case.gravity, scene.inner_ends
    latest, hits = rounded_entry_time(*body)
    return Flight(earliest=earliest, latest=latest, comes=enters & hits & (latest > earliest))


def entry_time(box: Box, ball: BallState, gravity: Array) -> tuple[Array, Array]:
    """Return the time at which a ball without drag enters a box through a side or the top.

    The coordinates are processed one by one, so that the compiled program has few loops.

    Returns:
        time: () [s].
        enters: () bool; false for a ball that misses the box, starts inside, or enters from below.
    """
    between = []
    for axis in range(2):
        x, v = ball.pos[axis], ball.vel[axis]
        moves = jnp.where(jnp.abs(v) > 1e-6, v, 1e-6)
        between.append(((box.lower[axis] - x) / moves, (box.upper[axis] - x) / moves))
    from_side = jnp.maximum(*(jnp.minimum(*times) for times in between))
    until = jnp.minimum(*(jnp.maximum(*times) for times in between))
    from_top, _ = drag_free_fall_time(ball, box.upper[2], gravity)

    def height(time: Array) -> Array:
        return ball.pos[2] + ball.vel[2] * time - 0.5 * gravity * time**2

    time = jnp.where(height(jnp.maximum(from_side, 0.0)) > box.upper[2], from_top, from_side)
    return time, (time > 0.0) & (time <= until) & (height(time) > box.lower[2])


def rounded_entry_time(
    box: Box, radius: Array, ball: BallState, gravity: Array, ends: Array | None = None
) -> tuple[Array, Array]:
    """Return the time at which a ball without drag gets to the distance `radius` from a box.

    With the ends (2, 3) [m] of a segment in the box, the distance is the distance from the segment.
    The ball first enters the box enlarged by the radius. From there it advances by its distance
    divided by a bound of its speed, which never passes the rounded edges.

    Returns:
        time: () [s].
        enters: () bool, as for `entry_time`.
    """
    time, enters = entry_time(Box(box.lower - radius, box.upper + radius), ball, gravity)

    def gap(time: Array) -> Array:
        pos = drag_free_flight(ball, time, gravity).pos
        if ends is None:
            away = pos - jnp.clip(pos, box.lower, box.upper)
        else:
            span = ends[1] - ends[0]
            share = jnp.sum((pos - ends[0]) * span) / jnp.sum(span * span)
            away = pos - ends[0] - jnp.clip(share, 0.0, 1.0) * span
        return jnp.sqrt(jnp.maximum(jnp.sum(away**2), 1e-12)) - radius

    def advance(_: Array, time: Array) -> Array:
        velocity = drag_free_flight(ball, time, gravity).vel
        speed = jnp.sqrt(jnp.sum(velocity**2)) + _MORE_SPEED
        return time + jnp.maximum(gap(time), 0.0) / speed

    def search() -> tuple[Array, Array]:
        num = _ADVANCES if ends is None else 4 * _ADVANCES
        there = lax.fori_loop(0, num, advance, time)
        return there, enters & (gap(there) < _REACHED)

    return lax.cond(radius > 0.0, search, lambda: (time, enters))
