"""Relaxations of an unsolved interception: limits for which the referee accepts a motion."""

import dataclasses
from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from planner_jax.core.checks import require_kind
from planner_jax.core.choices import require
from planner_jax.core.planner import Planner
from planner_jax.planning.plan import plan as plan_cases
from planner_jax.referee.intercept import LIMITS
from planner_jax.task.intercept.api import judge
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan

_BISECTIONS = 4  # number of plans by which a relaxation is reduced
# Units of the numbers of a case that may be relaxed.
_UNITS = {
    **dict.fromkeys(("speed", "reverse_speed", "end_speed"), "m/s"),
    **dict.fromkeys(("acceleration", "lateral_acceleration"), "m/s^2"),
    **{"jerk": "m/s^3", "curvature": "1/m", "steering_rate": "rad/s", "heading_tolerance": "rad"},
    **dict.fromkeys(("tolerance", "margin", "map", "body"), "m"),
    **dict.fromkeys(("time", "earliest"), "s"),
}
_SIDES = {"map": "every side of the map", "body": "every side of the body"}


@dataclasses.dataclass(frozen=True)
class Relaxation:
    """A case with relaxed limits, and a plan that the referee accepts for this case.

    Attributes:
        case: the case with relaxed limits.
        plan: the plan of that case.
        changes: amount by which each limit is relaxed, by the name of the argument of
            `pj.intercept.case`. "map" is the distance [m] by which the map is larger on every side,
            and "body" the distance [m] by which the car's body is smaller on every side.
    """

    case: InterceptCase
    plan: InterceptPlan
    changes: dict[str, float]

    def sentence(self) -> str:
        """Describe which limits are relaxed, and by what amount and share of the limit."""
        if not self.changes:
            return "no limit needs to be relaxed"
        return "a motion exists for the case with " + ", ".join(map(self._describe, self.changes))

    def _describe(self, name: str) -> str:
        amount, fields = self.changes[name], vars(self.case) | vars(self.case.limits)
        text = f"{_SIDES.get(name, name)} relaxed by {amount:.3g} {_UNITS[name]}"
        if name in (*_SIDES, "end_speed"):
            return text
        sense = -1.0 if name in ("margin", "earliest") else 1.0
        # The car's speed at time 0 is a field of the case, and its speed limit one of the limits.
        limit = float(np.asarray(fields[name])) - sense * amount
        return f"{text} ({amount / limit:.2%})" if limit > 0.0 else text


def relaxation(
    case: InterceptCase,
    plan: InterceptPlan,
    planner: Planner[InterceptCase, InterceptPlan] | None = None,
) -> Relaxation | None:
    """Relax the limits of a case so far that the referee accepts the motion of a plan.

    Use the function for a case that no planner solves, with the plan that `pj.plan` returns: the
    motion that exceeds the limits least. All limits that the motion keeps stay as they are. If the
    body overlaps an obstacle by more than the margin, the body is made smaller.

    Args:
        case: one case.
        plan: a plan for this case.
        planner: plans the case with a half or less of the relaxation, in 4 steps of bisection. By
            default the relaxation is not reduced.

    Returns:
        The relaxation, or None if no relaxation helps, because the plan is not finite, starts
        elsewhere, or overlaps an obstacle deeply.

    Raises:
        ValueError: there is a batch of cases instead of one case.
        TypeError: the case is not an `InterceptCase`, or the plan not an `InterceptPlan`.
    """
    require_kind("case", case, InterceptCase)
    require_kind("plan", plan, InterceptPlan)
    require(case.batch_shape == (), "case", "one case", shown=f"batch shape {case.batch_shape}")
    case = relaxed = jax.tree.map(np.asarray, case)
    changes: dict[str, float] = {}
    for _ in 2 * LIMITS:  # the referee names one limit at a time
        verdict = judge(relaxed, plan)
        if verdict.success:
            break
        name, amount, fields = _relax(relaxed, plan, verdict)
        if not fields:
            return None
        changes[name] = changes.get(name, 0.0) + amount
        relaxed = _replace(relaxed, fields)
    else:
        return None
    found = Relaxation(relaxed, plan, changes)
    if planner is None or jax.tree.structure(case) != jax.tree.structure(relaxed):
        return found
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        share = 0.5 * (low + high)
        between = jax.tree.map(lambda a, b, share=share: _mix(a, b, share), case, relaxed)
        again = plan_cases(planner, between)
        if judge(between, again).success:
            high = share
            smaller = {name: share * amount for name, amount in changes.items()}
            found = Relaxation(between, again, smaller)
        else:
            low = share
    return found


def _relax(case: InterceptCase, plan: InterceptPlan, verdict: PyTree) -> tuple[str, float, dict]:
    """Return name and amount of a relaxation, and fields of the case; no fields: none helps."""
    limit, excess = str(verdict.failed_limit), float(verdict.failed_excess)
    name, limits, body = limit.replace(" ", "_"), case.limits, case.body
    match limit:
        case "speed":
            speed = np.asarray(plan.speed, float)
            over, under = speed.max() - limits.speed, float(limits.least_speed) - speed.min()
            if under > over:
                return "reverse_speed", under, {"limits.reverse_speed": -speed.min()}
            return name, float(over), {"limits.speed": speed.max()}
        case "time" if float(plan.time) > 0.0:
            return name, excess, {"time": case.time + excess}
        case "early":
            return "earliest", excess, {"earliest": case.earliest - excess}
        case "map":
            return name, excess, {"lower": case.lower - excess, "upper": case.upper + excess}
        case "wall" | "mover" if case.margin > 0.0:
            excess = min(excess, float(case.margin))
            return "margin", excess, {"margin": case.margin - excess}
        case "wall" | "mover" if 2.0 * excess < min(body.length, body.width):
            sizes = {"length": 2.0, "width": 2.0, "rear_overhang": 1.0}
            shrunk = {f"body.{key}": vars(body)[key] - k * excess for key, k in sizes.items()}
            return "body", excess, shrunk
        case "meeting":
            return "tolerance", float(excess - case.tolerance), {"tolerance": excess}
        case "heading":
            more = float(excess - case.heading_tolerance)
            return "heading_tolerance", more, {"heading_tolerance": excess}
        case "end speed":
            least, most = case.end_speed
            end = float(verdict.end_speed)
            return name, excess, {"end_speed": (min(least, end), max(most, end))}
        case _ if name in vars(limits):
            peak = float(vars(verdict)[f"max_{name}"])
            return name, float(peak - vars(limits)[name]), {f"limits.{name}": peak}
    return name, excess, {}


def _replace(case: InterceptCase, fields: Mapping[str, ArrayLike]) -> InterceptCase:
    dtype = np.asarray(case.time).dtype
    for path, value in fields.items():
        part, _, name = path.rpartition(".")
        new = {name: np.asarray(value, dtype)}
        if part:
            new = {part: dataclasses.replace(getattr(case, part), **new)}
        case = dataclasses.replace(case, **new)
    return case


def _mix(first: np.ndarray, last: np.ndarray, share: float) -> np.ndarray:
    """Return numbers between two arrays; equal numbers, such as infinite ones, stay as they are."""
    if np.array_equal(first, last):
        return first
    with np.errstate(invalid="ignore"):
        mixed = first + share * (last - first)
    return np.where(first == last, first, mixed).astype(first.dtype)
