"""The excess of a quadrotor over the extra limits of a case, in float64.

The referee calls the method `excess` of the case's own extras at points on the polynomial. This is
the one piece of code that referee and planners share.
"""

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np

from planner_jax.referee.judging import derivative
from planner_jax.referee.quadrotor import Pieces


@runtime_checkable
class ExtraLimit(Protocol):
    """A limit of a case; other extras are terms of the planner's cost."""

    def excess(self, pos: np.ndarray, vel: np.ndarray, acc: np.ndarray) -> np.ndarray:
        """Return the relative excess (...) at points (..., 3) [m], [m/s], [m/s^2]."""
        ...


# Intervals between samples in which the excess is searched, and how many times each of them is cut
# to a quarter.
_LOOKED_INTO, _CLOSER = 6, 4
# A rise from one sample to the next that no excess has.
_STEEP = 1e9


def worst_extras(pieces: Pieces, lanes: np.ndarray, extras: tuple, u: np.ndarray) -> tuple:
    """Return greatest relative excess (B,) over extra limits, its time, and which extra it is of.

    Extras are those of all cases, of which these are `lanes`. The excess is looked for at the
    samples u (S,) of every piece, and where lines through two of them on either side say that it
    may be greatest, it is searched in between. It is -1 without a limit.
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
    """Return greatest excess over one extra of one lane, and its time [s]."""

    def excess(coeffs: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return the excess at times (...) since the start of pieces (D + 1, 3, ...)."""
        state = (derivative(coeffs, times, order) for order in range(3))
        flown = [np.moveaxis(each, 0, -1).reshape(-1, 3) for each in state]
        return np.asarray(extra.excess(*flown), float).reshape(times.shape)

    coeffs = pieces.coeffs[:, 0].transpose(2, 0, 1)  # (D + 1, 3, M)
    durations, starts = pieces.durations[0], pieces.starts[0]
    values = excess(coeffs[..., None], durations[:, None] * u)  # (M, S)
    piece, sample = np.unravel_index(values.argmax(), values.shape)
    worst, time = values[piece, sample], starts[piece] + durations[piece] * u[sample]
    # Where it is concave it is below the line through the two samples before an interval, and
    # below that through the two behind it. A piece's first interval has none before it, its last
    # one none behind.
    rise = np.diff(values, axis=1)
    before = np.pad(rise[:, :-1], ((0, 0), (1, 0)), constant_values=_STEEP)
    after = np.pad(rise[:, 1:], ((0, 0), (0, 1)), constant_values=-_STEEP)
    bend = before - after
    share = np.clip((rise - after) / np.where(bend > 0.0, bend, np.inf), 0.0, 1.0)
    hoped = np.maximum(values[:, :-1] + share * before, values[:, 1:])
    likeliest = np.argsort(hoped, axis=None)[-_LOOKED_INTO:]
    piece, sample = np.unravel_index(likeliest, hoped.shape)
    low, high = durations[piece] * u[sample], durations[piece] * u[sample + 1]
    for _ in range(_CLOSER):
        times = low + (high - low) * np.linspace(0.0, 1.0, 9)[:, None]
        found = excess(coeffs[:, :, None, piece], times)
        best, each = found.argmax(axis=0), np.arange(len(piece))
        low, high = (times[np.clip(best + k, 0, 8), each] for k in (-1, 1))
        top = found.max(axis=0).argmax()
        if found[best[top], top] > worst:
            worst, time = found[best[top], top], starts[piece[top]] + times[best[top], top]
    return float(worst), float(time)


def _of_lane(extra, lane: int) -> ExtraLimit:
    """Return an extra with the arrays of one lane in float64."""
    numbers = [f.name for f in dataclasses.fields(extra) if f.metadata.get("pytree_node", True)]
    own = {name: np.asarray(vars(extra)[name], float)[lane] for name in numbers}
    return dataclasses.replace(extra, **own)
