"""A way to rest behind a plan that has been made already, of any robot, judged by the referee."""

import dataclasses
from typing import Any

import jax
import numpy as np

from planner_jax.core.errors import NoEnding
from planner_jax.core.protocol import Plan, lane
from planner_jax.planning.plan import plan
from planner_jax.recovery.arm import braked_arm
from planner_jax.recovery.car import braked_car
from planner_jax.recovery.planner import RestPlanner
from planner_jax.recovery.with_recovery import ending_cases
from planner_jax.referee.rest import referee_rests
from planner_jax.robot.arm_plan import ArmPlan
from planner_jax.robot.car import CarPlan
from planner_jax.robot.quadrotor_plan import QuadrotorPlan
from planner_jax.trajectory.polynomial import states_at

_ARM_AT_REST = 0.01  # [rad/s], fastest joint, as the referee has it


def is_rested(found: Plan) -> bool:
    """Whether one plan comes to rest, by itself or by a way that was planned behind it."""
    if isinstance(found, QuadrotorPlan):
        return found.ending is not None
    if isinstance(found, ArmPlan):
        end = np.asarray(np.sum(found.motion.durations))
        return bool(np.abs(states_at(found.motion, end)[1]).max() <= _ARM_AT_REST)
    return isinstance(found, CarPlan) and not float(np.asarray(found.speed)[-1]) > 0.0


def with_ending(case: Any, found: Plan, to: str) -> Plan:
    """One plan that comes to rest.

    Args:
        case: of the plan, with its limits and what stands in the way; one case.
        found: the plan, of a quadrotor, a car or an arm, which stays as it is up to its end.
        to: "brake", or of a quadrotor "home", as of `planner_jax.recovery.with_recovery.ended`.

    Returns:
        The plan with its `ending`; of a car or an arm one `CarPlan` or `ArmPlan` up to rest.

    Raises:
        NoEnding: there is none that the referee lets pass.
        ValueError: only quadrotors go home.
    """
    if isinstance(found, QuadrotorPlan):
        return _quadrotor(case, found, to)
    if to != "brake":
        raise ValueError(f"to must be brake, as only quadrotors go home, got {to!r}")
    if isinstance(found, CarPlan):
        return braked_car(case, found)
    if isinstance(found, ArmPlan):
        return braked_arm(case, found)
    raise TypeError(f"found must be the plan of a robot, got a {type(found).__name__}")


def _quadrotor(case: Any, found: QuadrotorPlan, to: str) -> QuadrotorPlan:
    cases, plans = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (case, found))
    rest = plan(RestPlanner(to=to), ending_cases(cases, plans))
    ended = dataclasses.replace(plans, ending=jax.tree.map(np.asarray, rest.trajectory))
    verdict = referee_rests(cases, ended)
    if not verdict.success[0]:
        raise NoEnding(verdict.sentence(0))
    return lane(ended, 0)
