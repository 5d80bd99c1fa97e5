"""What leaves of a plan: its setpoints, or its polynomials. Every format is made of these alone.

`setpoints_of` and `pieces_of` are where a plan is taken as it is, up to its end: that of its ending
where it was planned with one.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from planner_jax.core.errors import ArgumentError
from planner_jax.core.plan_files import named_leaves
from planner_jax.core.protocol import Plan, Status, is_solved
from planner_jax.robot.arm_plan import ArmPlan, ArmSetpoints
from planner_jax.robot.car import CarPlan, CarSetpoints
from planner_jax.robot.quadrotor_plan import QuadrotorPlan, QuadrotorSetpoints
from planner_jax.trajectory.polynomial import PiecewisePolynomial

MOST = 100_000  # setpoints of a plan
DEFAULT_RATE = 100.0  # [Hz]

Setpoints = QuadrotorSetpoints | CarSetpoints | ArmSetpoints


@dataclasses.dataclass(frozen=True)
class Robot:
    """A robot whose plans can leave."""

    name: str
    plan: type[Plan]
    shapes: Mapping[str, tuple[int | str, ...]]  # of the leaves; a letter is one size throughout
    end: Callable[[Any], Any]  # [s], of a plan


ROBOTS = (
    Robot(
        "quadrotor",
        QuadrotorPlan,
        {"trajectory.coeffs": ("M", "D", 3), "trajectory.durations": ("M",), "gravity": ()},
        lambda plan: np.sum(np.asarray(plan.whole.durations)),
    ),
    Robot(
        "car",
        CarPlan,
        {"start": (3,), "time": (), "speed": ("K",), "curvature": ("K",)},
        lambda plan: plan.time,
    ),
    Robot(
        "arm",
        ArmPlan,
        {"motion.coeffs": ("M", "D", 6), "motion.durations": ("M",)},
        lambda plan: np.sum(np.asarray(plan.motion.durations)),
    ),
)


def robot_of(plan: Plan) -> Robot:
    """The robot of one plan that may leave.

    Raises:
        ArgumentError: it is no plan, a batch, of another robot, not solved, or not whole.
    """
    robot = next((robot for robot in ROBOTS if isinstance(plan, robot.plan)), None)
    if robot is None:
        names = ", ".join(robot.name for robot in ROBOTS)
        raise ArgumentError("plan", f"that of a robot ({names})", shown=f"a {type(plan).__name__}")
    if np.ndim(plan.status) != 0:
        shown = f"a batch of shape {np.shape(plan.status)}"
        raise ArgumentError("plan", "one, as pj.lane(plans, k) gives", shown=shown)
    if not is_solved(plan.status):
        shown = [f"{each.name}: {each.message}" for each in Status if each == plan.status]
        raise ArgumentError("plan", "solved", shown=f"the status {(*shown, plan.status)[0]}")
    _require_shapes(plan, robot)
    if not 0.0 < float(robot.end(plan)) < np.inf:
        raise ArgumentError("plan", "some time", verb="take", shown=f"{float(robot.end(plan)):g} s")
    return robot


def _require_shapes(plan: Plan, robot: Robot) -> None:
    """Raise unless the leaves of one plan have the shapes of its robot's."""
    sizes: dict[Any, int] = {}
    leaves = named_leaves(plan)
    for name, wanted in robot.shapes.items():
        shape = np.shape(leaves[name])
        fits = len(shape) == len(wanted) and all(
            size == (want if isinstance(want, int) else sizes.setdefault(want, size))
            for want, size in zip(wanted, shape, strict=True)
        )
        if not fits or 0 in shape:
            words = ", ".join(str(sizes.get(want, want)) for want in wanted)
            raise ArgumentError("plan", f"{name} of the shape ({words})", shape, verb="have")


def setpoints_of(plan: Plan, rate: float) -> Setpoints:
    """One plan at a rate, as its `sample` gives it, from its beginning up to its end.

    Args:
        plan: of a robot of `ROBOTS`, solved.
        rate: [Hz].

    Raises:
        ArgumentError: the plan may not leave, see `robot_of`, or is not finite; or the rate is
            none, leaves nothing but the beginning, or asks for more than `MOST` setpoints.
    """
    end = float(robot_of(plan).end(plan))
    low, high = 1.0 / end, (MOST - 1) / end
    if isinstance(rate, str | bool) or np.ndim(rate) != 0:
        raise ArgumentError("rate", "a number", rate)
    if not low * (1.0 - 1e-6) <= rate <= high:
        rule = f"from {low:.4g} to {high:.4g} for a plan of {end:.4g} s"
        raise ArgumentError("rate", rule, rate)
    any_plan: Any = plan
    setpoints: Setpoints = any_plan.sample(rate)
    for field in dataclasses.fields(setpoints):
        if not np.isfinite(getattr(setpoints, field.name)).all():
            raise ArgumentError("plan", "finite", shown=f"{field.name} that is not")
    return setpoints


def pieces_of(plan: QuadrotorPlan) -> PiecewisePolynomial:
    """The polynomials of one plan that may leave, without pieces that take no time.

    Raises:
        ArgumentError: the plan may not leave, see `robot_of`, or is not finite.
    """
    robot_of(plan)
    path = plan.whole
    coeffs: Any = np.asarray(path.coeffs)
    durations: Any = np.asarray(path.durations)
    taken = durations != 0.0
    if not (np.isfinite(coeffs[taken]).all() and (durations[taken] > 0.0).all()):
        raise ArgumentError("plan", "finite", shown="a trajectory that is not")
    return PiecewisePolynomial(coeffs=coeffs[taken], durations=durations[taken])
