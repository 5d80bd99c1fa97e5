"""Throws as a camera sees them: what a planner knows of the ball, and from when on.

A ball is seen first at a case's time 0, then in every frame. What was seen until some moment is
fitted, and a case with the fitted ball is what a planner gets; the referee has the true one. Robot
base frame, z up, SI units.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.errors import ArgumentError
from planner_jax.studies.block.camera import Camera, looking_at
from planner_jax.studies.block.flight_fit import (
    FlightFit,
    across_std,
    believed_at,
    error_across,
    fit_flight,
)
from planner_jax.studies.block.noise import Noise, RoundNoise, information, sightings, stereo_noise
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.end_poses import flight_of
from planner_jax.task.block.scene import RIG_HALF, Box


@struct.dataclass
class Eye:
    """A camera in the scene, and how well it sees."""

    camera: Camera
    noise: Noise
    rate: float = struct.field(pytree_node=False)  # [Hz], frames


def mast_camera(size: tuple[int, int] = (1280, 720)) -> Camera:
    """Return a camera 1.6 m above the base, on a mast on the rig's beam behind the arm.

    [Natarajan2024] mounts its camera on the rig's beams, its authors' model in front of the arm,
    where 110 degrees do not take in what is thrown from 60 degrees on either side. From here a
    width of 120 degrees sees the throws of the suites until shortly before the outer box, over the
    arm and, 0.3 m to the left, aslant past the pole. Place and width are assumptions.
    """
    place = np.array([-RIG_HALF, 0.3, 1.6])
    ahead = np.array([1.0, np.tan(np.deg2rad(-1.0)), np.tan(np.deg2rad(-8.0))])
    return looking_at(place, place + ahead, size=size, field_of_view=np.deg2rad(120.0))


def eye(*, rate: float = 60.0, std: float | None = None, camera: Camera | None = None) -> Eye:
    """Return a stereo camera with the noise of `stereo_noise`, by default on the mast.

    Args:
        rate: [Hz], of frames.
        std: [m], of each coordinate instead: round noise.
        camera: in the scene.

    Raises:
        ValueError: a number is not positive; one line.
    """
    if not rate > 0.0:
        raise ArgumentError("rate", "> 0", rate)
    if std is not None and not std > 0.0:
        raise ArgumentError("std", "> 0", std)
    return Eye(
        camera=mast_camera() if camera is None else camera,
        noise=stereo_noise() if std is None else RoundNoise(std=host_leaf(std, np.float32)),
        rate=rate,
    )


def frame_times(eye: Eye, seconds: float) -> np.ndarray:
    """Return times (N,) [s] of the frames until a moment [s], the first at 0."""
    # A frame at that very moment counts, whatever its time rounds to.
    return np.arange(int(np.floor(seconds * eye.rate + 1e-6)) + 1) / eye.rate


def watched(cases: BlockCase, eye: Eye, times: Array, key: Array) -> Array:
    """Return where the balls of a batch of cases are seen at times (N,) [s]; pure.

    Args:
        cases: a batch of B, with the true balls.
        eye: that sees them.
        times: (N,) [s], of frames.
        key: of the noise, or (B,) of them.

    Returns:
        (B, N, 3) [m]; NaN where a ball is not seen.
    """

    def one(ball: BallState, gravity: Array, key: Array) -> Array:
        places = jax.vmap(drag_free_flight, (None, 0, None))(ball, times, gravity).pos
        return sightings(key, eye.camera, eye.noise, places)

    keys = key if key.ndim else jax.random.split(key, cases.batch_shape[0])
    return jax.vmap(one)(cases.ball, cases.gravity, keys)


def fitted(eye: Eye, times: Array, places: Array, gravity: Array, until: Array) -> FlightFit:
    """Return the flight of one ball from where it was seen until a moment; pure.

    Args:
        eye: that saw it.
        times: (N,) [s].
        places: (N, 3) [m].
        gravity: () [m/s^2], magnitude.
        until: () [s]; what was seen later does not count.
    """
    known = jnp.where((times <= until + 1e-4)[:, None], places, jnp.nan)
    return fit_flight(times, known, information(eye.camera, eye.noise, known), gravity)


@struct.dataclass
class SeenThrows:
    """A batch of throws as they are known at some moment."""

    cases: BlockCase  # with the fitted balls; planners get them
    fits: FlightFit  # leaves (B, ...)


def see(
    cases: BlockCase, eye: Eye, seconds: float, *, seed: int = 0, overhead: float = 0.0
) -> SeenThrows:
    """Return a batch of throws after some seconds of flight were seen.

    Plan with the returned cases, made `cautious`. To judge the plans, give the true cases the delay
    of the returned ones, and pass both through `studies.block.contact_check.end_at_contact`. A ball
    that was seen at fewer than two times is NaN, and `fits.status` gives the reason.

    Args:
        cases: a batch of B, with the true balls.
        eye: that sees them.
        seconds: [s], from a case's time 0 until the fit, >= 0.
        seed: of the noise.
        overhead: [s], until the arm may start from then on, >= 0.

    Raises:
        ValueError: a time is negative; one line.
    """
    for name, value in (("seconds", seconds), ("overhead", overhead)):
        if not value >= 0.0:
            raise ArgumentError(name, ">= 0", value)
    times = jnp.asarray(frame_times(eye, seconds), cases.gravity.dtype)
    balls, fits = _seen(cases, eye, times, jax.random.key(seed))
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
    """Return a batch of seen cases as a planner should get it, which takes the ball at its word.

    The ball is to be met near the shield's middle, so that the rest of the shield is left for the
    error of the fit. One that is believed to pass the protected box by may well come into it: for
    it, the box that a planner sees is larger.

    Args:
        cases: a batch with fitted balls.
        offset: [m], greatest distance of the ball from the shield's middle, where the case allows
            more.
        grow: [m], by how much that box is larger on its sides and at its top.
        edge: [m], kept from both ends of the ball's way between the boxes, since it is not where
            it is believed to be along its way either.
        at_rest: whether the arm must stand when it meets the ball, whatever the case says: then it
            does not matter if the ball is late.
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
    """Return errors of fits across the flight midway between the boxes, for the true balls.

    Returns:
        error: (B,) [m].
        std: (B,) [m], what they are believed to be.
    """

    def one(case: BlockCase, fit: FlightFit) -> tuple[Array, Array]:
        flight = flight_of(case)
        middle = 0.5 * (flight.earliest + flight.latest)
        belief = believed_at(fit, middle, case.gravity)
        truth = drag_free_flight(case.ball, middle, case.gravity)
        return error_across(belief, truth), across_std(belief)

    return jax.vmap(one)(cases, fits)


@jax.jit
def _seen(cases: BlockCase, eye: Eye, times: Array, key: Array) -> tuple[BallState, FlightFit]:
    places = watched(cases, eye, times, key)
    fits = jax.vmap(fitted, (None, None, 0, 0, None))(eye, times, places, cases.gravity, times[-1])
    beliefs = jax.vmap(believed_at, (0, None, 0))(fits, jnp.zeros_like(times[0]), cases.gravity)
    return beliefs.ball, fits
