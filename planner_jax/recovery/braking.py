"""Braking of cars and arms to standstill, by the first candidate motion without a collision."""

import dataclasses
from collections.abc import Iterator
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.errors import NoRecovery
from planner_jax.plane.obstacles import separation
from planner_jax.robot.arm import ArmPlan
from planner_jax.robot.car import CarPlan, pose_at
from planner_jax.trajectory.polynomial import PiecewisePolynomial, states_at

PlanT = TypeVar("PlanT", CarPlan, ArmPlan)

_SPARE = 0.98  # fraction of each limit that braking uses
_SAMPLES = 400  # number of times at which distances are computed
_GAP = 1e-3  # [m] accepted distance to obstacles at samples; it may be smaller between samples
_DECELERATIONS = (1.0, 0.7, 0.4)  # tried decelerations / the car's greatest deceleration
# Tried final curvatures / the car's greatest curvature. The curvature at the plan's end is tried
# before these.
_CURVATURES = (0.0, 0.5, -0.5, 1.0, -1.0)
_USUAL = 1.0  # [m/s^2] or [1/m], value that replaces an infinite limit
_SLOWER = (1.5, 2.0, 3.0)  # tried durations / the shortest in which all joints can stop


def brake_car(case: PyTree, plan: CarPlan) -> CarPlan:
    """Extend the plan of a car by braking to standstill.

    Several decelerations and final curvatures are tried. The first motion without a collision is
    selected. If there is none, `NoRecovery` is raised.
    """
    why = ""
    knots = (jnp.asarray(plan.speed), jnp.asarray(plan.curvature))
    begin = pose_at(jnp.asarray(plan.start), plan.time, *knots, plan.time)
    for speed, curvature in _car_candidates(case, plan):
        time = float(plan.time) / (len(plan.speed) - 1) * (len(speed) - 1)
        problem = _car_problem(case, begin, float(plan.time), time, speed, curvature)
        if not problem:
            return _change(
                CarPlan,
                plan,
                time=np.float32(float(plan.time) + time),
                speed=np.append(plan.speed, speed[1:]).astype(np.float32),
                curvature=np.append(plan.curvature, curvature[1:]).astype(np.float32),
            )
        why = why or problem
    raise NoRecovery(why)


def _car_candidates(case: PyTree, plan: CarPlan) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    limits = case.limits
    step = float(plan.time) / (len(plan.speed) - 1)
    first, bend = float(plan.speed[-1]), float(plan.curvature[-1])
    quickest, sharpest = (
        float(limit) if np.isfinite(limit) else _USUAL
        for limit in (limits.acceleration, limits.curvature)
    )
    targets = [bend, *(_SPARE * share * sharpest for share in _CURVATURES)]
    # The steering angle is atan(L kappa) for the wheelbase L and the curvature kappa. Its slope is
    # at most L, so the steering rate / L is a safe bound on the rate of the curvature.
    turn = _SPARE * float(limits.steering_rate) / float(case.body.wheelbase) * step
    for share in _DECELERATIONS:
        num = max(int(np.ceil(first / (_SPARE * share * quickest * step))), 1)
        speed = first * np.linspace(1.0, 0.0, num + 1)
        # |curvature| <= lateral acceleration / speed^2, with the speed at the start of each step.
        before = np.maximum(speed[:-1] ** 2, 1e-9)
        most = np.maximum(_SPARE * float(limits.lateral_acceleration) / before, abs(bend))
        for target in targets:
            curvature = [bend]
            for bound in most:
                change = np.clip(target - curvature[-1], -turn, turn)
                curvature.append(np.clip(curvature[-1] + change, -bound, bound))
            yield speed, np.array(curvature)


def _car_problem(
    case: PyTree, begin: Array, since: float, time: float, speed: np.ndarray, curvature: np.ndarray
) -> str:
    """Describe the collision of a car that brakes from a pose (3,), or return "".

    Braking starts `since` [s] after the start of the plan and lasts `time` [s]. Speed and curvature
    (n + 1,) are values at equally spaced knots.
    """
    times = np.linspace(0.0, time, _SAMPLES)
    poses = np.asarray(_poses(begin, time, jnp.asarray(speed), jnp.asarray(curvature), times))
    direction = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    middle = poses[:, :2] + float(case.body.middle) * direction
    inside = np.minimum(middle - case.lower, case.upper - middle).min()
    if inside < 0.0:
        return f"map: the body's middle is {-inside:.3g} m outside of the map"
    body = case.body
    ends = (-body.rear_overhang, body.length - body.rear_overhang, 0.5 * body.width)
    for name, each in (("wall", case.walls), ("mover", case.movers)):
        if not np.any(each.present):
            continue
        moved = each.centre[:, None] + each.velocity[:, None] * (since + times)[None, :, None]
        apart = (poses[:, :2] - np.asarray(moved)).astype(np.float32)
        x, y, heading = (host_leaf(part) for part in (apart[..., 0], apart[..., 1], poses[:, 2]))
        gaps = np.asarray(separation(each.corners, each.present, x, y, heading, ends)).min(axis=1)
        k = int(gaps.argmin())
        if gaps[k] < _GAP:
            return f"{name}: the body is {max(-gaps[k], 0.0):.3g} m inside {name}s[{k}]"
    return ""


_poses = jax.jit(jax.vmap(pose_at, in_axes=(None, None, None, None, 0)))


def brake_arm(case: PyTree, plan: ArmPlan) -> ArmPlan:
    """Extend the plan of an arm by braking to standstill, with constant decelerations of joints.

    Tried in this order: all joints stop together in the shortest time, each joint stops as soon as
    it can, all joints stop together later. `NoRecovery` is raised if every one of these motions
    collides or exceeds the range of a joint.
    """
    coeffs, durations = (np.asarray(x, np.float64) for x in vars(plan.motion).values())
    state = states_at(plan.motion, np.asarray(durations.sum()))
    why = ""
    most = np.asarray(case.limits.acceleration, float)
    for pieces, times in _arm_candidates(state[0], state[1], most):
        problem = _arm_problem(case, pieces, times)
        if not problem:
            size = max(coeffs.shape[1], 3)
            wide = [np.pad(x, [(0, 0), (0, size - x.shape[1]), (0, 0)]) for x in (coeffs, pieces)]
            motion = PiecewisePolynomial(
                coeffs=host_leaf(np.concatenate(wide), np.float32),
                durations=host_leaf(np.append(durations, times), np.float32),
            )
            return _change(ArmPlan, plan, motion=motion)
        why = why or problem
    raise NoRecovery(why)


def _arm_candidates(
    angles: np.ndarray, rates: np.ndarray, most: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    alone = np.maximum(np.abs(rates) / (_SPARE * most), 1e-3)
    together = np.full(rates.size, alone.max())
    for ends in (together, alone, *(factor * together for factor in _SLOWER)):
        times = np.unique(ends)
        begins = np.append(0.0, times[:-1])
        pieces = []
        for begin in begins:
            past = np.minimum(begin, ends)
            share = 1.0 - past / ends  # remaining fraction of the initial rate
            reached = angles + 0.5 * rates * past * (1.0 + share)
            pieces.append([reached, rates * share, np.where(share > 0.0, -0.5 * rates / ends, 0.0)])
        yield np.array(pieces), times - begins


def _arm_problem(case: PyTree, pieces: np.ndarray, times: np.ndarray) -> str:
    tau = times[:, None, None] * np.linspace(0.0, 1.0, _SAMPLES // len(times))[:, None]
    first, second, third = np.moveaxis(pieces, 1, 0)[:, :, None]
    angles = (first + tau * (second + tau * third)).reshape(-1, case.arm.num)
    beyond = np.maximum(angles - case.arm.upper, case.arm.lower - angles).max(axis=0)
    joint = int(beyond.argmax())
    if beyond[joint] > 0.0:
        return f"position: joint {joint + 1} is {beyond[joint]:.3g} rad beyond its limit"
    gap = float(np.min(_clearances(case, np.asarray(angles, np.float32))))
    return (
        "" if gap >= _GAP else f"clearance: the arm is {gap:.3g} m from an obstacle or from itself"
    )


_clearances = jax.jit(lambda case, angles: case.clearances(angles))


def _change(kind: type[PlanT], plan: PlanT, **fields: object) -> PlanT:
    values = {field.name: vars(plan)[field.name] for field in dataclasses.fields(kind)}
    return kind(**{**values, **fields})
