"""What a plan leaves with behind its end: its own way to rest, one that is made for it, or none."""

import dataclasses
from typing import Any

from planner_jax.core.choices import ENDINGS, require_one_of
from planner_jax.core.errors import ArgumentError, NoEnding
from planner_jax.core.protocol import Plan
from planner_jax.export.setpoints import robot_of
from planner_jax.recovery.after_plan import is_rested, with_ending
from planner_jax.robot.quadrotor_plan import QuadrotorPlan

# By robot: a field that the cases of its plans have, and those of others do not.
_OF_CASE = {"quadrotor": "head_state", "car": "movers", "arm": "scene"}


def rested(plan: Plan, ending: str | None, case: Any = None) -> Any:
    """One plan that may leave, as it leaves.

    Args:
        plan: of a robot of `ROBOTS`, solved.
        ending: "brake" or "home"; a plan that comes to rest already is left as it is. None: the
            plan up to its last contact, whatever it has behind it.
        case: of the plan; without it no way to rest is made.

    Raises:
        ArgumentError: the plan may not leave, there is no such ending, it takes a case that is not
            given, or no way to rest keeps every limit.
    """
    robot = robot_of(plan)
    if ending is None:
        return dataclasses.replace(plan, ending=None) if isinstance(plan, QuadrotorPlan) else plan
    require_one_of(ENDINGS, "ending", ending)
    if not lacks_ending(plan):
        return plan
    if robot.name != "quadrotor" and ending != "brake":
        raise ArgumentError("ending", "brake, as only quadrotors go home", ending)
    if case is None:
        rule = "given, whose limits the way to rest behind the plan keeps"
        rule += ", or ending=None to leave that out"
        raise ArgumentError("case", rule, shown="neither")
    if not hasattr(case, _OF_CASE[robot.name]):
        raise ArgumentError("case", "that of the plan", type(case).__name__)
    if case.batch_shape != ():
        shown = f"a batch of shape {case.batch_shape}"
        raise ArgumentError("case", "one, as pj.lane(cases, k) gives", shown=shown)
    try:
        return with_ending(case, plan, ending)
    except NoEnding as error:
        rule = "none for a plan behind which no way to rest keeps every limit"
        raise ArgumentError("ending", rule, shown=f"{ending!r} ({error})") from None


def lacks_ending(plan: Plan) -> bool:
    """Whether one plan that may leave does not come to rest.

    Raises:
        ArgumentError: it may not leave.
    """
    robot_of(plan)
    return not is_rested(plan)
