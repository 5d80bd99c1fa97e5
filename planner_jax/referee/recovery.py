"""The tilt of quadrotors, and the recovery trajectories behind their plans, for the referee."""

import math

import numpy as np

from planner_jax.referee import quadrotor
from planner_jax.referee.judging import above, derivative
from planner_jax.referee.quadrotor import SHORTEST_PIECE, Pieces, motion_of

# [rad], at least this much more than the tilt at its start is allowed to a recovery
MORE_TILT = math.radians(10.0)
RECOVERY_TILT = math.radians(40.0)  # [rad], greatest tilt of recoveries if their case states none


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
    if "recovery.coeffs" not in case:
        return {}
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


def _tilt(gravity, acc: np.ndarray) -> np.ndarray:
    """Return sin^2(theta / 2) for the angle theta between thrust and vertical; 1 without thrust."""
    up, squared = acc[2] + gravity, quadrotor.thrust_squared(gravity, acc)
    cosine = np.where(squared > 0.0, up / np.sqrt(squared), -1.0)
    return np.maximum(0.5 - 0.5 * cosine, 0.0)


def judge_tilt(case: dict, pieces: Pieces, u: np.ndarray, relative: float) -> tuple:
    """Measure the greatest tilt [rad] of the parts of B flights that have a limit, and test it."""
    tilt, gravity, tests = np.full(len(case["gravity"]), np.nan), case["gravity"], []
    parts = [(pieces, case["limits.max_tilt"])] if "limits.max_tilt" in case else []
    if "recovery.coeffs" in case:
        num = case["recovery.durations"].shape[1]
        rest = pieces.of(slice(None), slice(-num, None))
        start = derivative(np.moveaxis(rest.coeffs[:, :, 0], -1, 0), np.zeros(tilt.shape), 2)
        usual = case.get("limits.recovery_tilt", RECOVERY_TILT)
        start_tilt = 2.0 * np.arcsin(_tilt(gravity, start) ** 0.5)
        parts.append((rest, np.maximum(usual, start_tilt + MORE_TILT)))
    for part, limit in parts:
        top, greatest, likeliest = quadrotor.find_tops(
            _tilt(gravity[:, None, None], motion_of(part, u)[2])
        )
        found = quadrotor.search_peak(((2,), _tilt), part, gravity, likeliest, u)
        sine, at = quadrotor.select_greater(found, (greatest, quadrotor.time_of(part, top, u)))
        sine = np.sqrt(np.minimum(sine, 1.0))
        tilt = np.fmax(tilt, 2.0 * np.arcsin(sine))
        tests.append(above(sine, np.sin(0.5 * np.minimum(limit, math.pi)), relative, at))
    failed, excess, at = (np.array(each) for each in zip(*tests, strict=True))
    worst, lanes = excess.argmax(axis=0), np.arange(len(tilt))
    return tilt, {"tilt": (failed.any(axis=0), excess[worst, lanes], at[worst, lanes])}
