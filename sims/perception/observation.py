"""Simulated camera observations of thrown balls, and the cases that planners get from them.

The camera's first image (frame) is at a case's time 0. A flight is fitted to the observations up to
some time. The planner gets a case with the fitted ball. The referee, an independent check of the
plan, gets the case with the true ball.
Positions are in the robot's base frame with z up, in SI units.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.choices import require
from planner_jax.robot.arm_scene import RIG_HALF, Box
from planner_jax.sims.perception.camera import Camera, looking_at
from planner_jax.sims.perception.flight_fit import (
    FlightFit,
    across_std,
    belief_at,
    error_across,
    fit_flight,
)
from planner_jax.sims.perception.noise import (
    IsotropicNoise,
    Noise,
    information,
    sightings,
    stereo_noise,
)
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.problem.flight import flight_of


@struct.dataclass
class Eye:
    """A camera that observes the ball, with its measurement noise and its frame rate."""

    camera: Camera
    noise: Noise
    rate: float = struct.field(pytree_node=False)  # [Hz] frame rate


def mast_camera(size: tuple[int, int] = (1280, 720)) -> Camera:
    """Return a camera on a mast behind the arm, 1.6 m above the arm's base.

    Position and field of view (120 degrees) are assumptions, chosen so that the camera sees the
    throws of all suites almost until they enter the outer box, the region in which the arm may
    block them. It is 0.3 m to the left of the arm's axis, so that the pole in front of the arm does
    not hide balls. In the model of [Natarajan2024] the camera is in front of the arm, where a
    field of view of 110 degrees does not cover throws from up to 60 degrees to either side.
    """
    place = np.array([-RIG_HALF, 0.3, 1.6])
    ahead = np.array([1.0, np.tan(np.deg2rad(-1.0)), np.tan(np.deg2rad(-8.0))])
    return looking_at(place, place + ahead, size=size, field_of_view=np.deg2rad(120.0))


def eye(*, rate: float = 60.0, std: float | None = None, camera: Camera | None = None) -> Eye:
    """Return a camera in the scene with measurement noise and a frame rate.

    Args:
        rate: [Hz], frame rate.
        std: [m], standard deviation of each coordinate, for isotropic noise; None selects the noise
            of a stereo camera, `stereo_noise()`.
        camera: the camera; by default `mast_camera()`.

    Raises:
        ArgumentError: a number is not positive.
    """
    require(bool(rate > 0.0), "rate", "> 0", rate)
    require(std is None or bool(std > 0.0), "std", "> 0", std)
    return Eye(
        camera=mast_camera() if camera is None else camera,
        noise=stereo_noise() if std is None else IsotropicNoise(std=host_leaf(std, np.float32)),
        rate=rate,
    )


def frame_times(eye: Eye, seconds: float) -> np.ndarray:
    """Return the times (N,) [s] of all frames from time 0 up to and including `seconds` [s]."""
    # The small term prevents that rounding excludes a frame exactly at `seconds`.
    return np.arange(int(np.floor(seconds * eye.rate + 1e-6)) + 1) / eye.rate


@jax.jit
def watch(cases: BlockCase, eye: Eye, times: Array, key: Array) -> Array:
    """Simulate the observed positions of a batch of flying balls in N frames; compiled by jit.

    Args:
        cases: a batch of B cases with the true balls.
        eye: the camera, its noise and its frame rate.
        times: (N,) [s], times of the frames.
        key: random key of the noise, or one key for each case, (B,).

    Returns:
        (B, N, 3) [m], observed positions; NaN where a ball is not seen.
    """

    def one(ball: BallState, gravity: Array, key: Array) -> Array:
        places = jax.vmap(drag_free_flight, (None, 0, None))(ball, times, gravity).pos
        return sightings(key, eye.camera, eye.noise, places)

    keys = key if key.ndim else jax.random.split(key, cases.batch_shape[0])
    return jax.vmap(one)(cases.ball, cases.gravity, keys)


def fit_until(eye: Eye, times: Array, places: Array, gravity: Array, until: Array) -> FlightFit:
    """Fit the flight of one ball to its observations up to a time; usable with jit and vmap.

    Args:
        eye: the camera that made the observations; its noise determines their weights.
        times: (N,) [s], times of the observations.
        places: (N, 3) [m], observed positions.
        gravity: () [m/s^2], magnitude.
        until: () [s], time after which observations are ignored.
    """
    known = jnp.where((times <= until + 1e-4)[:, None], places, jnp.nan)
    return fit_flight(times, known, information(eye.camera, eye.noise, known), gravity)


@jax.jit
def fit_throws(
    cases: BlockCase, eye: Eye, times: Array, places: Array, moment: Array
) -> tuple[BallState, FlightFit]:
    """Fit the flights of a batch of B balls to their observations (B, N, 3) up to `moment` [s].

    Returns:
        balls: estimated states of the balls at time 0, leaves (B, 3).
        fits: the fitted flights with their uncertainty, leaves (B, ...).
    """
    fits = jax.vmap(fit_until, (None, None, 0, 0, None))(eye, times, places, cases.gravity, moment)
    start = jnp.zeros((), times.dtype)
    return jax.vmap(belief_at, (0, None, 0))(fits, start, cases.gravity).ball, fits


@struct.dataclass
class SeenThrows:
    """A batch of thrown balls as estimated from their observations up to some moment."""

    cases: BlockCase  # cases for a planner, with the estimated balls
    fits: FlightFit  # the fitted flights, leaves (B, ...)


def see(
    cases: BlockCase, eye: Eye, seconds: float, *, seed: int = 0, overhead: float = 0.0
) -> SeenThrows:
    """Simulate the observation of a batch of throws, and return cases with the estimated balls.

    Pass the returned cases through `cautious` and then to a planner. To judge the plans, copy the
    field `delay` of the returned cases to the true cases, and pass true cases and plans to
    `sims.perception.contact_check.end_at_contact`. A ball that was seen at fewer than two times is
    NaN, and `fits.status` states the reason.

    Args:
        cases: a batch of B cases with the true balls.
        eye: the camera, its noise and its frame rate.
        seconds: [s], duration of the observation, from a case's time 0 until the fit, >= 0.
        seed: seed of the noise.
        overhead: [s], time from the fit until the arm may start to move, >= 0.

    Raises:
        ArgumentError: a time is negative.
    """
    for name, value in (("seconds", seconds), ("overhead", overhead)):
        require(bool(value >= 0.0), name, ">= 0", value)
    times = jnp.asarray(frame_times(eye, seconds), cases.gravity.dtype)
    places = watch(cases, eye, times, jax.random.key(seed))
    balls, fits = fit_throws(cases, eye, times, places, times[-1])
    delay = jnp.full_like(cases.delay, seconds + overhead)
    return SeenThrows(cases=dataclasses.replace(cases, ball=balls, delay=delay), fits=fits)


def cautious(
    cases: BlockCase,
    *,
    offset: float = 0.02,
    grow: float = 0.1,
    edge: float = 0.0,
    at_rest: bool = False,
) -> BlockCase:
    """Return cases with stricter requirements, so that plans also block balls with fit errors.

    A planner treats the fitted ball as exact. If it must meet the ball near the shield's centre,
    the shield still blocks a true ball that passes at some distance. A ball that is estimated to
    miss the protected inner box may still hit it. For such a ball the box is enlarged, so that the
    planner blocks the ball as well.

    Args:
        cases: a batch of cases with fitted balls.
        offset: [m], greatest allowed distance of the contact from the shield's centre; a smaller
            value in a case is kept.
        grow: [m], enlargement of the inner box at its sides and its top for balls that miss it.
        edge: [m], length by which the ball's path between outer and inner box is shortened at both
            ends, as a reserve for errors along the path.
        at_rest: whether the arm must be at rest at the contact in every case. An arm at rest also
            blocks a ball that comes later than estimated.
    """
    inner, outer = cases.scene.inner, cases.scene.outer
    passes = ~jax.jit(jax.vmap(flight_of))(cases).comes
    more = (edge + jnp.where(passes, grow, 0.0))[:, None]
    sides = np.array([1.0, 1.0, 0.0], np.float32)
    grown = Box(lower=inner.lower - more * sides, upper=inner.upper + more)
    shrunk = Box(lower=outer.lower + edge * sides, upper=outer.upper - edge)
    return dataclasses.replace(
        cases,
        ends_at_rest=cases.ends_at_rest | at_rest,
        offset=jnp.minimum(cases.offset, offset),
        scene=dataclasses.replace(cases.scene, inner=grown, outer=shrunk),
    )


@jax.jit
def fit_errors(cases: BlockCase, fits: FlightFit) -> tuple[Array, Array]:
    """Return the position errors of fitted flights, halfway through the time for blocking the ball.

    The ball can be blocked from its entry into the outer box around the arm until its entry into
    the inner box, which is protected.

    Args:
        cases: a batch of B cases with the true balls.
        fits: fits of these balls.

    Returns:
        error: (B,) [m], distance of the estimated from the true ball, normal to its velocity.
        std: (B,) [m], estimated standard deviations of these errors.
    """

    def one(case: BlockCase, fit: FlightFit) -> tuple[Array, Array]:
        flight = flight_of(case)
        middle = 0.5 * (flight.earliest + flight.latest)
        belief = belief_at(fit, middle, case.gravity)
        truth = drag_free_flight(case.ball, middle, case.gravity)
        return error_across(belief, truth), across_std(belief)

    return jax.vmap(one)(cases, fits)
