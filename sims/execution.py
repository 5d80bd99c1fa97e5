"""Execution of an arm's plans in closed loop: measure the joints, command torques, step the world.

Each physics step is also a control step. Two steps make a frame, at whose end the joint angles are
stored. The arm waits until its motion starts, follows the motion, and brakes at the motion's end.
The code is written for one arm; `execute` batches it. Times count from the moment at which the ball
is first seen.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.compiled import QUICK_OPTIONS
from planner_jax.core.errors import ArgumentError
from planner_jax.sims.model import World, step
from planner_jax.sims.robot import Physics
from planner_jax.sims.robots.arm.control import Course, JointReference
from planner_jax.sims.robots.arm.drives import IDEAL, Drives
from planner_jax.sims.robots.arm.robot import ShieldArm

TIMESTEP = 1e-3  # [s], time step of physics and control
_STEPS, _FRAMES = 2, 50  # number of steps per frame, and of frames per compiled call
FRAME = _STEPS * TIMESTEP  # [s], duration of a frame


@struct.dataclass
class ArmState:
    """The variables that change while an arm follows its course (a timed joint motion)."""

    physics: Physics
    torques: Array  # (n,) [N m], acting torques
    squared_error: Array  # (n,) [rad^2 s], integral of the squared angle error
    worst_error: Array  # (n,) [rad], greatest angle error
    squared_torque: Array  # (n,) [N^2 m^2 s], integral of the squared torque
    worst_torque: Array  # (n,) [N m], greatest torque
    saturated: Array  # (n,) [s], time during which the command exceeded the torque limit
    time: Array  # () [s]
    key: Array


@struct.dataclass
class _Setting:
    """The course (a timed joint motion) and the drives of an arm, constant during execution."""

    course: Course
    since: Array  # () [s], start of the interval in which errors and torques are summed
    until: Array  # () [s], end of that interval
    torques: Array  # (n,) [N m], torque limits
    lag: Array  # () [s], first-order lag of the torques
    stds: Array  # (2,), standard deviations of measured angles [rad] and rates [rad/s]
    mass_error: Array  # (), relative error of the masses in the controller's model


@dataclasses.dataclass(frozen=True)
class Executed:
    """The result of executing B courses (timed joint motions), in float64 arrays (B, ...).

    Errors and torques are evaluated in the interval from `since` to `until` that `execute` gets.
    """

    times: np.ndarray  # (S,) [s], times of the frames; the first is 0
    angles: np.ndarray  # (B, S, n) [rad], joint angles of the simulated arms
    wanted: np.ndarray  # (B, S, n) [rad], planned angles, without the drives' delays
    tracking: np.ndarray  # (B, 2) [m], distance of the shield's centre from its plan: rms and worst
    # (B, n) [rad], rms difference of joint angles and the commanded motion, which may start late.
    error_rms: np.ndarray
    error_worst: np.ndarray  # (B, n) [rad], greatest error of each joint from the commanded motion
    torque_rms: np.ndarray  # (B, n) [N m], rms torque of each joint
    torque_worst: np.ndarray  # (B, n) [N m], greatest torque of each joint
    saturation: np.ndarray  # (B, n), fraction of the time in which a drive was at its torque limit
    last_rates: np.ndarray  # (B, n) [rad/s], rates at the last frame, where another plan may start


def _arm(world: World) -> ShieldArm:
    assert isinstance(world.robot, ShieldArm)  # `execute` has checked this
    return world.robot


def _one_frame(
    world: World, setting: _Setting, state: ArmState
) -> tuple[ArmState, tuple[Array, Array]]:
    """Simulate an arm for one frame of 2 ms; return its state, joint angles and joint rates."""
    robot, dtype, span = _arm(world), state.time.dtype, world.timestep
    key, noise_key = jax.random.split(state.key)
    noise = jax.random.normal(noise_key, (_STEPS, *robot.noise_shape), dtype)
    times = state.time + span * jnp.arange(_STEPS, dtype=dtype)
    # The torques lag behind the commands. Planned accelerations are therefore taken one lag ahead.
    references = robot.references(setting.course, times, world)
    ahead = robot.references(setting.course, times + setting.lag, world)
    references = dataclasses.replace(references, accelerations=ahead.accelerations)
    follows = 1.0 - jnp.exp(-span / jnp.maximum(setting.lag, 1e-6))

    def advance(state: ArmState, now: tuple[JointReference, Array, Array]) -> tuple[ArmState, None]:
        reference, noise, time = now
        true = robot.state(state.physics)
        asked = robot.command(
            robot.sense(true, noise, setting.stds), reference, world, setting.mass_error
        )
        limited = jnp.clip(asked, -setting.torques, setting.torques)
        torques = state.torques + follows * (limited - state.torques)
        counts = jnp.where((time >= setting.since) & (time < setting.until), 1.0, 0.0)
        error = counts * jnp.abs(true.angles - reference.angles)
        size = counts * jnp.abs(torques)
        return ArmState(
            physics=step(world, state.physics, torques, jnp.zeros(0, dtype)),
            torques=torques,
            squared_error=state.squared_error + span * error**2,
            worst_error=jnp.maximum(state.worst_error, error),
            squared_torque=state.squared_torque + span * size**2,
            worst_torque=jnp.maximum(state.worst_torque, size),
            saturated=state.saturated + span * counts * (jnp.abs(asked) > setting.torques),
            time=state.time,
            key=state.key,
        ), None

    state, _ = lax.scan(advance, state, (references, noise, times))
    state = dataclasses.replace(state, time=state.time + _STEPS * span, key=key)
    after = robot.state(state.physics)
    return state, (after.angles, after.rates)


def _frames(world: World, setting: _Setting, state: ArmState) -> tuple[ArmState, Any]:
    return lax.scan(lambda state, _: _one_frame(world, setting, state), state, None, length=_FRAMES)


def _start(world: World, setting: _Setting, key: Array) -> ArmState:
    """Return an arm at the start of its course (a timed motion), with torques that hold it."""
    robot, zero = _arm(world), jnp.zeros_like(setting.course.begin)
    reference = jax.tree.map(
        lambda leaf: leaf[0], robot.references(setting.course, zero[None], world)
    )
    physics = Physics(qpos=reference.angles, qvel=reference.rates, act=jnp.zeros(0, zero.dtype))
    torques = robot.command(robot.state(physics), reference, world)
    none = jnp.zeros_like(torques)
    return ArmState(physics, torques, none, none, none, none, none, zero, key)


@functools.cache
def _compile(world: World) -> tuple[Callable, Callable, Callable]:
    # On a CPU, XLA's fusion emitters recompute a link's position in every expression that uses the
    # position. In a chain of six links this causes hundreds of evaluations. Without fusion emitters
    # a step is 200 times as fast.
    start = jax.jit(jax.vmap(functools.partial(_start, world)))
    advance = jax.jit(jax.vmap(functools.partial(_frames, world)), compiler_options=QUICK_OPTIONS)

    def angles(course: Course, times: Array) -> Array:
        return _arm(world).references(course, times, world).angles

    wanted = jax.jit(jax.vmap(angles, (0, None)))
    return start, advance, wanted


def execute(
    world: World,
    courses: Course,
    keys: Array,
    *,
    since: np.ndarray,
    until: np.ndarray,
    end: float,
    late: np.ndarray | float = 0.0,
    drives: Drives = IDEAL,
) -> Executed:
    """Simulate B arms that execute courses (timed joint motions); return motions and errors.

    Args:
        world: a world with an arm, and steps of `TIMESTEP`.
        courses: the planned courses, leaves (B, ...).
        keys: (B,) random keys of the noise.
        since: (B,) [s], start of the interval in which errors and torques are evaluated.
        until: (B,) [s], end of that interval.
        end: [s], least duration of the simulation.
        late: (B,) or () [s], delay of the start of a course, in addition to the drives' latency.
        drives: limits and errors of the drives, equal for all arms.

    Raises:
        ValueError: the world has no arm, or its time step is not `TIMESTEP`.
    """
    if not isinstance(world.robot, ShieldArm):
        raise ArgumentError("world", "an arm", verb="hold", shown=f"a {type(world.robot).__name__}")
    if not np.isclose(world.timestep, TIMESTEP):
        raise ArgumentError("timestep", f"{TIMESTEP:g}", world.timestep)
    joints = world.robot.num_pos
    if len(drives.torques) != joints:
        raise ArgumentError("torques", f"{joints} numbers", drives.torques)
    start, advance, wanted = _compile(world)
    dtype = jnp.asarray(courses.begin).dtype
    num = len(courses.begin)

    def broadcast(value: Any) -> Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype), (num, *np.shape(value)))

    planned: Course = jax.tree.map(jnp.asarray, courses)
    begins = planned.begin + jnp.asarray(late + drives.latency, dtype)
    setting = _Setting(
        course=dataclasses.replace(planned, begin=begins),
        since=jnp.asarray(since, dtype),
        until=jnp.asarray(until, dtype),
        torques=broadcast(drives.torques),
        lag=broadcast(drives.lag),
        stds=broadcast((drives.angle_std, drives.rate_std)),
        mass_error=broadcast(drives.mass_error),
    )
    state = start(setting, keys)
    first = state.physics.qpos[:, None]
    parts, rates = [], state.physics.qvel
    for _ in range(max(int(np.ceil(end / (_FRAMES * FRAME) - 1e-6)), 1)):
        state, (angles, each) = advance(setting, state)
        parts.append(angles)
        rates = each[:, -1]
    times = FRAME * np.arange(1 + _FRAMES * len(parts))
    state, angles, rates, planned_angles = jax.device_get(
        (
            dataclasses.replace(state, key=None),
            jnp.concatenate([first, *parts], axis=1),
            rates,
            wanted(planned, jnp.asarray(times, dtype)),
        )
    )
    angles, planned_angles = (np.asarray(each, float) for each in (angles, planned_angles))
    place = _arm(world).place
    off = np.linalg.norm(place(angles) - place(planned_angles), axis=2)
    counts = (times >= since[:, None]) & (times < until[:, None])
    off = np.where(counts, off, 0.0)
    rms = np.sqrt((off**2).sum(axis=1) / np.maximum(counts.sum(axis=1), 1))
    span = np.maximum(np.minimum(until, times[-1]) - since, FRAME)[:, None]
    return Executed(
        times=times,
        angles=angles,
        wanted=planned_angles,
        tracking=np.stack([rms, off.max(axis=1)], axis=1),
        error_rms=np.sqrt(state.squared_error / span),
        error_worst=np.asarray(state.worst_error, float),
        torque_rms=np.sqrt(state.squared_torque / span),
        torque_worst=np.asarray(state.worst_torque, float),
        saturation=np.asarray(state.saturated / span, float),
        last_rates=np.asarray(rates, float),
    )
