"""Search forwards for motions of a car with a limited steering rate, from which plans start.

Paths of grid cells ignore the limit of the steering rate, and round turns to the grid's headings.
Least squares from such paths miss a few cases. Here a state is the car's position, heading, speed
and curvature. The search makes K steps of equal duration. In each step a state has random
successors within the car's limits; speed and curvature are linear in time, as in a plan. Successors
that collide are discarded. Also discarded are successors from which a car on the grid could not
meet the target in time, by a reach set that is computed backwards from the target.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.plane import reach
from planner_jax.plane.distance_field import DistanceField
from planner_jax.robot.car_motion import Motion, motion
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.problem.clearance import clearance, nearest_in_region
from planner_jax.task.intercept.searches import LoadedSearch, compute_reach

# Changes of speed and of curvature in a step, relative to their limits.
_CONTROLS = np.stack(
    np.meshgrid([-1.0, -0.4, 0.0, 0.4, 1.0], [-1.0, -0.5, -0.15, 0.0, 0.15, 0.5, 1.0])
).reshape(2, -1)
_JITTER = 0.25  # greatest random change of these numbers
# Sides of cells over which states are spread evenly, in the units of `units.enter_units`: x, y,
# heading, speed and curvature.
_SIDES = np.array([0.15, 0.15, 0.25, 0.3, 10.0])
_TABLE = 1 << 16  # number of entries of a table of cells
_PREFERENCE = 1.4  # logarithm of the number of likely states that are continued for each other one
_CHECKED = 2  # number of successors that are checked for collisions, for each continued state
_SHARPEST = 20.0  # greatest curvature of a path, in the units
_PARTS = 8  # number of samples of a step at which obstacles are checked


@struct.dataclass
class StatePaths:
    """Motions of the car that meet the target without a collision, the best first."""

    speed: Array  # (paths, K), at the knots 1 to K
    curvature: Array  # (paths, K)
    is_reached: Array  # () bool, whether there is a motion; else the arrays are meaningless


def find_state_paths(
    case: InterceptCase, search: LoadedSearch, grid: reach.Grid, field: DistanceField, pieces: int
) -> StatePaths:
    """Search for motions of `pieces` steps that meet the target at the case's time.

    The case is in the units of `units.enter_units`. `grid` and `field` are the results of
    `searches.make_grid` and `searches.make_field`. Of the states after each step at most
    `search.states` are continued. The motions end in the last states that are nearest to the
    target; nearer than its tolerance, all are equal.
    """
    num, dtype, span = search.states, case.time.dtype, case.time / pieces
    found = compute_reach(case, search, grid, field, grid.num, is_backward=True)
    wide = jax.vmap(reach.widen)(found.bits)
    parent = jnp.repeat(jnp.arange(num), _CONTROLS.shape[1])

    def step(before: tuple, inputs: tuple) -> tuple[tuple, tuple]:
        states, is_open = before
        n, key = inputs
        keys = jax.random.split(key)
        ends, fits = _list_ends(case, span, states, keys[0])
        _, after = _drive(states[parent], ends, span, 1)
        admits = lambda bits: _admits(grid, bits, found.speeds, (n + 1.0) * span, after)  # noqa: E731
        fits &= is_open[parent] & admits(wide)
        # Draw states without replacement, by Gumbel noise, so that cells are equally likely.
        cell = _number(after)
        crowd = jnp.zeros(_TABLE, dtype).at[cell].add(jnp.where(fits, 1.0, 0.0))[cell]
        score = jnp.where(admits(found.bits), _PREFERENCE, 0.0) - jnp.log(jnp.maximum(crowd, 1.0))
        score = jnp.where(fits, score + jax.random.gumbel(keys[1], fits.shape, dtype), -jnp.inf)
        best, drawn = lax.top_k(score, _CHECKED * num)
        drive, after = _drive(states[parent[drawn]], ends[drawn], span, _PARTS)
        drive = dataclasses.replace(drive, time=drive.time + n * span)
        is_free = jax.vmap(lambda each: clearance(case, each) >= 0.0)(drive) & (best > -jnp.inf)
        chosen = jnp.argsort(~is_free, stable=True)[:num]
        return (after[chosen], is_free[chosen]), (after[chosen, 3:], parent[drawn[chosen]])

    steps = jnp.arange(pieces, dtype=dtype), jax.random.split(jax.random.key(0), pieces)
    start = jnp.concatenate([case.start, case.speed[None], case.curvature[None]])
    before = jnp.broadcast_to(start, (num, start.size)), jnp.ones(num, bool)
    (states, is_open), (ends, parents) = lax.scan(step, before, steps)
    ahead = jnp.stack([jnp.cos(states[:, 2]), jnp.sin(states[:, 2])], axis=1)
    away = states[:, :2] + case.body.middle * ahead - case.target.at(case.time).pos[None]
    away, _ = jax.vmap(nearest_in_region, (None, 0))(case.region, away)
    miss = jnp.maximum(jnp.sqrt(jnp.sum(away**2, axis=1)), case.tolerance)
    last = jnp.argsort(jnp.where(is_open, miss, jnp.inf), stable=True)
    last = last[: len(search.noise.layers)]  # the search's number of paths
    back = lambda which, layer: (layer[1][which], layer[0][which])  # noqa: E731
    _, knots = lax.scan(back, last, (ends, parents), reverse=True)
    speed, curvature = jnp.moveaxis(knots, 2, 0).swapaxes(1, 2)
    return StatePaths(speed, curvature, jnp.any(is_open))


def _list_ends(case: InterceptCase, span: Array, states: Array, key: Array) -> tuple[Array, Array]:
    """Return speed and curvature (M, 2) of all successors of N states, and which keep the limits.

    The successors of a state are consecutive.
    """
    limits, dtype = case.limits, states.dtype
    v0, c0 = jnp.repeat(states[:, 3:], _CONTROLS.shape[1], axis=0).T
    noise = jax.random.uniform(key, (2, len(v0)), dtype, -_JITTER, _JITTER)
    controls = jnp.tile(jnp.asarray(_CONTROLS, dtype), (1, len(states)))
    pedals, rates = jnp.clip(controls + noise, -1.0, 1.0)
    gained = jnp.minimum(span * limits.acceleration, limits.speed)
    v = jnp.clip(v0 + gained * pedals, 0.0, limits.speed)
    sharpest = jnp.minimum(limits.curvature, _SHARPEST)
    most = jnp.minimum(span * limits.steering_rate / case.body.wheelbase, 2.0 * sharpest)
    sharpest = jnp.minimum(sharpest, limits.lateral_acceleration / jnp.maximum(v**2, 1e-9))
    c = jnp.clip(c0 + most * rates, -sharpest, sharpest)
    lateral = jnp.abs((0.5 * (v + v0)) ** 2 * (0.5 * (c + c0)))
    fits = (jnp.abs(c - c0) <= 1.0001 * most) & (lateral <= limits.lateral_acceleration)
    return jnp.stack([v, c], axis=1), fits


def _drive(states: Array, ends: Array, span: Array, samples: int) -> tuple[Motion, Array]:
    """Return the motions of N cars during a step, and their last states (N, 5).

    Speed and curvature change from the values in `states` (N, 5) to `ends` (N, 2).
    """
    knots = jnp.stack([states[:, 3:], ends], axis=2)
    move = lambda at, knots: motion(at[:3], span, knots[0], knots[1], samples)  # noqa: E731
    drive = jax.vmap(move)(states, knots)
    poses = drive.pos[:, -1, -1], drive.heading[:, -1, -1:]
    return drive, jnp.concatenate([*poses, ends], axis=1)


def _admits(grid: reach.Grid, bits: Array, speeds: Array, time: Array, states: Array) -> Array:
    """Return whether states (N, 5) at one time () are in a set computed backwards, (N,) bool.

    The states are moved straight on to the nearest time of a layer.
    """
    lattice, heading = grid.lattice, states[:, 2]
    at = time / grid.step - 0.5
    layer = jnp.clip(jnp.round(at), 0.0, grid.num.astype(at.dtype))
    distance = (layer - at) * grid.step * states[:, 3]
    ahead = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=1)
    cell = (states[:, :2] + distance[:, None] * ahead - grid.corner[None]) / grid.cell[None]
    turned = (heading - grid.heading) * (lattice.headings / (2.0 * np.pi))
    level = lattice.reverse_levels + states[:, 3] / jnp.abs(speeds[-1] - speeds[-2])
    whole = (jnp.round(each).astype(jnp.int32) for each in (level, turned, cell))
    layer = bits[grid.num - layer.astype(jnp.int32)]
    return jax.vmap(reach.bit_at, (None, 0, 0, 0))(layer, *whole)


def _number(states: Array) -> Array:
    """Return the entry (N,) int32 of a table for the cell of each state (N, 5), by a hash."""
    cells = jnp.floor(states / jnp.asarray(_SIDES, states.dtype)[None]).astype(jnp.int32)
    factors = np.array([73856093, 19349663, 83492791, 49979687, 15485863], np.uint32)
    mixed = jnp.sum(cells.astype(jnp.uint32) * factors[None], axis=1, dtype=jnp.uint32)
    mixed = (mixed ^ (mixed >> 15)) * jnp.uint32(2246822519)
    return ((mixed ^ (mixed >> 13)) % jnp.uint32(_TABLE)).astype(jnp.int32)
