"""Shorten the time of a motion by random shortcuts [Hauser2010].

A shortcut joins the states (joint angles and rates) of a motion at two random times by the fastest
motion without obstacles. In a shortcut, each joint has at most three phases: a constant
acceleration, a constant rate, and the opposite acceleration.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax

from planner_jax.robot.arm import ArmLimits
from planner_jax.task.reach.motion import join_knots
from planner_jax.trajectory.polynomial import PiecewisePolynomial

_SHORTEST = 2e-4  # fraction of a motion's duration that a piece lasts at least
_GAIN = 1e-3  # fraction of the motion's duration that a shortcut saves at least
_PATIENCE = 60  # number of shortcuts in a row that save no time, after which the search ends


def join(turn: Array, before: Array, after: Array, limits: ArmLimits) -> tuple[Array, Array, Array]:
    """Return the fastest motion between two states with rates, and whether it keeps the limits.

    The slowest joint determines the duration T. The other joints have the least acceleration for
    this duration.

    Args:
        turn: (n,) [rad], change of the joint angles.
        before: (n,) [rad/s], joint rates at the start.
        after: (n,) [rad/s], joint rates at the end.
        limits: greatest rates and accelerations.

    Returns:
        durations: (2 n + 1,) [s], of the pieces.
        rates: (2 n + 2, n) [rad/s], at the ends of the pieces.
        is_within: () bool; a joint may be unable to move as slowly as the slowest joint.
    """
    most, speed = limits.acceleration, limits.velocity
    change, squares = after - before, 0.5 * (before**2 + after**2)
    # The least time of each joint: the rate rises to a peak, or falls to one, at full acceleration.
    direct = 0.5 * (before + after) * jnp.abs(change) / most
    side = jnp.where(turn >= direct, 1.0, -1.0)
    peak = jnp.sqrt(jnp.maximum(squares + side * most * turn, 1e-12))
    top = jnp.minimum(peak, speed)
    total = (2.0 * top - side * (before + after)) / most
    total += (peak**2 - top**2) / (most * top)
    total = jnp.maximum(jnp.max(total), 1e-6)
    # The least acceleration for the duration T solves s^2 T^2 - 2 b s - change^2 = 0.
    b = 2.0 * turn - total * (before + after)
    root = jnp.sqrt(jnp.maximum(b**2 + (change * total) ** 2, 1e-14))
    side = jnp.where(b >= 0.0, 1.0, -1.0)
    rise = (jnp.abs(b) + root) / total**2
    first = jnp.clip(0.5 * (total + side * change / rise), 0.0, total)
    second = total - first
    peak = side * before + rise * first
    # A joint that would exceed its greatest rate keeps this rate for a while.
    low, high = speed - side * before, speed - side * after
    spare = jnp.maximum(speed * total - side * turn, 1e-9)
    steeper = 0.5 * (low**2 + high**2) / spare
    is_fast = peak > speed
    rise = jnp.where(is_fast, jnp.maximum(steeper, 1e-9), rise)
    first, second = (
        jnp.where(is_fast, a, b) for a, b in ((low / rise, first), (high / rise, second))
    )
    top = jnp.where(is_fast, speed, peak)
    is_within = (rise <= most * (1.0 + 1e-4)) & (first + second <= total * (1.0 + 1e-5))
    is_within &= jnp.maximum(jnp.abs(before), jnp.abs(after)) <= speed * (1.0 + 1e-4)
    is_within &= jnp.where(is_fast, speed * total > side * turn, True)
    ends = jnp.stack([jnp.zeros_like(total), total])
    times = jnp.sort(jnp.concatenate([ends, first, total - second]))[:, None]
    up = (side * before)[None] + rise[None] * jnp.minimum(times, first[None])
    down = (side * after)[None] + rise[None] * jnp.minimum(total - times, second[None])
    rates = jnp.where(times > total - second[None], down, top[None])
    rates = side[None] * jnp.where(times < first[None], up, rates)
    return jnp.diff(times[:, 0]), rates.at[0].set(before).at[-1].set(after), jnp.all(is_within)


def locate(
    start: Array, durations: Array, rates: Array, time: Array
) -> tuple[Array, Array, Array, Array]:
    """Return a motion's angles (n,) and rates (n,) at a time, its piece, and the time in it."""
    ends = jnp.cumsum(durations)
    piece = jnp.minimum(jnp.sum(ends <= time, dtype=jnp.int32), durations.shape[0] - 1)
    turned = 0.5 * durations[:, None] * (rates[1:] + rates[:-1])
    length = jnp.maximum(durations[piece], 1e-9)
    local = jnp.clip(time - (ends[piece] - durations[piece]), 0.0, length)
    before = jnp.where((jnp.arange(durations.shape[0]) < piece)[:, None], turned, 0.0)
    rate = rates[piece] + (local / length) * (rates[piece + 1] - rates[piece])
    angles = start + jnp.sum(before, axis=0) + 0.5 * local * (rates[piece] + rate)
    return angles, rate, piece, local


def hasten(
    is_free: Callable[[PiecewisePolynomial], Array],
    start: Array,
    knots: tuple[Array, Array],
    limits: ArmLimits,
    attempts: Array | int,
    seed: Array | int,
) -> tuple[Array, Array]:
    """Return a faster motion from the same start to the same end, after a number of shortcuts.

    Args:
        is_free: function that returns whether no state of a motion is in a collision.
        start: (n,) [rad].
        knots: durations (M,) [s] of the pieces, where pieces without duration are last, and rates
            (M + 1, n) [rad/s] at the ends of the pieces.
        limits: greatest rates and accelerations.
        attempts: number of shortcuts that are tried.
        seed: of the random times.
    """
    slots = knots[1].shape[0]
    knot = jnp.arange(slots, dtype=jnp.int32)

    def cut(state: tuple[Array, Array, tuple[Array, Array]]) -> tuple:
        k, failures, (durations, rates) = state
        total = jnp.sum(durations)
        own = jax.random.fold_in(jax.random.key(seed), k)
        begin, until = jnp.sort(jax.random.uniform(own, (2,), durations.dtype)) * total
        angles, before, first, local = locate(start, durations, rates, begin)
        goal, after, last, passed = locate(start, durations, rates, until)
        times, fast, is_within = join(goal - angles, before, after, limits)
        since = jnp.append(0.0, durations)  # time since the previous knot
        kept = [knot <= first, jnp.append(True, times > 0.0), knot > last]
        gaps = [
            since,
            jnp.append(local, times),
            jnp.where(knot == last + 1, jnp.maximum(durations[last] - passed, 0.0), since),
        ]
        kept[2] &= gaps[2] > 0.0
        kept, gaps = jnp.concatenate(kept), jnp.concatenate(gaps)
        count = jnp.sum(kept, dtype=jnp.int32)
        is_short = is_within & (jnp.sum(times) < until - begin - _GAIN * total)
        is_good = lax.cond(
            is_short & (count <= slots),
            lambda: is_free(join_knots(angles, times, fast)),
            lambda: jnp.zeros((), bool),
        )
        at = jnp.where(kept, jnp.cumsum(kept, dtype=jnp.int32) - 1, slots)
        gaps = jnp.zeros_like(since).at[at].set(gaps, mode="drop")
        every = jnp.concatenate([rates, fast, rates])
        every = jnp.zeros_like(rates).at[at].set(every, mode="drop")
        knots = jnp.where(is_good, gaps[1:], durations), jnp.where(is_good, every, rates)
        return k + 1, jnp.where(is_good, 0, failures + 1), knots

    def is_open(state: tuple[Array, Array, tuple[Array, Array]]) -> Array:
        return (state[0] < attempts) & (state[1] < _PATIENCE)

    none = jnp.zeros((), jnp.int32)
    return drop_knots(*lax.while_loop(is_open, cut, (none, none, knots))[2])


def drop_knots(durations: Array, rates: Array) -> tuple[Array, Array]:
    """Leave out knots that follow the previous knot almost at once.

    The mean acceleration of merged pieces is within the limits that their accelerations keep. A
    piece that is too short would have a wrong acceleration, since its rates are rounded.
    """
    times = jnp.cumsum(durations)
    least = _SHORTEST * times[-1]

    def decide(elapsed: Array, piece: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        duration, left = piece
        elapsed = elapsed + duration
        keeps = (elapsed >= least) & (left >= least)
        return jnp.where(keeps, 0.0, elapsed), (keeps, elapsed)

    _, (keeps, gaps) = lax.scan(decide, times[0] * 0.0, (durations, times[-1] - times))
    # The last kept knot is followed by the end of the motion.
    count = jnp.sum(keeps, dtype=jnp.int32)
    at = jnp.where(keeps, jnp.cumsum(keeps, dtype=jnp.int32) - 1, durations.shape[0])
    merged = jnp.zeros_like(durations).at[at].set(gaps, mode="drop")
    merged = merged.at[count].set(times[-1] - jnp.sum(merged))
    return merged, jnp.zeros_like(rates).at[at + 1].set(rates[1:], mode="drop")
