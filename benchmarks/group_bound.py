"""A lower bound on the time at which a car can have met all targets of a group, in any order.

The car is relaxed to a point that moves at most as fast as the middle of a car at full acceleration
from the start. The point turns instantly and passes through obstacles. It meets a target within the
tolerance of its position. Let L(t) be the greatest distance that the point can drive up to time t.
A drive from target i, met at time t, to target j, met at time s, is possible only if
|p_j(s) - p_i(t)| <= L(s) - L(t) + 2 tolerance.

Time is divided into steps. The relaxed drive from i that starts at the beginning t_k of a step ends
in the first step that holds a time s with a possible drive. No target is faster than the point:
therefore a car that meets i in step k or later meets j in this step or later, as waiting near i is
always possible. Every real tour thus is a walk through the steps that visits all targets once and
ends at most as late as the tour.

The bound relaxes "every target once": visits of target j may be repeated or left out, and each
visit earns a price lambda_j of either sign (a Lagrangian relaxation). For any prices,

    min over walks of (end time - sum of earned prices) + sum of all prices

is a lower bound, because a walk that visits every target once earns exactly the sum of all prices.
A walk remembers some of the targets that it has visited, and does not return to them (an ng-route
[Baldacci2011]): at target j it remembers j, and those targets near j that it remembered at the
target before. No tour returns to a target, so that every tour still is such a walk. The minimum
over walks is found by dynamic programming over time steps, targets and remembered targets; the
prices are raised for targets that the best walk leaves out, and lowered for targets that it
repeats.
"""

import numba
import numpy as np

_NEVER = 1e18


@numba.njit(cache=True)
def _arrivals(places, travel, slack):  # pragma: no cover
    """Return the first step (T, N, N) of a meeting with target j after target i in each step.

    `places` (N, T + 1, 2) [m] and `travel` (T + 1,) [m] are values at the ends of T steps. A
    meeting that is possible within a step is also possible at its end, as no target is faster.
    """
    num, steps = places.shape[0], places.shape[1] - 1
    found = np.full((steps, num, num), steps, np.int32)
    for i in range(num):
        for j in range(num):
            step = 0
            for k in range(steps):
                step = max(step, k)
                while step < steps:
                    x = places[j, step + 1, 0] - places[i, k, 0]
                    y = places[j, step + 1, 1] - places[i, k, 1]
                    if np.sqrt(x * x + y * y) <= travel[step + 1] - travel[k] + slack:
                        break
                    step += 1
                found[k, i, j] = step
    return found


def _nearest(places: np.ndarray, size: int) -> np.ndarray:
    """Return the `size` targets nearest to each target at the start of each step, (T, N, size)."""
    apart = np.linalg.norm(places[:, None, :-1] - places[None, :, :-1], axis=3)  # (N, N, T)
    apart[np.arange(len(places)), np.arange(len(places))] = np.inf
    return np.ascontiguousarray(np.argsort(apart, axis=1)[:, :size].transpose(2, 0, 1))


@numba.njit(cache=True)
def _remember(known, near):  # pragma: no cover
    """Return which targets `near` (size,) are in the set `known` of targets; sets are bits."""
    memory = 0
    for bit in range(near.size):
        memory |= (known >> near[bit] & 1) << bit
    return memory


@numba.njit(cache=True)
def _best_walk(first, arrivals, near, prices, step):  # pragma: no cover
    """Return the least end time minus prices over walks, and the visits (N,) of the best walk."""
    steps, num, size = arrivals.shape[0], arrivals.shape[1], 2 ** near.shape[2]
    values = np.full((steps, num, size), _NEVER)
    origins = np.full((steps, num, size), -1, np.int64)
    for j in range(num):
        if first[j] < steps:
            values[first[j], j, 0] = -prices[j]
    least, end = _NEVER, np.int64(-1)
    visits = np.zeros(num)
    for k in range(steps):
        # Drives that end in the step in which they start improve labels of this step again. No tour
        # has more than N of them.
        is_open, passes = True, 0
        done = np.full((num, size), _NEVER)
        while is_open and passes < num:
            is_open, passes = False, passes + 1
            for i in range(num):
                for m in range(size):
                    value = values[k, i, m]
                    if value >= done[i, m]:
                        continue
                    done[i, m] = value
                    known, is_useful = np.int64(1) << i, True
                    for bit in range(near.shape[2]):
                        if m >> bit & 1:
                            known |= np.int64(1) << near[k, i, bit]
                            # A walk that remembers less and costs less may do all that this does.
                            is_useful &= values[k, i, m ^ (1 << bit)] > value
                    if not is_useful:
                        continue
                    origin = (np.int64(k) * num + i) * size + m
                    for j in range(num):
                        there = arrivals[k, i, j]
                        if there >= steps or known >> j & 1:
                            continue
                        memory = _remember(known, near[there, j])
                        new = value - prices[j]
                        if new < values[there, j, memory] - 1e-9:
                            values[there, j, memory] = new
                            origins[there, j, memory] = origin
                            is_open |= there == k
        for i in range(num):
            for m in range(size):
                value = values[k, i, m]
                if value >= _NEVER:
                    continue
                if k * step + value < least:
                    least, end = k * step + value, (np.int64(k) * num + i) * size + m
                if k + 1 < steps:  # the walk may wait
                    known = np.int64(0)
                    for bit in range(near.shape[2]):
                        if m >> bit & 1:
                            known |= np.int64(1) << near[k, i, bit]
                    memory = _remember(known, near[k + 1, i])
                    if value < values[k + 1, i, memory]:
                        values[k + 1, i, memory] = value
                        origins[k + 1, i, memory] = origins[k, i, m]
    for _ in range(4 * num):  # the walk only guides the prices, so that it may be cut
        if end < 0:
            break
        k, i, m = end // size // num, end // size % num, end % size
        visits[i] += 1
        end = origins[k, i, m]
    return least, visits


def bound_end_time(
    places: np.ndarray,
    travel: np.ndarray,
    start: np.ndarray,
    tolerance: float,
    step: float,
    rounds: int = 80,
    near: int = 6,
) -> float:
    """Return a lower bound [s] on the time when a car has met N targets.

    The bound is at most the end of the last step, because later walks are not evaluated. It is best
    if the T steps end between the true bound and the end of a known plan.

    Args:
        places: (N, T + 1, 2) [m], positions of the targets at the ends of T time steps.
        travel: (T + 1,) [m], greatest distance that the middle of the car can drive until then.
        start: (2,) [m], middle of the car at time 0.
        tolerance: [m], of a meeting.
        step: [s], duration of a time step.
        rounds: number of changes of the prices.
        near: number of targets near a target that a walk can remember there.

    Raises:
        ValueError: a target is faster than the car, for which the bound is not proved; or there are
            more than 62 targets, whose sets would not fit into 64 bits.
    """
    if len(places) > 62:
        raise ValueError("more than 62 targets")
    moved = np.linalg.norm(np.diff(places, axis=1), axis=2).max(axis=0)
    if (moved > np.diff(travel) + 1e-9).any():
        raise ValueError("a target is faster than the car")
    arrivals = _arrivals(places, travel, 2.0 * tolerance)
    far = np.linalg.norm(places[:, 1:] - start, axis=2) - tolerance
    meets = far <= travel[1:]
    first = np.where(meets.any(axis=1), meets.argmax(axis=1), len(travel) - 1)
    nearest = _nearest(places, min(near, len(places) - 1))
    horizon = step * arrivals.shape[0]
    prices, best = np.full(len(places), 0.8 * horizon / len(places)), 0.0
    for size in np.geomspace(1.0, 0.02, rounds):
        least, visits = _best_walk(first, arrivals, nearest, prices, step)
        value, lack = least + prices.sum(), 1.0 - visits
        best = max(best, value)
        if not lack.any():
            break
        prices = prices + size * max(horizon - value, 0.01 * horizon) / (lack @ lack) * lack
    return min(best, horizon)
