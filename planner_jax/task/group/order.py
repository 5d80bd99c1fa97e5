"""Local search for an order of many moving targets, by estimates of a car's travel times.

The car drives straight from one meeting to the next at its greatest speed. A turn by the angle
theta between two legs delays it by  delay sin(theta / 2)^4,  where `delay` is the duration of a
turn by pi: braking, half a circle of the greatest curvature, and accelerating.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.plane.target import PlanePath
from planner_jax.task.group.case import InterceptGroup

_GRID = 96  # number of departure times for which travel times are tabulated


@struct.dataclass
class Departure:
    """Where, when and in which direction the car starts towards the remaining targets."""

    position: Array  # (2,) [m], of the middle of the car's body
    direction: Array  # (2,), unit vector of the heading
    time: Array  # () [s]


@struct.dataclass
class Table:
    """Times and directions of straight drives between N targets, for G departure times."""

    arrival: Array  # (N, G, N) [s], time at which a car that leaves target i meets target j
    direction: Array  # (N, G, N, 2), unit vector of the drive
    step: Array  # () [s], between two departure times
    delay: Array  # () [s], of a turn by pi


def meet(path: PlanePath, position: Array, time: Array, speed: Array) -> tuple[Array, Array]:
    """Return when and where a point of constant `speed` that leaves at `time` meets a target.

    Four Newton steps are made; they converge for targets that are slower than the point.
    """
    at = time + jnp.sqrt(jnp.sum((path.at(time).pos - position) ** 2) + 1e-9) / speed
    for _ in range(4):
        state = path.at(at)
        away = state.pos - position
        far = jnp.sqrt(jnp.sum(away**2) + 1e-9)
        slope = jnp.minimum(jnp.sum(away * state.vel) / (far * speed) - 1.0, -0.1)
        at = jnp.maximum(at - (far / speed - (at - time)) / slope, time)
    return at, path.at(at).pos


def make_table(group: InterceptGroup) -> Table:
    """Tabulate the drives between the targets of one group up to the group's time."""
    shared, limits = group.shared, group.shared.limits
    step = shared.time / (_GRID - 1)
    times = step * jnp.arange(_GRID, dtype=step.dtype)
    at = jax.vmap(jax.vmap(lambda path, time: path.at(time).pos, (None, 0)), (0, None))
    places = at(shared.target, times)  # (N, G, 2)
    one = lambda place, time, path: meet(path, place, time, limits.speed)  # noqa: E731
    to_all = jax.vmap(one, (None, None, 0))
    arrival, meeting = jax.vmap(jax.vmap(to_all, (0, 0, None)), (0, None, None))(
        places, times, shared.target
    )
    slow = jnp.sqrt(limits.lateral_acceleration / limits.curvature)
    turning = np.pi / jnp.sqrt(limits.lateral_acceleration * limits.curvature)
    braking = jnp.maximum(limits.speed - slow, 0.0) / limits.acceleration
    return Table(arrival, _unit(meeting - places[:, :, None]), step, turning + 2.0 * braking)


def _unit(vectors: Array) -> Array:
    return vectors / jnp.sqrt(jnp.sum(vectors**2, axis=-1, keepdims=True) + 1e-9)


@functools.cache
def _moves(num: int) -> tuple[np.ndarray, np.ndarray]:
    """Return permutations (C, N) that reverse a part of an order or move up to three entries.

    The second array (C,) holds the first position that each permutation changes.
    """
    rows = [np.arange(num)]
    for a in range(num):
        rows += [np.r_[:a, np.arange(a, b + 1)[::-1], b + 1 : num] for b in range(a + 1, num)]
    for size in (1, 2, 3):
        for a in range(num - size + 1):
            rest = np.r_[:a, a + size : num]
            rows += [
                np.r_[rest[:b], a : a + size, rest[b:]] for b in range(len(rest) + 1) if b != a
            ]
    moves = np.unique(np.array(rows), axis=0)
    changed = moves != np.arange(num)
    first = np.where(changed.any(axis=1), changed.argmax(axis=1), num)
    return moves.astype(np.int32), first.astype(np.int32)


def end_times(
    group: InterceptGroup, table: Table, start: Departure, orders: Array, first: Array | int
) -> Array:
    """Estimate the time of the last meeting of each of C orders (C, N), (C,) [s].

    The car leaves from `start` towards the target at the position `first` () of the orders.
    """
    speed = group.shared.limits.speed
    from_start = jax.vmap(lambda path: meet(path, start.position, start.time, speed))
    arrival, meeting = from_start(group.shared.target)
    direction = _unit(meeting - start.position[None])

    def advance(k: Array, state: tuple) -> tuple:
        time, toward = state
        before, target = orders[:, jnp.maximum(k - 1, 0)], orders[:, k]
        at = time / table.step
        below = jnp.clip(at.astype(jnp.int32), 0, _GRID - 2)
        share = at - below.astype(at.dtype)
        low, high = (table.arrival[before, below + i, target] for i in range(2))
        is_first = k == first
        reached = jnp.where(is_first, arrival[target], (1.0 - share) * low + share * high)
        there = table.direction[before, below, target]
        there = jnp.where(is_first, direction[target], there)
        turn = 0.5 * (1.0 - jnp.sum(toward * there, axis=1))
        reached = jnp.maximum(reached, time) + table.delay * turn**2
        exists = group.present[target]
        return jnp.where(exists, reached, time), jnp.where(exists[:, None], there, toward)

    num = orders.shape[0]
    state = (
        jnp.broadcast_to(start.time, (num,)),
        jnp.broadcast_to(start.direction, (num, 2)),
    )
    return lax.fori_loop(first, group.num_targets, advance, state)[0]


def improve(
    group: InterceptGroup,
    table: Table,
    start: Departure,
    order: Array,
    first: Array | int,
    most: Array | int,
) -> Array:
    """Improve an order (N,) from the position `first` on, by at most `most` moves.

    Each move is the best of all moves, by the estimated end time.
    """
    moves, lowest = _moves(group.num_targets)

    def move(state: tuple) -> tuple:
        order, best, count, _ = state
        orders = order[moves]
        times = end_times(group, table, start, orders, first)
        exists = group.present[orders]  # absent targets stay at the end
        is_allowed = (lowest >= first) & jnp.all(exists[:, 1:] <= exists[:, :-1], axis=1)
        times = jnp.where(is_allowed, times, jnp.inf)
        k = jnp.argmin(times)
        return orders[k], times[k], count + 1, times[k] < best - 1e-3

    def is_open(state: tuple) -> Array:
        return state[3] & (state[2] < most)

    state = (order, jnp.asarray(jnp.inf, table.step.dtype), jnp.asarray(0), jnp.asarray(True))
    return lax.while_loop(is_open, move, state)[0]
