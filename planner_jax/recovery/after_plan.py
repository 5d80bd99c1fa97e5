"""Append a recovery trajectory, which leads to standstill, to an existing plan of any robot."""

import dataclasses

import jax
import numpy as np
from jaxtyping import PyTree

from planner_jax.core.errors import ArgumentError, ArgumentTypeError, NoRecovery
from planner_jax.core.protocol import Plan, is_solved, take
from planner_jax.cost.quadrotor import flight_excess, flight_names, relative_excess
from planner_jax.planning.plan import plan
from planner_jax.recovery.braking import brake_arm, brake_car
from planner_jax.recovery.planner import RecoveryProblem
from planner_jax.recovery.with_recovery import recovery_cases
from planner_jax.robot.arm import ArmPlan
from planner_jax.robot.car import CarPlan
from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.trajectory.polynomial import sample_pieces, states_at

_ARM_AT_REST = 0.01  # [rad/s] greatest joint rate of an arm that counts as standing still
_NODES = 40  # number of intervals of each polynomial piece, at whose ends limits are evaluated


def is_rested(found: Plan) -> bool:
    """Test whether a plan ends at standstill, by itself or by its recovery trajectory."""
    if isinstance(found, QuadrotorPlan):
        return found.recovery is not None
    if isinstance(found, ArmPlan):
        end = np.asarray(np.sum(found.motion.durations))
        return bool(np.abs(states_at(found.motion, end)[1]).max() <= _ARM_AT_REST)
    return isinstance(found, CarPlan) and not float(np.asarray(found.speed)[-1]) > 0.0


def append_recovery(case: PyTree, found: Plan, to: str) -> Plan:
    """Extend a plan by a recovery trajectory, so that it ends at standstill.

    Args:
        case: one case, whose limits and obstacles the recovery respects.
        found: plan of a quadrotor, a car or an arm for this case.
        to: "brake" stops anywhere; "home", only for a quadrotor, stops at the start position.

    Returns:
        The quadrotor's plan with a `recovery`, or one `CarPlan` or `ArmPlan` to standstill.

    Raises:
        NoRecovery: no recovery trajectory keeps every limit; the text names the broken limit.
        ValueError: `to` is "home", but the robot is not a quadrotor.
    """
    if isinstance(found, QuadrotorPlan):
        return _end_flight(case, found, to)
    if to != "brake":
        raise ArgumentError("to", "brake, as only quadrotors go home", to)
    if isinstance(found, CarPlan):
        return brake_car(case, found)
    if isinstance(found, ArmPlan):
        return brake_arm(case, found)
    raise ArgumentTypeError("found", "the plan of a robot", shown=f"a {type(found).__name__}")


def _end_flight(case: PyTree, found: QuadrotorPlan, to: str) -> QuadrotorPlan:
    cases, plans = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (case, found))
    rest_case = recovery_cases(cases, plans)
    rest = plan(RecoveryProblem.planner(to=to), rest_case)
    if is_solved(rest.status[0]):
        return take(dataclasses.replace(plans, recovery=rest.trajectory).with_heading(cases), 0)
    motion = sample_pieces(take(rest.trajectory, 0), _NODES)
    limits = take(rest_case.limits, 0)
    flown = relative_excess(limits, flight_excess(motion, case.gravity, limits))
    worst = [float(np.max(excess)) for excess in flown]
    k = int(np.argmax(worst))
    if worst[k] > 0.0:
        raise NoRecovery(f"{flight_names(limits)[k]}: {worst[k]:.2%} above its limit")
    raise NoRecovery(f"a limit is exceeded by {float(rest.violation[0]):.2%}")
