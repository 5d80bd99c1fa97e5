"""A bounded search for orders of catching, by the estimate: for more targets than permutations."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.errors import ArgumentError
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.estimate import (
    INSTANT,
    Timetable,
    arrivals,
    later_by_shortfall,
    takeable,
    top_speed,
)

MOST_SEARCHED = 100  # targets
_WORD = 24


@struct.dataclass
class _Partial:
    """W beginnings of orders."""

    rank: Array  # (W,) [s], infinite where there is none
    short: Array  # (W,) [m], out of the estimate's reach so far
    time: Array  # (W,) [s], of the last catch
    place: Array  # (W, 3) [m], of the last catch
    position: Array  # (W, N) of each target in the order; N where it is left so far
    times: Array  # (W, N) [s], of each target


def beam(case: CatchCase, table: Timetable, width: int) -> CatchChoice:
    """Orders of one case that take most targets, and of these the earliest, leaves (W, N).

    After each catch the W best beginnings go on, at most one for the same targets with the same
    last one: a bounded search, which may miss the best order. Where fewer than W are found, the
    first one is repeated.

    Args:
        case: one case.
        table: its timetable.
        width: W.

    Raises:
        ValueError: there are more than `MOST_SEARCHED` targets.
    """
    num, speed = case.num_targets, top_speed(case)
    if num > MOST_SEARCHED:
        raise ArgumentError("targets", f"at most {MOST_SEARCHED} of a case", num)
    from_all = jax.vmap(arrivals, (None, 0, 0, None))
    # Which targets are taken, in words of so many bits that 32 hold one and the last target, too.
    words = np.arange(0, num, _WORD)
    place = np.arange(num) - words[:, None]
    inside = (place >= 0) & (place < _WORD)
    bits = jnp.asarray(np.where(inside, 1 << np.clip(place, 0, _WORD - 1), 0), jnp.int32)

    def advance(now: _Partial, step: Array) -> tuple[_Partial, _Partial]:
        times, places, shortfalls = from_all(table, now.time, now.place, speed)
        times = jnp.maximum(times, now.time[:, None] + INSTANT)
        left = now.position == num
        possible = left & jax.vmap(takeable, (None, 0))(case, shortfalls)
        short = now.short[:, None] + shortfalls
        rank = later_by_shortfall(times, short)
        rank = jnp.where(possible & jnp.isfinite(now.rank)[:, None], rank, jnp.inf).ravel()
        taken = jnp.sum(jnp.where(left, 0, bits[:, None]), axis=2, keepdims=True)
        *others, last = (taken | bits[:, None]).reshape(len(words), -1)
        state = (*others, last * num + jnp.tile(np.arange(num), width))
        # Of equal states only the first one, in order of their ranks, goes on.
        sorted_ = jnp.lexsort((rank, *state))
        alike = [jnp.diff(word[sorted_], prepend=-1) == 0 for word in state]
        again = functools.reduce(jnp.logical_and, alike)
        rank = jnp.where(jnp.zeros_like(again).at[sorted_].set(again), jnp.inf, rank)
        chosen = jnp.argsort(rank)[:width]
        row, target = chosen // num, chosen % num
        lanes = jnp.arange(width)
        then = _Partial(
            rank=rank[chosen],
            short=short[row, target],
            time=times[row, target],
            place=places[row, target],
            position=now.position[row].at[lanes, target].set(step.astype(jnp.int32)),
            times=now.times[row].at[lanes, target].set(times[row, target]),
        )
        return then, then

    begin = _Partial(
        rank=jnp.where(np.arange(width) == 0, 0.0, jnp.inf).astype(case.gravity.dtype),
        short=jnp.zeros(width, case.gravity.dtype),
        time=jnp.zeros(width, case.gravity.dtype),
        place=jnp.broadcast_to(case.head_state[0], (width, 3)),
        position=jnp.full((width, num), num, jnp.int32),
        times=jnp.zeros((width, num), case.gravity.dtype),
    )
    _, depths = lax.scan(advance, begin, jnp.arange(num))
    depths = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), begin, depths)
    most = jnp.sum(jnp.any(jnp.isfinite(depths.rank[1:]), axis=1))
    found = jax.tree.map(lambda leaf: leaf[most], depths)
    chosen = jnp.where(jnp.isfinite(found.rank), np.arange(width), 0)
    return jax.vmap(_choice)(found.position[chosen], found.times[chosen])


def _choice(position: Array, times: Array) -> CatchChoice:
    """The choice of one order, from the position and the time of each target (N,)."""
    num = position.size
    order = jnp.argsort(position, stable=True)
    taken = position < num
    rising = jnp.where(taken, times, 0.0)[order]
    behind = jnp.maximum(jnp.arange(num) - jnp.sum(taken) + 1, 0)
    rising = lax.cummax(rising) + INSTANT * behind
    return CatchChoice(order=order.astype(jnp.int32), times=rising, taken=taken)
