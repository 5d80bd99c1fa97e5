"""Test of a quadrotor's trajectory against the extra limits of its case, in float64 NumPy.

Extra limits are objects in the case's field `extras`, which a user may define. Their method
`excess` is the only code that the referee shares with the planners.
"""

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np

from planner_jax.referee.judging import derivative
from planner_jax.referee.quadrotor import Pieces


@runtime_checkable
class ExtraLimit(Protocol):
    """A limit that a user adds to a planning problem, in its field `extras`."""

    def excess(self, pos: np.ndarray, vel: np.ndarray, acc: np.ndarray) -> np.ndarray:
        """Return the relative excess over the limit, positive where the limit is exceeded.

        Position [m], velocity [m/s] and acceleration [m/s^2] are (..., 3), the result is (...).
        """
        ...


# Number of intervals between samples that are searched more finely, and number of their
# refinements. Each refinement reduces an interval to a quarter of its length.
_REFINED, _REFINEMENTS = 6, 4
# The excess in an interval is bounded by two lines, through the two samples before the interval and
# through the two samples after it. A piece's first and last intervals lack one of these lines. A
# line of this slope replaces it. It is so steep that only the other line bounds the excess.
_STEEP = 1e9


def worst_extras(pieces: Pieces, lanes: np.ndarray, extras: tuple, u: np.ndarray) -> tuple:
    """Find each plan's greatest relative excess over the user's limits, its time and its limit.

    The excess is sampled at fractions u of every piece. The intervals between samples that most
    likely contain a greater excess are sampled more finely. All results are (B,); the limit is an
    index in `extras`. Without an extra limit the index and the excess are -1.

    Args:
        pieces: trajectories of B plans.
        lanes: (B,), indices of the plans' cases in the arrays of `extras`.
        extras: the user's limits and terms of the cost (ignored here), for all cases of the batch.
        u: (S,), sampled fractions of a piece's duration, from 0 to 1.
    """
    limits = [k for k, extra in enumerate(extras) if isinstance(extra, ExtraLimit)]
    worst, time, which = np.full(len(lanes), -1.0), np.zeros(len(lanes)), np.full(len(lanes), -1)
    for i, lane in enumerate(lanes.astype(int) if limits else ()):
        here = pieces.of(slice(i, i + 1))
        for k in limits:
            found, at = _worst_excess(here, _of_lane(extras[k], lane), u)
            if which[i] < 0 or found > worst[i] or np.isnan(found):
                worst[i], time[i], which[i] = found, at, k
    return worst, time, which


def _worst_excess(pieces: Pieces, extra: ExtraLimit, u: np.ndarray) -> tuple[float, float]:

    def excess(coeffs: np.ndarray, times: np.ndarray) -> np.ndarray:
        state = (derivative(coeffs, times, order) for order in range(3))
        rows = [np.moveaxis(each, 0, -1).reshape(-1, 3) for each in state]
        return np.asarray(extra.excess(*rows), float).reshape(times.shape)

    coeffs = pieces.coeffs[:, 0].transpose(2, 0, 1)  # (D + 1, 3, M)
    durations, starts = pieces.durations[0], pieces.starts[0]
    values = excess(coeffs[..., None], durations[:, None] * u)  # (M, S)
    piece, sample = np.unravel_index(values.argmax(), values.shape)
    worst, time = values[piece, sample], starts[piece] + durations[piece] * u[sample]
    # Inside an interval a concave excess lies below two lines: through the two samples before it
    # and through the two samples after it. Their intersection bounds the excess.
    rise = np.diff(values, axis=1)
    before = np.pad(rise[:, :-1], ((0, 0), (1, 0)), constant_values=_STEEP)
    after = np.pad(rise[:, 1:], ((0, 0), (0, 1)), constant_values=-_STEEP)
    bend = before - after
    share = np.clip((rise - after) / np.where(bend > 0.0, bend, np.inf), 0.0, 1.0)
    bound = np.maximum(values[:, :-1] + share * before, values[:, 1:])
    piece, sample = np.unravel_index(np.argsort(bound, axis=None)[-_REFINED:], bound.shape)
    low, high = durations[piece] * u[sample], durations[piece] * u[sample + 1]
    for _ in range(_REFINEMENTS):
        times = low + (high - low) * np.linspace(0.0, 1.0, 9)[:, None]
        found = excess(coeffs[:, :, None, piece], times)
        best, each = found.argmax(axis=0), np.arange(len(piece))
        low, high = (times[np.clip(best + k, 0, 8), each] for k in (-1, 1))
        top = found.max(axis=0).argmax()
        if found[best[top], top] > worst:
            worst, time = found[best[top], top], starts[piece[top]] + times[best[top], top]
    return float(worst), float(time)


def _of_lane(extra, lane: int) -> ExtraLimit:
    numbers = [f.name for f in dataclasses.fields(extra) if f.metadata.get("pytree_node", True)]
    own = {name: np.asarray(vars(extra)[name], float)[lane] for name in numbers}
    return dataclasses.replace(extra, **own)
