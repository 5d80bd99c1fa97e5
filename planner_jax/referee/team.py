"""Float64 NumPy referee of teams: several robots catch targets and keep a distance.

`referee.catch` judges the catches and the flight of every robot. This module tests that no target
is caught twice, and measures the distance of every pair of robots from time 0 until all stand
still. A robot whose trajectory has ended stays at its last position.
"""

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np

from planner_jax.referee import judging
from planner_jax.referee.catch import CatchVerdict, referee_catches

# Number of samples between two times at which one of two trajectories changes its polynomial, and
# number of passes. Every pass after the first one samples around the nearest sample so far.
_SAMPLES, _REFINEMENTS = 256, 3
_Path = tuple[np.ndarray, np.ndarray]  # coefficients (P, D + 1, 3) of pieces, and durations (P,)


@dataclasses.dataclass(frozen=True)
class TeamVerdict(judging.Verdict):
    """Verdict on B plans in which N robots share M targets."""

    SENTENCES = {
        **{name: f"robot {{robot}}: {text}" for name, text in CatchVerdict.SENTENCES.items()},
        "twice": "{excess:.0f} targets are caught by more than one robot",
        "distance": "robots {pair[0]} and {pair[1]} are {least_distance:.4g} m apart at "
        "{time:.3f} s, {excess:.2%} less than allowed",
    }
    UNBOUNDED = {name: f"robot {{robot}}: {x}" for name, x in CatchVerdict.UNBOUNDED.items()}

    robot: np.ndarray  # (B,) int, the first robot whose own plan fails; -1 if no own plan fails
    worst_extra: np.ndarray  # (B,) int, of that robot, or the first: as in `CatchVerdict`
    num_caught: np.ndarray  # (B,) int, number of targets that the robots catch together
    least_distance: np.ndarray  # (B,) [m], of any two robots at any time; infinite for one robot
    pair: np.ndarray  # (B, 2) int, indices of the two robots with the least distance; -1 for one

    def success_message(self, k: int | tuple) -> str:
        """Describe for plan `k`, a success, the number of catches and the least distance."""
        number, least = np.asarray(self.num_caught)[k], np.asarray(self.least_distance)[k]
        return f"{number} caught, robots at least {least:.3g} m apart"


def referee_teams(
    cases: Any, plans: Any, *, tolerance: float = 1e-3, **settings: Any
) -> TeamVerdict:
    """Decide for every plan of a batch of teams whether it succeeds.

    `cases` and `plans` have the fields of `TeamCase` and `TeamPlan`, for B cases. The relative
    `tolerance` is of all limits, also of the least distance. `referee_catches` explains the other
    settings and the errors.
    """
    heads, size = np.asarray(cases.head_states), np.shape(cases.shared.present)[1]
    (batch, num), lanes = heads.shape[:2], np.arange(len(heads))
    taken, own, paths = np.zeros((batch, num, size), bool), [], []
    for k in range(num):
        case = SimpleNamespace(**{**vars(cases.shared), "head_state": heads[:, k]})
        plan = _of(plans.robots, k)
        own.append(referee_catches(case, plan, tolerance=tolerance, **settings))
        order = np.clip(np.nan_to_num(plan.order), 0, size - 1).astype(int)
        np.put_along_axis(taken[:, k], order, own[k].caught, axis=1)
        paths.append(_trajectory(plan))
    fails = np.stack([~verdict.success for verdict in own], axis=1)
    robot = np.where(fails.any(axis=1), fails.argmax(axis=1), -1)
    limit, time, excess, extra = (
        np.stack([vars(verdict)[name] for verdict in own], axis=1)[lanes, np.maximum(robot, 0)]
        for name in ("failed_limit", "failed_time", "failed_excess", "worst_extra")
    )
    least, pair = np.full(batch, np.inf), np.full((batch, 2), -1)
    repeated = (taken.sum(axis=1) > 1).sum(axis=1)
    for lane in lanes:
        at = np.nan
        for two in itertools.combinations(range(num), 2):
            with np.errstate(all="ignore"):
                found = _nearest(*((paths[k][0][lane], paths[k][1][lane]) for k in two))
            if not found[0] >= least[lane]:  # also a distance that is not a number
                (least[lane], at), pair[lane] = found, two
        lack = 1.0 - least[lane] / float(np.asarray(cases.least_distance)[lane])
        if robot[lane] >= 0:
            continue
        if repeated[lane]:
            limit[lane], time[lane], excess[lane] = "twice", 0.0, repeated[lane]
        elif num > 1 and not lack <= tolerance:
            limit[lane], time[lane], excess[lane] = "distance", at, lack
    return TeamVerdict(
        success=limit == "",
        failed_limit=limit,
        failed_time=time,
        failed_excess=excess,
        robot=robot,
        worst_extra=extra,
        num_caught=taken.any(axis=1).sum(axis=1),
        least_distance=least,
        pair=pair,
    )


def _of(tree: Any, k: int) -> Any:
    """Return robot k's part of a (nested) dataclass whose arrays are (B, N, ...)."""
    if tree is None or not dataclasses.is_dataclass(tree):
        return tree if tree is None else np.asarray(tree)[:, k]
    return type(tree)(
        **{name: _of(leaf, k) for name, leaf in vars(tree).items() if name != "origin"}
    )


def _trajectory(plan: Any) -> _Path:
    """Return coefficients (B, P, D + 1, 3) and durations (B, P) of a plan and its recovery."""
    parts = [part for part in (plan.trajectory, plan.recovery) if part is not None]
    size = max(part.coeffs.shape[2] for part in parts)
    pad = lambda x: np.pad(x, [(0, 0), (0, 0), (0, size - x.shape[2]), (0, 0)])  # noqa: E731
    coeffs = np.concatenate([pad(part.coeffs.astype(float)) for part in parts], axis=1)
    return coeffs, np.concatenate([part.durations.astype(float) for part in parts], axis=1)


def _nearest(first: _Path, second: _Path) -> tuple[float, float]:
    """Return the least distance [m] of two trajectories, and its time [s]."""
    knots = np.unique(np.concatenate([[0.0, 1e-3], np.cumsum(first[1]), np.cumsum(second[1])]))
    times = knots[:-1, None] + np.diff(knots)[:, None] * np.linspace(0.0, 1.0, _SAMPLES)
    least = time = np.nan
    for _ in range(_REFINEMENTS):
        times = times.ravel()
        apart = np.linalg.norm(_position(*first, times) - _position(*second, times), axis=1)
        k = apart.argmin()  # the first number that is not finite, if there is one
        around = times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)]
        least, time, times = apart[k], times[k], np.linspace(*around, _SAMPLES)
    return float(least), float(time)


def _position(coeffs: np.ndarray, durations: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return positions (..., 3) at times (...); after its end a trajectory stays at its end."""
    ends = np.cumsum(durations)
    lasting = np.flatnonzero(~(durations <= 0.0))
    if not lasting.size:
        return np.broadcast_to(coeffs[0, 0], (*times.shape, 3))
    piece = lasting[np.minimum(np.searchsorted(ends[lasting], times), lasting.size - 1)]
    local = np.minimum(times - (ends - durations)[piece], durations[piece])
    pieces = np.moveaxis(coeffs[piece], (-2, -1), (0, 1))
    return np.moveaxis(judging.derivative(pieces, local, 0), 0, -1)
