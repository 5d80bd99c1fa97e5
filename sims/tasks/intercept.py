"""Interceptions in closed loop: a car meets a moving target among obstacles [Qu2022].

Before it starts, the car has observed its target 15 times, once a second; it continues to observe
during the drive. Every plan starts at the car's estimated pose and uses a prediction of the target
from the observations that have arrived by then. Walls are known. Moving obstacles, the movers, are
known too, unless they are predicted from observations like the target. World frame in the plane, SI
units; times count from the start of the first plan.
"""

import dataclasses
import functools
import time
import zlib
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core import GRAVITY
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import is_solved
from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.target import PointState, TurningPath
from planner_jax.planning.plan import plan as plan_all
from planner_jax.referee.clearance import clearances
from planner_jax.sims.drive import (
    DriveLoop,
    DriveState,
    Frame,
    drive_on,
    estimate_state,
    start_drives,
)
from planner_jax.sims.launch import flight_keys
from planner_jax.sims.model import World
from planner_jax.sims.noise import CONTROL_RATE, FRAME_RATE
from planner_jax.sims.prediction.polynomial_fit import fit_polynomial
from planner_jax.sims.prediction.select_path import select
from planner_jax.sims.robots.car.robot import Car
from planner_jax.sims.robots.car.vehicle import Vehicle
from planner_jax.sims.task import FlightCases, Flights
from planner_jax.task.intercept.api import draw, observe, positions
from planner_jax.task.intercept.api import planner as intercept_planner
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from planner_jax.task.intercept.plan import InterceptPlan

CAR_WORLD = World(Car(), GRAVITY, num_balls=0, timestep=1.0 / CONTROL_RATE)
SUCCESS = 0.3  # [m], greatest distance from the target of a successful drive at its end
TOUCH = 1e-3  # [m], least penetration that counts as a contact, as in the referee
_SHORTEST = 0.3  # [s], least time to the meeting at which the car replans
_LEAST_STD = 1e-3  # [m], least standard deviation that the prediction assumes of an observation
_CAUTION = 2.0  # number of standard deviations by which predicted obstacles are enlarged
_POINTS = 9  # number of points of a predicted path in a recording


@dataclasses.dataclass(frozen=True)
class Meetings(FlightCases):
    """B cases of interceptions, with observations of targets and obstacles, in NumPy arrays."""

    cases: InterceptCase  # the true cases
    times: np.ndarray  # (B, L) [s], times of the observations
    target: np.ndarray  # (B, L, 2) [m], observed positions of the target
    movers: np.ndarray  # (B, L, N, 2) [m], observed centres of the moving obstacles


jax.tree_util.register_dataclass(Meetings, [each.name for each in dataclasses.fields(Meetings)], [])


def meetings(
    suite: str, num: int, seed: int = 0, *, noise: float = 0.1, observation_rate: float = 1.0
) -> Meetings:
    """Draw interceptions of a suite, with observations before the start and during the drive.

    Args:
        suite: name of a suite (family of random cases) of `pj.intercept.draw`.
        num: B >= 1, number of interceptions.
        seed: >= 0, of cases and noise.
        noise: [m], standard deviation of an observed coordinate.
        observation_rate: [Hz], rate of observations during the drive; 0 for none.
    """
    cases = jax.tree.map(np.asarray, draw(num, suite, seed))
    before, seen = observe(cases, seed, noise)
    end = float(np.max(cases.time))
    later = (
        np.arange(1, int(end * observation_rate + 1e-6) + 1) / observation_rate
        if observation_rate > 0.0
        else np.zeros(0)
    )
    times = np.concatenate([before, later])
    of_path = jax.jit(jax.vmap(lambda path: jax.vmap(lambda at: path.at(at).pos)(later)))
    ahead = np.asarray(of_path(cases.target)) if later.size else np.zeros((num, 0, 2))
    shape = (times.size, 1 + cases.movers.present.shape[1], 2)
    tag = zlib.crc32(b"looks on the way")
    errors = np.stack(
        [np.random.default_rng([seed, k, tag]).standard_normal(shape) for k in range(num)]
    )
    centre, velocity = cases.movers.centre[:, None], cases.movers.velocity[:, None]
    ahead = ahead + noise * errors[:, before.size :, 0]
    return Meetings(
        index=np.arange(num),
        cases=cases,
        times=np.tile(times.astype(np.float32), (num, 1)),
        target=np.concatenate([seen, ahead], axis=1).astype(np.float32),
        movers=(centre + velocity * times[:, None, None] + noise * errors[:, :, 1:]).astype(
            np.float32
        ),
    )


@functools.partial(jax.jit, static_argnames=("loop", "known_target", "predict_movers"))
def predict_scene(
    loop: DriveLoop, meetings: Meetings, now: Array, *, known_target: bool, predict_movers: bool
) -> tuple[TurningPath, Obstacles]:
    """Predict targets and moving obstacles of B cases; predicted times count from `now`.

    Predicted obstacles are enlarged by two standard deviations of their position.

    Args:
        loop: settings of the loop, with the sensing.
        meetings: the B cases with their observations, leaves (B, ...).
        now: () [s], time since the start of the first plan.
        known_target: whether the targets' paths are known; static under jit.
        predict_movers: whether moving obstacles are predicted from observations; static.
    """
    sensing = loop.sensing
    noise = max(sensing.target_std, _LEAST_STD)

    def one(meeting: Meetings) -> tuple[TurningPath, Obstacles]:
        case = meeting.cases
        # Observations before the start have all arrived. Later ones arrive after a latency.
        shown = (meeting.times <= 0.0) | (meeting.times + sensing.latency <= now + 1e-4)
        times, weights = meeting.times - now, shown.astype(now.dtype)
        if known_target:
            there: PointState = case.target.at(now)
            rate = getattr(case.target, "turn_rate", jnp.zeros_like(now))
            target = TurningPath(pos=there.pos, vel=there.vel, turn_rate=rate)
        else:
            target = select(times, meeting.target, noise, weights)
        movers = case.movers
        if not predict_movers:
            centre = movers.centre + movers.velocity * now
            return target, dataclasses.replace(movers, centre=centre)
        fit = lambda seen: fit_polynomial(times, seen, 1, weights).at(0.0 * now)  # noqa: E731
        state = jax.vmap(fit, in_axes=1)(meeting.movers)
        # Standard deviation of the obstacle's current position by a line fitted to observations.
        number = jnp.sum(weights)
        middle = jnp.sum(weights * times) / number
        spread = jnp.sum(weights * (times - middle) ** 2)
        std = sensing.target_std * jnp.sqrt(1.0 / number + middle**2 / spread)
        size = jnp.sqrt(jnp.sum(movers.corners**2, axis=-1, keepdims=True))
        growth = 1.0 + _CAUTION * std / jnp.maximum(size, 1e-3)
        return target, dataclasses.replace(
            movers, centre=state.pos, velocity=state.vel, corners=growth * movers.corners
        )

    return jax.vmap(one)(meetings)


@jax.jit
def remaining(
    cases: InterceptCase,
    elapsed: Array,
    target: TurningPath,
    movers: Obstacles,
    pose: Array,
    speed: Array,
    curvature: Array,
) -> InterceptCase:
    """Return the cases of B drives that start at the cars' current poses, for replanning.

    Args:
        cases: the cases at their start.
        elapsed: (B,) [s], time since the start of the cases.
        target: predicted paths, with times that count from now.
        movers: predicted moving obstacles at their current positions.
        pose: (B, 3) [m, m, rad], current pose of the rear axle.
        speed: (B,) [m/s], current speed.
        curvature: (B,) [1/m], current curvature of the path.
    """
    limits = cases.limits
    return dataclasses.replace(
        cases,
        start=pose,
        speed=jnp.clip(speed, limits.least_speed, limits.speed),
        curvature=jnp.clip(curvature, -limits.curvature, limits.curvature),
        target=target,
        time=cases.time - elapsed,
        movers=movers,
    )


@dataclasses.dataclass(frozen=True)
class Driven:
    """The result of a batch of B drives, on the host; arrays have the leading axis B."""

    times: np.ndarray  # (S,) [s], times of the frames; the first is 0
    poses: np.ndarray  # (B, S, 3), x, y [m] of the rear axle's centre and heading [rad]
    wanted: np.ndarray  # (B, S, 2) [m], planned positions of the rear axle
    meeting: np.ndarray  # (B,) [s], end of the last plan
    tracking: np.ndarray  # (B, 2) [m], distance of the rear axle from its plans: rms and worst
    saturation: np.ndarray  # (B, 2), fraction of the time with drive and steering saturated
    plans: np.ndarray  # (B,) int, number of executed plans
    paths: np.ndarray  # (B, S, M, 2) [m], path of the target as predicted at each frame


@dataclasses.dataclass(frozen=True)
class InterceptFlights(Flights):
    """The result of a batch of B interceptions; arrays have the leading axis B."""

    flown: Driven
    miss: np.ndarray  # (B,) [m], distance from the body's centre to the true target at the end
    target: np.ndarray  # (B, 2) [m], true position of the target at the end
    wall_clearance: np.ndarray  # (B,) [m], least clearance from walls; negative inside
    mover_clearance: np.ndarray  # (B,) [m], least clearance from moving obstacles; negative inside

    @property
    def touched(self) -> np.ndarray:
        """Mask (B,) of the B cars that touched an obstacle."""
        return np.minimum(self.wall_clearance, self.mover_clearance) < -TOUCH

    @property
    def success(self) -> np.ndarray:
        """Mask (B,) of the B cars that came within 0.3 m of the target and touched no obstacle."""
        return (self.miss <= SUCCESS) & ~self.touched


def fly_intercepts(
    loop: DriveLoop,
    cases: Meetings,
    seed: int = 0,
    *,
    replan: float = 1.0,
    planner: Any = None,
    plan: InterceptPlan | None = None,
    known_target: bool = False,
    predict_movers: bool = False,
) -> InterceptFlights:
    """Plan and simulate a batch of interceptions, with replanning at a rate.

    A new plan starts at the car's estimated pose. It replaces the old plan if it satisfies every
    limit.

    Args:
        loop: world and sensing.
        cases: targets, obstacles and observations.
        seed: random seed of the noise on the car's pose, >= 0.
        replan: [Hz], rate of replanning; 0 drives the first plan to its end.
        planner: planner of all plans, by default the planner named `spacetime`.
        plan: first plan of each drive; by default it is made here.
        known_target: whether the targets' paths are known instead of predicted.
        predict_movers: whether moving obstacles are predicted from observations instead of known.

    Raises:
        ValueError: `replan` does not divide the simulation's 50 frames per second, or the cases'
            car is not the simulated car.
    """
    require_car(loop.car.vehicle, cases.cases)
    frames = loop.sensing.frames_per_plan(replan)
    planner = planner or intercept_planner()
    predict = functools.partial(
        predict_scene, loop, cases, known_target=known_target, predict_movers=predict_movers
    )
    truth = jax.tree.map(jnp.asarray, cases.cases)
    until, zero = truth.time, jnp.zeros((), truth.time.dtype)
    target, movers = predict(zero)
    begun = remaining(
        truth, jnp.zeros_like(until), target, movers, truth.start, truth.speed, truth.curvature
    )
    clock = time.perf_counter()
    first = jax.block_until_ready(plan_all(planner, begun)) if plan is None else plan
    planning = time.perf_counter() - clock
    drive = start_drives(loop, jax.tree.map(jnp.asarray, first), flight_keys(seed, cases.index))
    number = np.ones(len(cases), int)
    parts, seen = [], []
    periods = int(np.ceil(float(jnp.max(until)) * FRAME_RATE / frames - 1e-6))
    for period in range(periods):
        seen.append((_sample_paths(target, until - drive.time), frames))
        drive, part = drive_on(loop.world, drive, until, num_frames=frames)
        parts.append(part)
        if replan > 0.0 and period + 1 < periods:
            target, movers = predict(drive.time[0])
            drive, begun, good = plan_again(loop, planner, drive, begun, target, movers)
            number += np.asarray(good)
    flown = _collect_drives(truth, drive, parts, seen, number)
    return score(cases.cases, first, flown, planning)


def plan_again(
    loop: DriveLoop,
    planner: Any,
    drive: DriveState,
    begun: InterceptCase,
    target: TurningPath,
    movers: Obstacles,
) -> tuple[DriveState, InterceptCase, Array]:
    """Plan again from the cars' estimated poses, and use the plans that satisfy every limit.

    Args:
        loop: settings of the drives' loop.
        planner: planner of the remaining cases.
        drive: states of the B drives, leaves (B, ...).
        begun: the cases of the current plans, at the start of those plans.
        target: predicted paths of the targets, with times that count from now.
        movers: predicted moving obstacles at their current positions.

    Returns:
        The drives, the cases of their plans, and a mask (B,) of the drives with a new plan.
    """
    pose, speed, curvature = jax.vmap(functools.partial(estimate_state, loop))(drive)
    elapsed = drive.time - drive.began
    if isinstance(planner, SpacetimeIntercept):
        again = planner.replanner()
        task = again.begin(
            begun,
            cast(InterceptPlan, drive.plan),
            elapsed,
            target=target,
            movers=movers,
            start=pose,
            speed=speed,
            curvature=curvature,
        )
        left, found = task.case, plan_all(again, task)
    else:
        left = remaining(begun, elapsed, target, movers, pose, speed, curvature)
        found = plan_all(planner, left)
    left, found = jax.tree.map(jnp.asarray, (left, found))
    good = is_solved(found.status) & (left.time >= _SHORTEST)
    return *_replace_plans(good, (drive.plan, drive.began, begun), found, left, drive), good


@jax.jit
def _replace_plans(
    good: Array, old: tuple, found: InterceptPlan, left: InterceptCase, drive: DriveState
) -> tuple[DriveState, InterceptCase]:

    def pick(new: Array, before: Array) -> Array:
        return jnp.where(good.reshape(good.shape + (1,) * (new.ndim - 1)), new, before)

    plan, began, begun = jax.tree.map(pick, (found, drive.time, left), old)
    return dataclasses.replace(drive, plan=plan, began=began), begun


@jax.jit
def _sample_paths(path: TurningPath, span: Array) -> Array:
    shares = jnp.linspace(0.0, 1.0, _POINTS)
    of_one = lambda path, span: jax.vmap(lambda share: path.at(share * span).pos)(shares)  # noqa: E731
    return jax.vmap(of_one)(path, span)


def _collect_drives(
    truth: InterceptCase,
    drive: DriveState,
    parts: list[Frame],
    seen: list[tuple[Array, int]],
    number: np.ndarray,
) -> Driven:
    drive, parts, seen = jax.device_get((dataclasses.replace(drive, key=None), parts, seen))
    frames = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *parts)
    start = np.asarray(truth.start)[:, None]
    end = np.asarray(truth.time)
    paths = np.concatenate([np.repeat(path[:, None], n, axis=1) for path, n in seen], axis=1)
    return Driven(
        times=np.arange(frames.time.shape[1] + 1) / FRAME_RATE,
        poses=np.concatenate([start, frames.pose], axis=1).astype(float),
        wanted=np.concatenate([start[..., :2], frames.wanted], axis=1).astype(float),
        meeting=np.asarray(drive.began + drive.plan.time, float),
        tracking=np.stack([np.sqrt(drive.squared_tracking / end), drive.worst_tracking], axis=1),
        saturation=np.asarray(drive.saturated) / end[:, None],
        plans=number,
        paths=np.concatenate([paths[:, :1], paths], axis=1),
    )


def score(
    cases: InterceptCase, first: InterceptPlan, flown: Driven, planning_seconds: float = 0.0
) -> InterceptFlights:
    """Compute distances from true targets at the end, and least clearances from obstacles.

    Args:
        cases: the true cases of B drives, leaves (B, ...).
        first: the first plan of each drive.
        flown: the simulated drives.
        planning_seconds: wall time of planning the first plans of all drives.
    """
    meeting = flown.meeting
    times = np.minimum(flown.times, meeting[:, None])  # (B, S)
    body = np.stack(
        [
            np.stack([np.interp(at, flown.times, of) for of in pose.T], axis=1)
            for at, pose in zip(times, flown.poses, strict=True)
        ]
    )
    length, width, overhang = (
        np.asarray(leaf, float)
        for leaf in (cases.body.length, cases.body.width, cases.body.rear_overhang)
    )
    ahead = (0.5 * length - overhang)[:, None]
    body[..., 0] += ahead * np.cos(body[..., 2])
    body[..., 1] += ahead * np.sin(body[..., 2])
    target = positions(cases.target, meeting)
    half = 0.5 * np.stack([length, width], axis=1)
    least = {
        name: clearances(_group(group), half, times, body)[0]
        for name, group in (("wall", cases.walls), ("mover", cases.movers))
    }
    return InterceptFlights(
        first_plan=first,
        flown=flown,
        planning_seconds=planning_seconds,
        miss=np.linalg.norm(body[:, -1, :2] - target, axis=1),
        target=target,
        wall_clearance=least["wall"],
        mover_clearance=least["mover"],
    )


def _group(obstacles: Obstacles) -> dict[str, np.ndarray]:
    present = np.asarray(obstacles.present)
    leaves = {name: np.asarray(getattr(obstacles, name), float) for name in ("centre", "velocity")}
    leaves["corners"] = np.asarray(obstacles.corners, float)
    there = {
        name: np.where(present.reshape(present.shape + (1,) * (leaf.ndim - 2)), leaf, 0.0)
        for name, leaf in leaves.items()
    }
    return {**there, "present": present}


def require_car(vehicle: Vehicle, cases: InterceptCase) -> None:
    """Raise `ValueError` unless the simulated car equals the car for which plans are made."""
    for name in ("length", "width", "wheelbase", "rear_overhang"):
        own, planned = getattr(vehicle, name), np.asarray(getattr(cases.body, name))
        if not np.allclose(planned, own, rtol=1e-5):
            raise ArgumentError(
                name,
                "the same in plan and simulated car",
                shown=f"{planned.flat[0]:g} in the plan's case and {own:g} in the car",
            )
