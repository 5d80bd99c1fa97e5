"""Motions of a car from which least squares start: along cells, and directly to the target."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.plane.cell_paths import CellPath
from planner_jax.plane.reach import Grid
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.problem.bounds import longest_drive

_HIGHEST = lax.Precision.HIGHEST


class Drive(NamedTuple):
    """A motion of K pieces, and the positions that least squares shall follow at first."""

    speed: Array  # (K,) [m/s], at the knots 1 to K
    curvature: Array  # (K,) [1/m], at these knots
    time: Array  # () [s], of the meeting
    positions: Array  # (K, 2) [m], rear axle's middle at these knots


def drive_along(
    case: InterceptCase, grid: Grid, speeds: Array, path: CellPath, layer: Array, pieces: int
) -> Drive:
    """Return a motion of `pieces` pieces that follows a path of cells, headings and speeds.

    The path has one cell for each of the grid's equally spaced times. It meets the target at
    the time with the index `layer` () int32. `speeds` (levels,) are the speeds of its levels.
    """
    width = 2.0 * np.pi / grid.lattice.headings
    steps = layer.astype(speeds.dtype) + 0.5
    # Times of the knots 1 to K, in units of the grid's time step.
    at = jnp.arange(1, pieces + 1, dtype=steps.dtype) * (steps / pieces)

    def interpolate(values: Array, first: Array, at: Array) -> Array:
        at = jnp.clip(at - 1.0, -1.0, layer.astype(at.dtype) - 1.0)
        below = jnp.floor(at).astype(jnp.int32)
        share, is_first = (
            each.reshape(-1, *[1] * (values.ndim - 1))
            for each in (at - below.astype(at.dtype), below < 0)
        )
        low = jnp.where(is_first, first, values[jnp.maximum(below, 0)])
        return (1.0 - share) * low + share * values[jnp.minimum(below + 1, layer - 1)]

    speed = interpolate(speeds[path.level], case.speed, at)
    bins = width * path.bin.astype(grid.cell.dtype)
    # The path's headings, relative to the car's initial heading, may include full turns.
    # `straight` [rad] is the multiple of 2 pi in the first of these headings.
    straight = jnp.round(bins[0] / (2.0 * np.pi)) * 2.0 * np.pi
    after, before = (interpolate(bins, straight, at + half) for half in (0.5, -0.5))
    rate = (after - before) / grid.step
    # The car starts with its own turn rate instead of the path's turn rate, which would change
    # all later headings. The turn rates at the knots 1 and 2 compensate for this.
    time = steps * grid.step
    knot = time / pieces
    first = case.speed * case.curvature
    turned = 0.5 * knot * (first + 2.0 * rate[0] + rate[1])
    lag = interpolate(bins, straight, at)[1] - straight - turned
    rate = rate.at[:2].add(0.5 * lag / knot)
    forward = jnp.maximum(jnp.abs(speed), 0.3 * jnp.max(jnp.abs(speeds)))
    curvature = rate / jnp.where(speed < 0.0, -forward, forward)
    limit = case.limits.curvature
    cells = grid.corner[None] + grid.cell[None] * path.cell.astype(grid.cell.dtype)
    positions = interpolate(cells, case.start[:2], at - 0.5)
    return Drive(speed, jnp.clip(curvature, -limit, limit), time, positions)


def drive_directly(case: InterceptCase, time: Array, pieces: int) -> Drive:
    """Return a motion of `pieces` pieces straight to the target at a time, past no obstacle.

    The motion is a point's motion with the least integral of the squared acceleration: a cubic
    polynomial in time. The point starts with the car's position and velocity. It is at the
    target at the time `time` (). Obstacles and limits are ignored. The car drives in reverse if it
    may, does not move forward at first, and the target is behind it. The case is in the units of
    `units.enter_units`.
    """
    is_heading_free = case.heading_tolerance >= np.pi
    first = case.speed * jnp.asarray([1.0, 0.0], time.dtype)
    limits, is_behind = case.limits, case.target.at(time).pos[0] < 0.0
    is_reverse = is_behind & (limits.least_speed < 0.0) & (case.speed <= 0.0)
    gear = jnp.where(is_reverse, -1.0, 1.0).astype(time.dtype)
    fastest = jnp.where(is_reverse, -limits.least_speed, limits.speed)
    bounds = jnp.where(is_reverse, -case.end_speed[::-1], case.end_speed)

    def solve(heading: Array) -> tuple[Array, Array]:
        ahead = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        goal = case.target.at(time).pos - case.body.middle * ahead
        offset = goal - first * time
        free = first + 1.5 * offset / time  # velocity at the end of the optimal motion
        along = jnp.clip(gear * jnp.dot(free, ahead, precision=_HIGHEST), 0.1, fastest)
        low, high = bounds[0], bounds[1]
        end = gear * ahead * jnp.clip(along, low, jnp.maximum(high, low))
        is_free = is_heading_free & (low <= 0.0) & jnp.isinf(high)
        end = jnp.where(is_free, free, end)
        # Coefficients of t^2 and t^3 for the given position and velocity at the end.
        change = end - first
        return 3.0 * offset / time**2 - change / time, change / time**2 - 2.0 * offset / time**3

    square, cube = solve(case.end_heading)
    leaving = gear * (first + time * (2.0 * square + 3.0 * time * cube))
    heading = jnp.where(is_heading_free, jnp.arctan2(leaving[1], leaving[0]), case.end_heading)
    square, cube = solve(heading)
    at = time * (jnp.arange(1, pieces + 1, dtype=time.dtype) / pieces)[:, None]
    first, square, cube = first[None], square[None], cube[None]
    pos = at * (first + at * (square + at * cube))
    vel = first + at * (2.0 * square + 3.0 * at * cube)
    bend = 2.0 * square + 6.0 * at * cube
    speed = jnp.sqrt(jnp.sum(vel**2, axis=1) + 1e-6)
    curvature = gear * (vel[:, 0] * bend[:, 1] - vel[:, 1] * bend[:, 0]) / speed**3
    limit = limits.curvature
    speed = gear * jnp.minimum(speed, fastest)
    return Drive(speed, jnp.clip(curvature, -limit, limit), time, pos)


def earliest_time(case: InterceptCase) -> Array:
    """Return the first of 16 times () at which the car may be far enough to meet the target."""
    times = case.time * jnp.linspace(1.0 / 16.0, 1.0, 16, dtype=case.time.dtype)
    away = jax.vmap(lambda time: case.target.at(time).pos)(times)
    apart = jnp.sqrt(jnp.sum(away**2, axis=1))
    is_open = (longest_drive(case, times) >= apart) & (times >= case.earliest)
    return jnp.where(jnp.any(is_open), times[jnp.argmax(is_open)], case.time)
