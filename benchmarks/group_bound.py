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
Walks that return to a target directly after one other target are left out, as no tour is such a
walk. The minimum over walks is found by dynamic programming; the prices are
raised for targets that the best walk leaves out, and lowered for targets that it repeats.
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


@numba.njit(cache=True)
def _insert(value, before, origin, k, j, values, befores, origins):  # pragma: no cover
    """Store a label if it is one of the two best with different targets before; say if it is."""
    if value >= values[k, j, 0] - 1e-9:
        if before == befores[k, j, 0] or value >= values[k, j, 1] - 1e-9:
            return False
        slot = 1
    else:
        if before != befores[k, j, 0]:
            values[k, j, 1] = values[k, j, 0]
            befores[k, j, 1] = befores[k, j, 0]
            origins[k, j, 1] = origins[k, j, 0]
        slot = 0
    values[k, j, slot], befores[k, j, slot], origins[k, j, slot] = value, before, origin
    return True


@numba.njit(cache=True)
def _best_walk(first, arrivals, prices, step):  # pragma: no cover
    """Return the least end time minus prices over walks, and the visits (N,) of the best walk."""
    steps, num = arrivals.shape[0], arrivals.shape[1]
    values = np.full((steps + 1, num, 2), _NEVER)
    befores = np.full((steps + 1, num, 2), -1, np.int32)
    origins = np.full((steps + 1, num, 2), -1, np.int64)
    for j in range(num):
        if first[j] < steps:
            _insert(-prices[j], num, -1, first[j], j, values, befores, origins)
    least, end = _NEVER, -1
    visits = np.zeros(num)
    for k in range(steps):
        for i in range(num):
            for slot in range(2):
                if k > 0 and values[k - 1, i, slot] < _NEVER:
                    value, before = values[k - 1, i, slot], befores[k - 1, i, slot]
                    _insert(value, before, origins[k - 1, i, slot], k, i, values, befores, origins)
        # Drives that end in the step in which they start improve labels of this step again. No tour
        # has more than N of them.
        is_open, passes = True, 0
        while is_open and passes < num:
            is_open, passes = False, passes + 1
            for i in range(num):
                if values[k, i, 0] >= _NEVER:
                    continue
                for j in range(num):
                    there = arrivals[k, i, j]
                    if j == i or there >= steps:
                        continue
                    slot = 1 if befores[k, i, 0] == j else 0
                    value = values[k, i, slot]
                    if value < _NEVER:
                        origin = (np.int64(k) * num + i) * 2 + slot
                        value -= prices[j]
                        is_new = _insert(value, i, origin, there, j, values, befores, origins)
                        is_open |= is_new and there == k
        for i in range(num):
            if values[k, i, 0] < _NEVER and k * step + values[k, i, 0] < least:
                least, end = k * step + values[k, i, 0], (np.int64(k) * num + i) * 2
    for _ in range(4 * num):  # the walk only guides the prices, so that it may be cut
        if end < 0:
            break
        k, i, slot = end // 2 // num, end // 2 % num, end % 2
        visits[i] += 1
        end = origins[k, i, slot]
    return least, visits


def bound_end_time(
    places: np.ndarray,
    travel: np.ndarray,
    start: np.ndarray,
    tolerance: float,
    step: float,
    upper: float,
    rounds: int = 300,
) -> float:
    """Return a lower bound [s] on the time when a car has met N targets.

    Args:
        places: (N, T + 1, 2) [m], positions of the targets at the ends of T time steps.
        travel: (T + 1,) [m], greatest distance that the middle of the car can drive until then.
        start: (2,) [m], middle of the car at time 0.
        tolerance: [m], of a meeting.
        step: [s], duration of a time step.
        upper: [s], end time of a known plan, at most T steps, which scales the changes of prices.
        rounds: number of changes of the prices.

    Raises:
        ValueError: a target is faster than the car, for which the bound is not proved.
    """
    moved = np.linalg.norm(np.diff(places, axis=1), axis=2).max(axis=0)
    if (moved > np.diff(travel) + 1e-9).any():
        raise ValueError("a target is faster than the car")
    arrivals = _arrivals(places, travel, 2.0 * tolerance)
    far = np.linalg.norm(places[:, 1:] - start, axis=2) - tolerance
    meets = far <= travel[1:]
    first = np.where(meets.any(axis=1), meets.argmax(axis=1), len(travel) - 1)
    prices, best = np.full(len(places), 0.2 * upper / len(places)), 0.0
    for size in np.geomspace(1.0, 0.02, rounds):
        least, visits = _best_walk(first, arrivals, prices, step)
        value, lack = least + prices.sum(), 1.0 - visits
        best = max(best, value)
        if not lack.any():
            break
        prices = prices + size * max(upper - value, 0.01 * upper) / (lack @ lack) * lack
    return best
