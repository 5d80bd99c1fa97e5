"""How an arm comes to rest behind its contact: its joints brake evenly, all at once or each alone.

Of a few ways that keep the accelerations by construction, the first that the referee lets pass is
taken: positions and what the arm may touch are its to judge.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from planner_jax.core.errors import NoEnding
from planner_jax.referee.rest import referee_stands
from planner_jax.robot.arm_plan import ArmPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial, states_at

_SPARE = 0.98  # share of the accelerations that is used
_SLOWER = (1.5, 2.0, 3.0)  # times the shortest duration in which all stop at once


def braked_arm(case: Any, found: ArmPlan) -> ArmPlan:
    """One plan of an arm that goes on until the arm rests.

    Args:
        case: with the arm, its limits and its scene; one case.
        found: the plan.

    Raises:
        NoEnding: the referee lets none of the ways pass.
    """
    coeffs, durations = (np.asarray(leaf, np.float64) for leaf in vars(found.motion).values())
    state = states_at(found.motion, np.asarray(durations.sum()))
    why = ""
    for pieces, times in _ways(state[0], state[1], np.asarray(case.limits.acceleration, float)):
        sentence = referee_stands(case, found, _moved(found, pieces, times))
        if not sentence:
            size = max(coeffs.shape[1], 3)
            wide = [
                np.pad(each, [(0, 0), (0, size - each.shape[1]), (0, 0)])
                for each in (coeffs, pieces)
            ]
            return _moved(found, np.concatenate(wide), np.concatenate([durations, times]))
        why = why or sentence
    raise NoEnding(why)


def _ways(
    angles: np.ndarray, rates: np.ndarray, most: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Coefficients (M, 3, 6) and durations (M,) of motions to rest.

    Args:
        angles: (6,) [rad], where they begin.
        rates: (6,) [rad/s], likewise.
        most: (6,) [rad/s^2], accelerations.
    """
    alone = np.maximum(np.abs(rates) / (_SPARE * most), 1e-3)
    together = np.full(6, alone.max())
    yield _braking(angles, rates, together)
    yield _braking(angles, rates, alone)
    for factor in _SLOWER:
        yield _braking(angles, rates, factor * together)


def _braking(
    angles: np.ndarray, rates: np.ndarray, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (M, 3, 6) and durations (M,) where each joint stops at its own time (6,) [s]."""
    times = np.unique(ends)
    begins = np.concatenate([[0.0], times[:-1]])
    pieces = []
    for begin in begins:
        past = np.minimum(begin, ends)
        share = 1.0 - past / ends  # of the first rate, that is left
        reached = angles + 0.5 * rates * past * (1.0 + share)
        pieces.append([reached, rates * share, np.where(share > 0.0, -0.5 * rates / ends, 0.0)])
    return np.array(pieces), times - begins


def _moved(found: ArmPlan, coeffs: np.ndarray, durations: np.ndarray) -> ArmPlan:
    """An `ArmPlan` of another motion, and the rest of a plan."""
    names = [field.name for field in dataclasses.fields(ArmPlan)]
    kept: dict[str, Any] = {name: getattr(found, name) for name in names}
    numbers: list[Any] = [np.asarray(each, np.float32) for each in (coeffs, durations)]
    kept["motion"] = PiecewisePolynomial(coeffs=numbers[0], durations=numbers[1])
    return ArmPlan(**kept)
