"""Paths of an arm among obstacles by RRT-Connect [Kuffner2000], as one compiled program.

Two trees of joint states grow, one from the start and one from the goals. In turn a tree grows
towards a random state until it reaches the state or an obstacle, and the other tree then grows
towards the new state, until both meet.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

RESOLUTION = 0.035  # [m], distance between states of a path that are checked
_CHUNK = 16  # number of states that are checked together
_SLOTS = 128  # number of points of a path


class _Trees(NamedTuple):
    nodes: Array  # (2, N, n) [rad], joint states
    parents: Array  # (2, N) int32, index of each state's predecessor; of a root itself
    counts: Array  # (2,) int32, number of states
    side: Array  # () int32, tree that grows towards random states
    last: Array  # () int32, state of that tree which the other tree should reach, or -1
    ends: Array  # (2,) int32, states of the trees that are joined
    is_joined: Array  # () bool
    key: Array
    rays: Array  # () int32, number of attempts to grow a tree


def advance(
    is_free: Callable[[Array], Array], start: Array, goal: Array
) -> tuple[Array, Array, Array]:
    """Move straight from one joint state (n,) [rad] towards another, until a state is not free.

    Returns:
        end: (n,) [rad], the last free state.
        is_goal: () bool, whether the end is the goal.
        moved: () [rad], the distance from start to end.
    """
    line = goal - start
    length = jnp.sqrt(jnp.sum(line**2))
    count = jnp.maximum(jnp.ceil(length / RESOLUTION), 1.0)

    def check(state: tuple[Array, Array]) -> tuple[Array, Array]:
        done, _ = state
        index = jnp.minimum(done + 1.0 + jnp.arange(_CHUNK, dtype=done.dtype), count)
        free = is_free(start[None] + (index / count)[:, None] * line[None])
        passed = jnp.sum(jnp.cumprod(free.astype(done.dtype)))
        return jnp.minimum(done + passed, count), passed == _CHUNK

    def is_open(state: tuple[Array, Array]) -> Array:
        return state[1] & (state[0] < count)

    done, _ = lax.while_loop(is_open, check, (jnp.zeros_like(count), jnp.ones((), bool)))
    end = jnp.where(done >= count, goal, start + done / count * line)
    return end, done >= count, done / count * length


def find_path(
    is_free: Callable[[Array], Array],
    start: Array,
    goals: Array,
    bounds: tuple[Array, Array],
    rays: Array | int,
    seed: Array | int,
    capacity: int,
) -> tuple[Array, Array, Array]:
    """Return a free path (128, n) [rad] from the start to one of the goals, if trees meet.

    Args:
        is_free: function that returns which of N joint states (N, n) are free, (N,) bool.
        start: (n,) [rad].
        goals: (G, n) [rad], free states.
        bounds: least and greatest joint angles, each (n,) [rad].
        rays: () greatest number of attempts to grow a tree.
        seed: () of the random states.
        capacity: greatest number of states of a tree.

    Returns:
        The path, whether it was found (bool), and the number of attempts.
    """
    num = goals.shape[0]
    empty = jnp.zeros((2, capacity, start.shape[0]), start.dtype)
    trees = _Trees(
        nodes=empty.at[0, 0].set(start).at[1, :num].set(goals),
        parents=jnp.broadcast_to(jnp.arange(capacity, dtype=jnp.int32), (2, capacity)),
        counts=jnp.array([1, num], jnp.int32),
        side=jnp.zeros((), jnp.int32),
        last=jnp.full((), -1, jnp.int32),
        ends=jnp.zeros(2, jnp.int32),
        is_joined=jnp.zeros((), bool),
        key=jax.random.key(seed),
        rays=jnp.zeros((), jnp.int32),
    )

    def grow(trees: _Trees) -> _Trees:
        key, own = jax.random.split(trees.key)
        joins = trees.last >= 0
        side = jnp.where(joins, 1 - trees.side, trees.side)
        random = jax.random.uniform(own, start.shape, start.dtype, *bounds)
        target = jnp.where(joins, trees.nodes[trees.side, trees.last], random)
        nodes, count = trees.nodes[side], trees.counts[side]
        away = jnp.sum((nodes - target[None]) ** 2, axis=1)
        nearest = jnp.argmin(jnp.where(jnp.arange(capacity) < count, away, jnp.inf)).astype(
            jnp.int32
        )
        end, is_target, moved = advance(is_free, nodes[nearest], target)
        is_new = moved > 0.5 * RESOLUTION
        index = jnp.where(is_new, count, nearest)
        is_joined = joins & is_target
        ends = jnp.stack(
            [
                jnp.where(trees.side == 0, trees.last, index),
                jnp.where(trees.side == 0, index, trees.last),
            ]
        )
        swaps = joins | ~is_new
        return _Trees(
            nodes=trees.nodes.at[side, index].set(jnp.where(is_new, end, nodes[index])),
            parents=trees.parents.at[side, index].set(
                jnp.where(is_new, nearest, trees.parents[side, index])
            ),
            counts=trees.counts.at[side].add(is_new.astype(jnp.int32)),
            side=jnp.where(swaps, 1 - trees.side, trees.side),
            last=jnp.where(swaps, -1, index),
            ends=jnp.where(is_joined, ends, trees.ends),
            is_joined=is_joined,
            key=key,
            rays=trees.rays + 1,
        )

    def is_open(trees: _Trees) -> Array:
        fits = jnp.max(trees.counts) < capacity - 1
        return ~trees.is_joined & (trees.rays < rays) & fits

    trees = lax.while_loop(is_open, grow, trees)

    def walk(side: int) -> tuple[Array, Array]:
        def back(index: Array, _: None) -> tuple[Array, Array]:
            return trees.parents[side, index], index

        root, chain = lax.scan(back, trees.ends[side], None, length=_SLOTS // 2)
        return trees.nodes[side, chain], trees.parents[side, root] == root

    (to_start, is_short), (to_goal, is_short_too) = walk(0), walk(1)
    points = jnp.concatenate([to_start[::-1], to_goal])
    return points, trees.is_joined & is_short & is_short_too, trees.rays


def shorten(
    is_free: Callable[[Array], Array], points: Array, attempts: int, seed: Array | int
) -> Array:
    """Shorten a free path (N, n) [rad] by straight lines between random points of the path.

    Each point of the result lies at a corner of the path or on a straight line between corners.
    """
    num = points.shape[0]
    # Give each corner the same number of points, since a shorter path may have more corners.
    moves = jnp.any(jnp.diff(points, axis=0) != 0.0, axis=1)
    corner = jnp.append(0, jnp.cumsum(moves, dtype=jnp.int32))
    of_slot = jnp.arange(num, dtype=jnp.int32) * (corner[-1] + 1) // num
    points = points[jnp.searchsorted(corner, of_slot)]
    position = jnp.arange(num)

    def cut(k: Array, points: Array) -> Array:
        lengths = jnp.sqrt(jnp.sum(jnp.diff(points, axis=0) ** 2, axis=1))
        passed = jnp.append(0.0, jnp.cumsum(lengths))
        own = jax.random.fold_in(jax.random.key(seed), k)
        first, second = jnp.sort(jax.random.uniform(own, (2,), points.dtype)) * passed[-1]

        def locate(along: Array) -> tuple[Array, Array]:
            edge = jnp.clip(jnp.searchsorted(passed, along, side="right") - 1, 0, num - 2)
            share = jnp.clip((along - passed[edge]) / jnp.maximum(lengths[edge], 1e-9), 0.0, 1.0)
            return edge, points[edge] + share * (points[edge + 1] - points[edge])

        (begin, a), (until, b) = locate(first), locate(second)
        has_slots = until - begin >= 2
        _, is_clear, _ = advance(is_free, a, jnp.where(has_slots, b, a))
        inside = (position > begin) & (position <= until) & is_clear & has_slots
        middle = (begin + until + 1) // 2
        return jnp.where(
            inside[:, None], jnp.where((position <= middle)[:, None], a[None], b[None]), points
        )

    return lax.fori_loop(0, attempts, cut, points)
