"""The recovery trajectories behind quadrotors' plans, for the referee."""

import math

import numpy as np

from planner_jax.referee.judging import derivative
from planner_jax.referee.quadrotor import SHORTEST_PIECE, Pieces


def append_recovery(pieces: Pieces, case: dict) -> Pieces:
    """Append the recovery trajectories to standstill behind the pieces."""
    durations = case["recovery.durations"]
    size = max(pieces.coeffs.shape[-1], case["recovery.coeffs"].shape[2])

    def wide(coeffs: np.ndarray) -> np.ndarray:
        return np.pad(coeffs, [(0, 0)] * 3 + [(0, size - coeffs.shape[-1])])

    begin = np.where(pieces.flown, pieces.starts + pieces.durations, 0.0).max(axis=1)
    starts = begin[:, None] + durations.cumsum(axis=1) - durations
    return Pieces(
        np.concatenate(
            [wide(pieces.coeffs), wide(np.moveaxis(case["recovery.coeffs"], -1, 0))], axis=2
        ),
        np.concatenate([pieces.durations, durations], axis=1),
        np.concatenate([pieces.starts, starts], axis=1),
        np.concatenate([pieces.flown, np.ones(durations.shape, bool)], axis=1),
    )


def judge_rest(case: dict, pieces: Pieces, continuity: float) -> dict:
    """Return the test whether recovery trajectories end at standstill, by name."""
    durations = case["recovery.durations"]
    last = np.moveaxis(case["recovery.coeffs"][:, -1], 0, -1)
    period = np.maximum(durations.mean(axis=1), SHORTEST_PIECE)
    moved = np.stack(
        [
            np.linalg.norm(derivative(last, durations[:, -1], order), axis=0)
            * (period**order / math.factorial(order))
            for order in (1, 2, 3)
        ]
    ).max(axis=0)
    scale = np.maximum(np.abs(pieces.coeffs[..., 0]).max(axis=(0, 2)), 1.0)
    failed = ~(moved <= continuity * scale) | (durations <= 0.0).any(axis=1)
    return {"recovery": (failed, moved, pieces.starts[:, -1] + pieces.durations[:, -1])}
