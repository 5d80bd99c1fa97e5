"""Piecewise polynomials of quadrotors, as the referee samples them."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Pieces:
    """Polynomial pieces in float64; one that is not flown repeats the last one that is.

    A repeated piece changes no greatest and no least value.
    """

    coeffs: np.ndarray  # (3, B, M, D + 1)
    durations: np.ndarray  # (B, M) [s]
    starts: np.ndarray  # (B, M) [s]
    flown: np.ndarray  # (B, M) bool

    def of(self, lanes: slice) -> "Pieces":
        """Return the pieces of some lanes."""
        rest = (part[lanes] for part in (self.durations, self.starts, self.flown))
        return Pieces(self.coeffs[:, lanes], *rest)


def pieces_of(coeffs: np.ndarray, durations: np.ndarray, flown: np.ndarray | None = None) -> Pieces:
    """Return the pieces of a batch of trajectories.

    Args:
        coeffs: (B, M, D + 1, 3), rising powers of the time [s] since the piece's start.
        durations: (B, M) [s].
        flown: (B, M) bool, which pieces are part of the trajectory; all of them if not given.
            The others must have no duration.
    """
    coeffs = np.moveaxis(coeffs, -1, 0)
    starts = np.cumsum(durations, axis=1) - durations
    if flown is None:
        flown = np.ones(durations.shape, bool)
    else:
        number = np.arange(durations.shape[1])
        last = np.maximum.accumulate(np.where(flown, number, 0), axis=1)
        lanes = np.arange(len(durations))[:, None]
        coeffs = coeffs[:, lanes, last]
        durations, starts = durations[lanes, last], starts[lanes, last]
    return Pieces(np.ascontiguousarray(coeffs), durations, starts, flown)


def with_ending(pieces: Pieces, case: dict) -> Pieces:
    """Return the pieces of trajectories and of their endings, if there are any."""
    if "ending.coeffs" not in case:
        return pieces
    durations = case["ending.durations"]
    size = max(pieces.coeffs.shape[-1], case["ending.coeffs"].shape[2])

    def wide(coeffs: np.ndarray) -> np.ndarray:
        return np.pad(coeffs, [(0, 0)] * 3 + [(0, size - coeffs.shape[-1])])

    begin = np.where(pieces.flown, pieces.starts + pieces.durations, 0.0).max(axis=1)
    starts = begin[:, None] + durations.cumsum(axis=1) - durations
    return Pieces(
        np.concatenate(
            [wide(pieces.coeffs), wide(np.moveaxis(case["ending.coeffs"], -1, 0))], axis=2
        ),
        np.concatenate([pieces.durations, durations], axis=1),
        np.concatenate([pieces.starts, starts], axis=1),
        np.concatenate([pieces.flown, np.ones(durations.shape, bool)], axis=1),
    )
