"""Float64 NumPy referee of group interceptions, in which a car meets several targets in turn.

The drive to one target is a leg. Each leg is judged as an interception that starts where and when
the preceding leg ends, by `referee.intercept`. World frame in the plane, SI units.
"""

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from planner_jax.referee.drive import final_poses
from planner_jax.referee.intercept import (
    InterceptVerdict,
    referee_intercepts,
    target_positions_of,
)
from planner_jax.referee.judging import check_leaf


@dataclasses.dataclass(frozen=True)
class GroupVerdict(InterceptVerdict):
    """Verdict on B plans in which a car meets several targets in turn.

    The drive to one target is a leg. The measurements describe the first leg that fails, or the
    last leg if all succeed. Times count from the start of the first leg.
    """

    SENTENCES = {
        "order": "the order is no permutation of the targets with the absent ones last",
        **{name: f"leg {{leg}}: {text}" for name, text in InterceptVerdict.SENTENCES.items()},
    }

    leg: np.ndarray  # (B,) int, index of the leg that the other fields describe
    num_met: np.ndarray  # (B,) int, number of targets that are met up to this leg

    def success_message(self, k: int | tuple) -> str:
        """Describe for plan `k`, a success, how many targets it meets and when."""
        num, time = np.asarray(self.num_met)[k], np.asarray(self.meeting_time)[k]
        return f"{num} targets are met, the last after {time:.3g} s"


def referee_groups(
    cases: Any, plans: Any, *, target_positions: Callable | None = None, **settings: Any
) -> GroupVerdict:
    """Decide for every plan of a batch of group interceptions whether it succeeds.

    Leg k, the drive to the k-th target, must start with the pose, speed and curvature at the end of
    leg k - 1, within the tolerance of `referee_intercepts`, and end in the case's remaining time.

    Args:
        cases: object with the fields of `InterceptGroup`, for B cases.
        plans: object with the fields of `GroupPlan`, for B plans.
        target_positions: function (targets, times (B,) [s]) -> positions (B, 2) [m], for targets of
            a user's own class.
        **settings: other arguments of `referee_intercepts`, which also lists the errors.
    """
    present = np.asarray(cases.present, bool)
    batch, num = present.shape
    order = check_leaf("plan.order", plans.order, (batch, num))
    is_order = (np.sort(order, axis=1) == np.arange(num)).all(axis=1)
    order = np.where(is_order[:, None], order, np.arange(num)).astype(int)
    there = np.take_along_axis(present, order, axis=1)
    is_order &= (there[:, 1:] <= there[:, :-1]).all(axis=1)
    lanes, shared = np.arange(batch), cases.shared
    begin = np.zeros(batch)
    car = (shared.start, shared.speed, shared.curvature)
    found = []
    for k in range(num):
        leg = _index(plans.legs, (lanes, np.full(batch, k)))
        case = _leg(shared, _index(shared.target, (lanes, order[:, k])), begin, car)
        where = _delay(target_positions or target_positions_of, begin)
        found.append(dict(vars(referee_intercepts(case, leg, target_positions=where, **settings))))
        for name in ("failed_time", "meeting_time"):
            found[k][name] = found[k][name] + begin
        begin = begin + np.asarray(leg.time, np.float64)
        at_end = (np.asarray(knots)[:, -1] for knots in (leg.speed, leg.curvature))
        car = (final_poses(leg, shared.body), *at_end)
    together = {name: np.stack([each[name] for each in found], axis=1) for name in found[0]}
    fails = ~together["success"] & there
    leg = np.where(fails.any(axis=1), fails.argmax(axis=1), np.maximum(there.sum(axis=1) - 1, 0))
    fields = {name: leaf[lanes, leg] for name, leaf in together.items()}
    fields["success"] = is_order & ~fails.any(axis=1)
    fields["failed_limit"] = np.where(is_order, fields["failed_limit"], "order")
    for name in ("failed_time", "failed_excess"):
        fields[name] = np.where(is_order, fields[name], 0.0)
    return GroupVerdict(**fields, leg=leg, num_met=leg + ~fails.any(axis=1))


def _leg(shared: Any, target: Any, begin: np.ndarray, car: tuple) -> SimpleNamespace:
    (start, speed, curvature), time = car, np.asarray(shared.time, np.float64)
    own = {"start": start, "speed": speed, "curvature": curvature, "target": target}
    own |= {"time": time - begin, "earliest": np.asarray(shared.earliest, np.float64) - begin}
    own |= {name: _delay_obstacles(vars(shared)[name], begin) for name in ("walls", "movers")}
    return SimpleNamespace(**{**vars(shared), **own})


def _delay_obstacles(group: Any, begin: np.ndarray) -> SimpleNamespace:
    """Return obstacles whose time 0 is `begin` (B,) [s] later; they keep what they have grown."""
    fields, later = dict(vars(group)), begin[:, None]
    fields["centre"] = group.centre + later[..., None] * np.asarray(group.velocity, np.float64)
    fields["radius"] = group.radius + later * np.asarray(group.growth, np.float64)
    if (track := fields.get("track")) is not None:
        ends = {name: np.asarray(vars(track)[name]) - later for name in ("begin", "end")}
        fields["track"] = SimpleNamespace(**{**vars(track), **ends})
    return SimpleNamespace(**fields)


def _delay(where: Callable, begin: np.ndarray) -> Callable:
    return lambda target, times: where(target, begin + times)


def _index(tree: Any, at: tuple) -> Any:
    """Return a copy of a (nested) dataclass in which every array x is replaced by x[at]."""
    if not dataclasses.is_dataclass(tree):
        return np.asarray(tree)[at]
    return type(tree)(**{name: _index(leaf, at) for name, leaf in vars(tree).items()})
