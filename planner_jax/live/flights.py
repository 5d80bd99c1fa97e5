"""Trajectories that a robot follows in the live loop, and functions of them and of their plans."""

import dataclasses
import math
from typing import Any, Generic

import numpy as np

from planner_jax.live.course import Course, Query, setpoints_of, state_of, without_recovery, yaw_of
from planner_jax.live.packets import BALL, Packet
from planner_jax.live.strokes import CaseT, PlanT, Stroke
from planner_jax.planning.programs import call_packed

# Greatest jump of position [m] and velocity [m/s] from the current trajectory to a new plan, if the
# plan is found only after its own starting time.
_JOIN = (0.02, 0.2)
# States of the robot below this height [m], or with a greater acceleration [m/s^2], are absurd, and
# so are states with a speed above this multiple of the speed limit.
_LOWEST, _ABRUPT, _FASTEST = -1.0, 100.0, 3.0


@dataclasses.dataclass(frozen=True)
class Flight(Generic[PlanT]):
    """A trajectory of the robot to standstill, and the plan that is its first part, if any."""

    course: Course
    start: float  # [s], time at which the trajectory starts, by the senders' clock
    plan: PlanT | None = None  # None if the trajectory only leads to standstill
    contact: float = math.nan  # [s], time at which the plan meets the ball, same clock
    ball: int = -1  # number of the ball that the plan meets


def flight_of(stroke: Stroke[CaseT, PlanT], plan: PlanT, ball: int, due: float) -> Flight[PlanT]:
    """Return the trajectory of a plan that starts at the time `due` [s]; it ends with the plan."""
    course = without_recovery(plan.trajectory, stroke.case.gravity, stroke.case.limits.air)
    course = dataclasses.replace(course, heading=plan.heading)
    return Flight(course, due, plan, due + stroke.contact(plan), ball)


def heading_at(
    stroke: Stroke[CaseT, PlanT], flight: Flight[PlanT] | None, due: float
) -> np.ndarray | None:
    """Return the heading and its derivative (2,) at the time `due`; None without a request."""
    if flight is not None:
        return yaw_of(flight.course, due - flight.start)
    request = stroke.case.heading
    return None if request is None else np.asarray(request.start)


def joins(flight: Flight[PlanT], found: Flight[PlanT], due: float) -> bool:
    """Return whether the robot may change from a trajectory to another one at the time `due`."""
    old, new = (state_of(each.course, due - each.start) for each in (flight, found))
    return all(math.dist(old[k], new[k]) <= _JOIN[k] for k in range(2))


def sample_setpoints(flight: Flight[PlanT], due: float, period: float, num: int) -> np.ndarray:
    """Return `num` setpoints of a trajectory from the time `due` on, `period` [s] apart."""
    times: Any = np.float32(due - flight.start), np.float32(period)
    return call_packed(setpoints_of, num, None, Query(flight.course, *times))


def is_absurd(packet: Packet, speed: float) -> bool:
    """Return whether a packet has a state of the robot that cannot be, by its limit of speed."""
    if packet.kind == BALL:
        return False
    fast, rise = (math.hypot(*packet.values[k : k + 3]) for k in (3, 6))
    is_slow = fast <= _FASTEST * speed and rise <= _ABRUPT
    return not is_slow or packet.values[2] < _LOWEST
