"""Drives of a car in closed loop: state estimation, tracking, and replanning between frames.

Each physics step is also a control step. A frame is a fixed number of steps, at whose end the pose
is stored. The caller may replace the plan between frames (`sims.tasks.intercept` does).

Measured poses of the car are noisy and arrive late by a fixed latency. Between measurements the car
integrates its own speed and steering angle (dead reckoning). A measurement corrects the estimate of
the pose at the time at which the measurement was taken. The code is written for one drive;
`drive_on` batches it. Times count from the start of the first plan.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.errors import ArgumentError
from planner_jax.robot.car import CarPlan, pose_at
from planner_jax.sims.model import World, step
from planner_jax.sims.noise import CONTROL_RATE, FRAME_RATE, PlaneSensing
from planner_jax.sims.robot import Physics
from planner_jax.sims.robots.car.control import CarState
from planner_jax.sims.robots.car.robot import Car

_TRUST = 0.1  # gain of the pose estimator: fraction of the innovation that a step adds


@dataclasses.dataclass(frozen=True)
class DriveLoop:
    """World and sensing of a simulated drive.

    The noise's standard deviations are copied to `DriveState`, whose leaves are arguments of the
    compiled program. Another noise therefore needs no other program.

    Raises:
        ValueError: the world has no car, or its time step is not the period of control.
    """

    world: World  # the simulated world, which must hold a car
    sensing: PlaneSensing = PlaneSensing()

    def __post_init__(self) -> None:
        if not isinstance(self.world.robot, Car):
            raise ArgumentError(
                "world", "a car", verb="hold", shown=f"a {type(self.world.robot).__name__}"
            )
        if not np.isclose(self.world.timestep * CONTROL_RATE, 1.0):
            raise ArgumentError("timestep", f"{1.0 / CONTROL_RATE:g}", self.world.timestep)

    @property
    def car(self) -> Car:
        """The simulated car of the world."""
        return _car(self.world)

    @property
    def late_steps(self) -> int:
        """The age of a measured pose at its arrival, in control steps."""
        return round(self.sensing.latency * CONTROL_RATE)


@struct.dataclass
class DriveState:
    """The variables that change during a drive: physics, estimates, plan and scores."""

    physics: Physics
    shown: Array  # (L + 1, 3), true poses of the last steps, the newest last
    believed: Array  # (L + 1, 3), estimated poses of the same steps
    plan: CarPlan
    began: Array  # () [s], start time of the plan
    worst_tracking: Array  # () [m], greatest distance of the rear axle from its plan
    squared_tracking: Array  # () [m^2 s], integral of the squared distance
    # (2,) [s], time during which drive and steering commands exceeded their limits
    saturated: Array
    time: Array  # () [s], time since the start of the drive
    pose_stds: Array  # (2,), standard deviations of a measured coordinate [m] and heading [rad]
    key: Array


@struct.dataclass
class Frame:
    """The pose of a car at the end of a frame (20 ms of simulation), and its planned position."""

    time: Array  # () [s], time at the end of the frame
    pose: Array  # (3,) x, y [m] of the rear axle's centre and heading [rad]
    wanted: Array  # (2,) [m], planned position


def _car(world: World) -> Car:
    assert isinstance(world.robot, Car)  # `DriveLoop` has checked this
    return world.robot


def dead_reckon(pose: Array, speed: Array, curvature: Array, span: Any) -> Array:
    """Return the pose (x, y, heading) after `span` [s] at constant speed and path curvature."""
    turned = speed * curvature * span
    middle = pose[2] + 0.5 * turned
    way = speed * span
    return pose + jnp.stack([way * jnp.cos(middle), way * jnp.sin(middle), turned])


def start_drives(loop: DriveLoop, plans: CarPlan, keys: Array) -> DriveState:
    """Return the states of drives at the start of their first plans.

    Args:
        loop: settings of the loop, with the world.
        plans: first plans of B drives, leaves (B, ...).
        keys: (B,) random keys of the noise.
    """

    def one(plan: CarPlan, key: Array) -> DriveState:
        zero = jnp.zeros_like(plan.time)
        history = jnp.tile(plan.start, (loop.late_steps + 1, 1))
        return DriveState(
            physics=loop.car.moving(plan.start, plan.speed[0], plan.curvature[0]),
            shown=history,
            believed=history,
            plan=plan,
            began=zero,
            worst_tracking=zero,
            squared_tracking=zero,
            saturated=jnp.zeros(2, plan.time.dtype),
            time=zero,
            pose_stds=jnp.asarray(loop.sensing.pose_stds, plan.time.dtype),
            key=key,
        )

    return jax.vmap(one)(plans, keys)


def estimate_state(loop: DriveLoop, drive: DriveState) -> tuple[Array, Array, Array]:
    """Return a car's estimated pose (3,), and its exact speed [m/s] and path curvature [1/m]."""
    state = loop.car.state(drive.physics)
    curvature = jnp.tan(state.steering) / loop.car.vehicle.wheelbase
    return drive.believed[-1], state.speed, curvature


def _one_frame(world: World, drive: DriveState, until: Array) -> tuple[DriveState, Frame]:
    car, dtype, span = _car(world), drive.time.dtype, world.timestep
    steps = CONTROL_RATE // FRAME_RATE
    key, noise_key = jax.random.split(drive.key)
    noise = jax.random.normal(noise_key, (steps, *car.noise_shape), dtype)
    times = drive.time + span * jnp.arange(steps, dtype=dtype)
    references = car.references(drive.plan, times - drive.began, world)

    def advance(carry: tuple, now: tuple) -> tuple[tuple, None]:
        physics, shown, believed, worst, squared, saturated = carry
        reference, noise, time = now
        true = car.state(physics)
        counts = time < until
        off = jnp.sum((true.pose[:2] - reference.pos) ** 2)
        state = dataclasses.replace(true, pose=believed[-1])
        command = car.command(state, reference, world)
        over = car.saturation(physics, command)
        physics = step(world, physics, command, jnp.zeros(0, dtype))
        after = car.state(physics)
        # A measured pose is one latency old. A fraction of its difference from the pose that is
        # estimated for that time corrects all later estimates.
        seen = car.sense(dataclasses.replace(true, pose=shown[0]), noise, drive.pose_stds)
        correction = _TRUST * (seen.pose - believed[0])
        next_pose = _advance_estimate(car, believed[-1], true, after, span) + correction
        shown = jnp.concatenate([shown[1:], after.pose[None]])
        believed = jnp.concatenate([believed[1:] + correction[None], next_pose[None]])
        worst = jnp.where(counts, jnp.maximum(worst, off), worst)
        squared = squared + jnp.where(counts, off * span, 0.0)
        saturated = saturated + jnp.where(counts, over * span, 0.0)
        return (physics, shown, believed, worst, squared, saturated), None

    sums = drive.worst_tracking**2, drive.squared_tracking, drive.saturated
    carry, _ = lax.scan(
        advance,
        (drive.physics, drive.shown, drive.believed, *sums),
        (references, noise, times),
    )
    physics, shown, believed, worst, squared, saturated = carry
    time = drive.time + 1.0 / FRAME_RATE
    plan = drive.plan
    wanted = pose_at(plan.start, plan.time, plan.speed, plan.curvature, time - drive.began)[:2]
    drive = dataclasses.replace(
        drive,
        physics=physics,
        shown=shown,
        believed=believed,
        worst_tracking=jnp.sqrt(worst),
        squared_tracking=squared,
        saturated=saturated,
        time=time,
        key=key,
    )
    return drive, Frame(time=time, pose=physics.qpos[:3], wanted=wanted)


def _advance_estimate(
    car: Car, pose: Array, before: CarState, after: CarState, span: float
) -> Array:
    steering = 0.5 * (before.steering + after.steering)
    curvature = jnp.tan(steering) / car.vehicle.wheelbase
    return dead_reckon(pose, after.speed, curvature, span)


@functools.partial(jax.jit, static_argnames=("world", "num_frames"))
def drive_on(
    world: World, drives: DriveState, until: Array, *, num_frames: int
) -> tuple[DriveState, Frame]:
    """Simulate a batch of B drives for `num_frames` frames of 20 ms.

    Args:
        world: a world with a car.
        drives: states of the drives, leaves (B, ...).
        until: (B,) [s], end of the planned drive. Tracking errors and saturation are summed only
            up to this time, since they do not matter afterwards.
        num_frames: number of frames (static).

    Returns:
        The drives at the end, and the frames, leaves (B, num_frames, ...).
    """

    def one(drive: DriveState, until: Array) -> tuple[DriveState, Frame]:
        return lax.scan(
            lambda state, _: _one_frame(world, state, until), drive, None, length=num_frames
        )

    return jax.vmap(one)(drives, until)
