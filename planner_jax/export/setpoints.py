"""Setpoints and polynomials of a plan and its recovery trajectory, for all export formats."""

import dataclasses
import operator
import os
from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jaxtyping import PyTree

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.origin import ROUNDING, to_world
from planner_jax.core.plan_files import PlanFileError, leaves_by_name, load_fitting
from planner_jax.core.protocol import Plan, Status, is_solved, take
from planner_jax.recovery.after_plan import is_rested
from planner_jax.robot.arm import ArmPlan, ArmSetpoints
from planner_jax.robot.attitude import QuadrotorSetpoints
from planner_jax.robot.car import CarPlan, CarSetpoints
from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial

MOST = 100_000  # greatest number of setpoints of a plan
# [m, m/s], for arms [rad, rad/s], greatest jump of positions and velocities between two pieces.
_GAP = 1e-3
_GRAVITY = (0.1, 100.0)  # [m/s^2], least and greatest gravity of a plan that is exported
DEFAULT_RATE = 100.0  # [Hz], setpoints per second

Setpoints = QuadrotorSetpoints | CarSetpoints | ArmSetpoints


@dataclasses.dataclass(frozen=True)
class Robot:
    """A kind of robot (quadrotor, car or arm) whose plans can be exported."""

    name: str
    plan: type[Plan]  # class of the robot's plans
    # Shapes of the plan's arrays by name. A letter stands for any size, equal in all the shapes.
    shapes: Mapping[str, tuple[int | str, ...]]
    case_field: str  # name of a field that only the cases of this robot have
    durations: str  # dotted name of the plan's durations [s], whose sum is the plan's duration
    rates: tuple[str, ...]  # names of the setpoints' quantities that are zero at standstill

    def end(self, plan: Plan) -> float:
        """Return the duration [s] of a plan."""
        return float(np.sum(np.asarray(operator.attrgetter(self.durations)(plan))))


_FLOWN = {"trajectory.coeffs": ("M", "D", 3), "trajectory.durations": ("M",), "gravity": ()}
_DRIVEN = {"start": (3,), "time": (), "speed": ("K",), "curvature": ("K",)}
_MOVED = {"motion.coeffs": ("M", "D", "N"), "motion.durations": ("M",)}
_FLIES = ("vel", "acc", "jerk", "body_rate")
_DRIVES = ("speed", "acceleration", "yaw_rate")
ROBOTS = (
    Robot("quadrotor", QuadrotorPlan, _FLOWN, "head_state", "whole.durations", _FLIES),
    Robot("car", CarPlan, _DRIVEN, "movers", "time", _DRIVES),
    Robot("arm", ArmPlan, _MOVED, "scene", "motion.durations", ("rates", "accelerations")),
)


@dataclasses.dataclass(frozen=True)
class Joints:
    """The joints of an arm in an exported file."""

    names: tuple[str, ...]
    # For each joint a text: its number in the names of columns, its name and, if known, its limits.
    lines: tuple[str, ...]


def joints_of(
    plan: ArmPlan, names: Sequence[str] | None = None, case: PyTree | None = None
) -> Joints:
    """Return the joints of an arm's plan for an exported file.

    Args:
        plan: one plan of an arm.
        names: name of each joint, by default the arm's own names, or joint_1, joint_2, ... if there
            is no case.
        case: case of the plan, whose arm and limits are described.

    Raises:
        ArgumentError: there is not one name for each joint, a name occurs twice or is empty, or the
            case is of another robot.
    """
    num = plan.motion.coeffs.shape[-1]
    own, ranges = tuple(f"joint_{k}" for k in range(1, num + 1)), ("",) * num
    if case is not None:
        fits = "scene" in vars(case) and np.shape(case.angles) == (num,)
        require(fits, "case", f"one case of an arm of {num} joints", shown=type(case).__name__)
        own = case.arm.joint_names
        rows = (case.arm.lower, case.arm.upper, case.limits.velocity, case.limits.acceleration)
        ranges = tuple(
            f", from {low:.6g} to {high:.6g} rad, at most {rate:.6g} rad/s and {rise:.6g} rad/s^2"
            for low, high, rate, rise in zip(*map(np.asarray, rows), strict=True)
        )
    names = own if names is None else (names,) if isinstance(names, str) else tuple(names)
    fits = len(set(names)) == len(names) == num and all(isinstance(n, str) and n for n in names)
    require(fits, "joint_names", f"{num} different names", names)
    return Joints(names, tuple(f"q{k + 1}: {names[k]}{limits}" for k, limits in enumerate(ranges)))


def robot_of(plan: Plan) -> Robot:
    """Return the kind of robot of a plan; raise `ArgumentError` if the plan cannot be exported."""
    robot = next((robot for robot in ROBOTS if isinstance(plan, robot.plan)), None)
    if robot is None:
        rule = f"the plan of a robot ({', '.join(robot.name for robot in ROBOTS)})"
        raise ArgumentError("plan", rule, shown=f"a {type(plan).__name__}")
    require_one("plan", "plans", np.shape(plan.status))
    shown = [f"{each.name}: {each.message}" for each in Status if each == plan.status]
    solved = bool(is_solved(plan.status))
    require(solved, "plan", "solved", shown=f"the status {(*shown, plan.status)[0]}")
    _require_shapes(plan, robot)
    _require_floats(plan, robot)
    if not 0.0 < robot.end(plan) < np.inf:
        raise ArgumentError("plan", "some time", verb="take", shown=f"{robot.end(plan):g} s")
    if isinstance(plan, QuadrotorPlan):
        low, high = _GRAVITY
        rule = f"gravity from {low:g} to {high:g} m/s^2"
        if not low <= float(plan.gravity) <= high:
            raise ArgumentError("plan", rule, float(plan.gravity), verb="have")
    if isinstance(plan, QuadrotorPlan | ArmPlan):
        _require_continuous(plan.whole if isinstance(plan, QuadrotorPlan) else plan.motion)
    return robot


def require_one(name: str, all_of: str, shape: tuple[int, ...]) -> None:
    """Raise an error that names the batch `all_of` unless its batch shape, `shape`, is ()."""
    shown = f"a batch of shape {shape}"
    require(shape == (), name, f"one, as pj.take({all_of}, k) gives", shown=shown)


def _require_shapes(plan: Plan, robot: Robot) -> None:
    sizes: dict[int | str, int] = {}
    leaves = leaves_by_name(plan)
    for name, expected in robot.shapes.items():
        shape = np.shape(leaves[name])
        fits = len(shape) == len(expected) and all(
            size == (axis if isinstance(axis, int) else sizes.setdefault(axis, size))
            for axis, size in zip(expected, shape, strict=True)
        )
        if not fits or 0 in shape:
            text = ", ".join(str(sizes.get(axis, axis)) for axis in expected)
            raise ArgumentError("plan", f"{name} of the shape ({text})", shape, verb="have")


def _require_floats(plan: Plan, robot: Robot) -> None:
    names = {field.name for field in dataclasses.fields(robot.plan)} - {"status", "iterations"}
    for name, leaf in leaves_by_name(plan).items():
        kind = np.asarray(leaf).dtype
        if name.partition(".")[0] in names and kind not in (np.float32, np.float64):
            rule = f"floating-point numbers in {name}"
            raise ArgumentError("plan", rule, verb="have", shown=str(kind))


def _require_continuous(path: PiecewisePolynomial) -> None:
    """Raise unless pieces take time, and positions and velocities agree where pieces meet."""
    coeffs, durations = (np.asarray(each, float) for each in (path.coeffs, path.durations))
    least = float(durations.min())
    require(least >= 0.0, "plan", "of durations >= 0", shown=f"{least:g} s")
    taken = durations > 0.0
    coeffs, durations = coeffs[taken], durations[taken][:-1, None]
    powers = np.arange(coeffs.shape[1])
    for order, quantity in enumerate(("positions", "velocities")):
        slopes = powers**order * durations ** np.maximum(powers - order, 0)
        gaps = np.abs(np.einsum("mk,mki->mi", slopes, coeffs[:-1]) - coeffs[1:, order])
        shown = f"a jump of {np.max(gaps, initial=0.0):.3g} in {quantity} between two pieces"
        require(not np.any(gaps > _GAP), "plan", f"continuous to {_GAP:g}", shown=shown)


def setpoints_of(plan: Plan, rate: float) -> Setpoints:
    """Sample the setpoints of one plan of a robot at a rate [Hz], and at its exact end.

    The last interval is half a period to one and a half periods long. If the plan ends at
    standstill, all rates and accelerations of the last setpoint are exactly zero.

    Raises:
        ArgumentError: the plan cannot be exported (see `robot_of`) or is not finite; or the rate is
            not a number, or results in fewer than two setpoints or more than 100,000.
    """
    robot = robot_of(plan)
    end = robot.end(plan)
    low, high = 1.0 / end, (MOST - 1) / end
    is_number = not isinstance(rate, str | bool) and np.ndim(rate) == 0
    require(is_number, "rate", "a number", rate)
    rule = f"from {low:.4g} to {high:.4g} for a plan of {end:.4g} s"
    require(bool(low * (1.0 - 1e-6) <= rate <= high), "rate", rule, rate)
    assert isinstance(plan, QuadrotorPlan | CarPlan | ArmPlan)
    setpoints, last = plan.sample(rate), vars(plan.sample(1.0 / end))
    before = setpoints.time < end - 0.5 / rate
    found = {
        name: np.concatenate([values[before], last[name][-1:]])
        for name, values in vars(setpoints).items()
    }
    for name, values in found.items():
        require(bool(np.isfinite(values).all()), "plan", "finite", shown=f"{name} that is not")
    if is_rested(plan):
        for name in robot.rates:
            found[name][-1] = 0.0
    return dataclasses.replace(setpoints, **found)


def pieces_of(plan: QuadrotorPlan) -> PiecewisePolynomial:
    """Return a plan's polynomial pieces as NumPy arrays, without pieces of zero duration."""
    robot_of(plan)
    path = jax.tree.map(np.asarray, plan.whole)
    coeffs, durations = path.coeffs, path.durations
    taken = durations != 0.0
    is_sound = bool(np.isfinite(coeffs[taken]).all() and (durations[taken] > 0.0).all())
    require(is_sound, "plan", "finite", shown="a trajectory that is not")
    coeffs = np.array(coeffs[taken])
    coeffs = np.concatenate([to_world(coeffs[:, :1], plan.origin), coeffs[:, 1:]], axis=1)
    return dataclasses.replace(path, coeffs=coeffs, durations=durations[taken])


def require_near(positions: np.ndarray) -> None:
    """Raise `ArgumentError` if float32 would round positions [m] by over 1 mm."""
    far = float(np.abs(positions).max(initial=0.0))
    rule = "within 10 km of (0, 0) in this format of float32; plan.replace(origin=None) is"
    require(far * float(np.finfo(np.float32).eps) <= ROUNDING, "plan", rule, shown=f"{far:.8g} m")


def load_plan(path: str | os.PathLike, row: int | None = None) -> Plan:
    """Load one plan from a file that `plan.save` wrote.

    The result is a robot's plan, such as `CarPlan`, without the fields that a task adds.

    Args:
        path: path of the file.
        row: index in the batch of the file; None for a file of one plan.

    Raises:
        PlanFileError: the file has no plans of a quadrotor, a car or an arm.
        ArgumentError: the file has no plan with the index `row`.
    """
    plans: Plan = load_fitting(path, [robot.plan for robot in ROBOTS])
    shape = np.shape(plans.status)
    if shape == ():
        if row is not None:
            raise ArgumentError("row", "given for a file of one plan", row, verb="not be")
        return plans
    if row is None or not 0 <= row < shape[0]:
        shown = "nothing" if row is None else str(row)
        raise ArgumentError("row", f"from 0 to {shape[0] - 1}", shown=shown)
    sizes = {np.shape(leaf)[:1] for leaf in leaves_by_name(plans).values()}
    if len(shape) != 1 or len(sizes) != 1:
        raise PlanFileError("path", "as much of every plan", str(path), verb="hold")
    return take(plans, row)
