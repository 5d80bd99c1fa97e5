"""What a plan leaves with behind its end: its own way to rest, one that is made for it, or none."""

import dataclasses
from typing import Any

from planner_jax.core.protocol import Plan
from planner_jax.core.recovery_names import ending_problem
from planner_jax.export.setpoints import ExportError, robot_of
from planner_jax.recovery.after_plan import is_rested, with_ending
from planner_jax.recovery.no_ending import NoEnding
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
        ExportError: the plan may not leave, there is no such ending, it takes a case that is not
            given, or no way to rest keeps every limit.
    """
    robot = robot_of(plan)
    if ending is None:
        return dataclasses.replace(plan, ending=None) if isinstance(plan, QuadrotorPlan) else plan
    if problem := ending_problem(ending):
        raise ExportError(problem)
    if not lacks_ending(plan):
        return plan
    if robot.name != "quadrotor" and ending != "brake":
        raise ExportError(f"ending must be brake, as only quadrotors go home, got {ending!r}")
    if case is None:
        rule = "case must be given, whose limits the way to rest behind the plan keeps"
        raise ExportError(f"{rule}, or ending=None to leave that out, got neither")
    if not hasattr(case, _OF_CASE[robot.name]):
        raise ExportError(f"case must be that of the plan, got {type(case).__name__}")
    if case.batch_shape != ():
        shown = f"a batch of shape {case.batch_shape}"
        raise ExportError(f"case must be one, as pj.lane(cases, k) gives, got {shown}")
    try:
        return with_ending(case, plan, ending)
    except NoEnding as error:
        rule = "none for a plan behind which no way to rest keeps every limit"
        raise ExportError(f"ending must be {rule}, got {ending!r} ({error})") from None


def lacks_ending(plan: Plan) -> bool:
    """Whether one plan that may leave does not come to rest.

    Raises:
        ExportError: it may not leave.
    """
    robot_of(plan)
    return not is_rested(plan)
