"""Float64 NumPy referee of groups: every leg is judged as an interception, and legs must join.

When and where a leg begins is worked out here from the legs before it, as the referee of
interceptions integrates them; a plan's own beginnings are not read. World frame in the plane, SI
units.
"""

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from planner_jax.referee.intercept import (
    InterceptVerdict,
    final_poses,
    referee_intercepts,
    target_positions_of,
)
from planner_jax.referee.judging import checked_leaf


@dataclasses.dataclass(frozen=True)
class GroupVerdict(InterceptVerdict):
    """What the referee found, one entry a group.

    What is measured is that of the first leg that fails, or of the last leg of a success. Times
    count from the beginning of the first leg.
    """

    SENTENCES = {
        "order": "the order is no permutation of the targets with the absent ones last",
        **{name: f"leg {{leg}}: {text}" for name, text in InterceptVerdict.SENTENCES.items()},
    }

    leg: np.ndarray  # (B,) int, of which all this is said
    num_met: np.ndarray  # (B,) int, targets that are met before that leg, with it if it succeeds

    def praise(self, k: int | tuple) -> str:
        """Return the end of the sentence for a success."""
        num, time = np.asarray(self.num_met)[k], np.asarray(self.meeting_time)[k]
        return f"{num} targets are met, the last after {time:.3g} s"


def referee_groups(
    cases: Any, plans: Any, *, target_positions: Callable | None = None, **settings: Any
) -> GroupVerdict:
    """Judge every plan of a batch; arguments and errors are those of `referee_intercepts`.

    Leg k has to begin where leg k - 1 ends: pose, speed and curvature, within the tolerance that
    the first one has for the car's own. Its time is what is left of the case's. Nothing is read of
    legs to absent targets.
    """
    present = np.asarray(cases.present, bool)
    batch, num = present.shape
    order = checked_leaf("plan.order", plans.order, (batch, num))
    is_order = (np.sort(order, axis=1) == np.arange(num)).all(axis=1)
    order = np.where(is_order[:, None], order, np.arange(num)).astype(int)
    there = np.take_along_axis(present, order, axis=1)
    is_order &= (there[:, 1:] <= there[:, :-1]).all(axis=1)
    lanes, shared = np.arange(batch), cases.shared
    begin = np.zeros(batch)
    car = (shared.start, shared.speed, shared.curvature)
    found = []
    for k in range(num):
        leg = _entries(plans.legs, (lanes, np.full(batch, k)))
        case = _leg(shared, _entries(shared.target, (lanes, order[:, k])), begin, car)
        where = _later(target_positions or target_positions_of, begin)
        verdict = referee_intercepts(case, leg, target_positions=where, **settings)
        found.append(dict(vars(verdict)))
        for name in ("failed_time", "meeting_time"):
            found[k][name] = found[k][name] + begin
        begin = begin + np.asarray(leg.time, np.float64)
        car = (
            final_poses(leg, shared.body),
            np.asarray(leg.speed)[:, -1],
            np.asarray(leg.curvature)[:, -1],
        )
    together = {name: np.stack([each[name] for each in found], axis=1) for name in found[0]}
    fails = ~together["success"] & there
    last = np.maximum(there.sum(axis=1) - 1, 0)
    leg = np.where(fails.any(axis=1), fails.argmax(axis=1), last)
    said = {name: leaf[lanes, leg] for name, leaf in together.items()}
    said["success"] = is_order & ~fails.any(axis=1)
    said["failed_limit"] = np.where(is_order, said["failed_limit"], "order")
    for name in ("failed_time", "failed_excess"):
        said[name] = np.where(is_order, said[name], 0.0)
    return GroupVerdict(**said, leg=leg, num_met=leg + ~fails.any(axis=1))


def _leg(shared: Any, target: Any, begin: np.ndarray, car: tuple) -> SimpleNamespace:
    """What `referee_intercepts` reads of the interceptions that begin at times (B,) [s]."""
    movers, (start, speed, curvature) = shared.movers, car
    passed = begin[:, None, None] * np.asarray(movers.velocity, np.float64)
    names = ("tolerance", "end_heading", "heading_tolerance", "walls", "lower", "upper")
    return SimpleNamespace(
        **{name: vars(shared)[name] for name in (*names, "body", "limits")},
        start=start,
        speed=speed,
        curvature=curvature,
        target=target,
        time=np.asarray(shared.time, np.float64) - begin,
        movers=SimpleNamespace(
            centre=movers.centre + passed,
            corners=movers.corners,
            velocity=movers.velocity,
            present=movers.present,
        ),
    )


def _later(where: Callable, begin: np.ndarray) -> Callable:
    """Positions of targets at times that count from moments (B,) [s]."""
    return lambda target, times: where(target, begin + times)


def _entries(tree: Any, at: tuple) -> Any:
    """Entries of every leaf of a dataclass of arrays, or of such dataclasses."""
    if not dataclasses.is_dataclass(tree):
        return np.asarray(tree)[at]
    return type(tree)(**{name: _entries(leaf, at) for name, leaf in vars(tree).items()})
