"""Camera observations of throws, and the cases that planners get from them.

A ball is first seen at a case's time 0, then in every frame. The observations until some moment are
fitted. Planners get a case with the fitted ball, the referee gets the true ball. Robot base frame,
z up, SI units.
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
from planner_jax.studies.block.camera import Camera, looking_at
from planner_jax.studies.block.flight_fit import (
    FlightFit,
    across_std,
    belief_at,
    error_across,
    fit_flight,
)
from planner_jax.studies.block.noise import (
    IsotropicNoise,
    Noise,
    information,
    sightings,
    stereo_noise,
)
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.end_poses import flight_of
from planner_jax.task.block.scene import RIG_HALF, Box


@struct.dataclass
class Eye:
    """A camera in the scene, its noise and its frame rate."""

    camera: Camera
    noise: Noise
    rate: float = struct.field(pytree_node=False)  # [Hz], frames


def mast_camera(size: tuple[int, int] = (1280, 720)) -> Camera:
    """Return a camera 1.6 m above the base, on a mast on the rig's beam behind the arm.

    [Natarajan2024] mounts its camera on the rig's beams, its authors' model in front of the arm,
    from where 110 degrees do not cover throws from 60 degrees to either side. From the mast 120
    degrees cover the throws of the suites until shortly before the outer box, over the arm and, 0.3
    m to the left, past the pole. Position and field of view are assumptions.
    """
    place = np.array([-RIG_HALF, 0.3, 1.6])
    ahead = np.array([1.0, np.tan(np.deg2rad(-1.0)), np.tan(np.deg2rad(-8.0))])
    return looking_at(place, place + ahead, size=size, field_of_view=np.deg2rad(120.0))


def eye(*, rate: float = 60.0, std: float | None = None, camera: Camera | None = None) -> Eye:
    """Return a stereo camera with the noise of `stereo_noise`, by default on the mast.

    Args:
        rate: [Hz], of frames.
        std: [m], standard deviation of each coordinate, for isotropic noise instead.
        camera: in the scene.

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
    """Return the times (N,) [s] of the frames until a moment [s], the first at 0."""
    # A frame at the moment itself counts despite rounding.
    return np.arange(int(np.floor(seconds * eye.rate + 1e-6)) + 1) / eye.rate


@jax.jit
def watch(cases: BlockCase, eye: Eye, times: Array, key: Array) -> Array:
    """Return the observed positions of a batch of balls at times (N,) [s]; pure.

    Args:
        cases: a batch of B, with the true balls.
        eye: the camera.
        times: (N,) [s], of frames.
        key: of the noise, or one key per case, (B,).

    Returns:
        (B, N, 3) [m]; NaN if a ball is not seen.
    """

    def one(ball: BallState, gravity: Array, key: Array) -> Array:
        places = jax.vmap(drag_free_flight, (None, 0, None))(ball, times, gravity).pos
        return sightings(key, eye.camera, eye.noise, places)

    keys = key if key.ndim else jax.random.split(key, cases.batch_shape[0])
    return jax.vmap(one)(cases.ball, cases.gravity, keys)


def fit_until(eye: Eye, times: Array, places: Array, gravity: Array, until: Array) -> FlightFit:
    """Fit the flight of one ball to its observations until a moment; pure.

    Args:
        eye: the camera of the observations.
        times: (N,) [s].
        places: (N, 3) [m].
        gravity: () [m/s^2], magnitude.
        until: () [s]; later observations are ignored.
    """
    known = jnp.where((times <= until + 1e-4)[:, None], places, jnp.nan)
    return fit_flight(times, known, information(eye.camera, eye.noise, known), gravity)


@jax.jit
def fit_throws(
    cases: BlockCase, eye: Eye, times: Array, places: Array, moment: Array
) -> tuple[BallState, FlightFit]:
    """Return balls at time 0 and fits of a batch, from the observations until a moment."""
    fits = jax.vmap(fit_until, (None, None, 0, 0, None))(eye, times, places, cases.gravity, moment)
    start = jnp.zeros((), times.dtype)
    return jax.vmap(belief_at, (0, None, 0))(fits, start, cases.gravity).ball, fits


@struct.dataclass
class SeenThrows:
    """A batch of throws as estimated at some moment."""

    cases: BlockCase  # with the fitted balls; planners get them
    fits: FlightFit  # leaves (B, ...)


def see(
    cases: BlockCase, eye: Eye, seconds: float, *, seed: int = 0, overhead: float = 0.0
) -> SeenThrows:
    """Return a batch of throws as estimated after some seconds of flight.

    Plan with the returned cases, made `cautious`. To judge the plans, set the delay of the true
    cases to the returned delay, and pass cases and plans through
    `studies.block.contact_check.end_at_contact`. A ball that was seen at fewer than two times is
    NaN, and `fits.status` gives the reason.

    Args:
        cases: a batch of B, with the true balls.
        eye: the camera.
        seconds: [s], from a case's time 0 until the fit, >= 0.
        seed: of the noise.
        overhead: [s], from the fit until the arm may start, >= 0.

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
    """Return a batch of observed cases with reserves for the error of the fit, for a planner.

    A planner takes the fitted ball as exact. Contact near the shield's centre leaves the rest of
    the shield for the error of the fit. A ball that is estimated to miss the protected box may
    still hit it: for such a ball the box is enlarged.

    Args:
        cases: a batch with fitted balls.
        offset: [m], greatest distance of the contact from the shield's centre, unless the case has
            less.
        grow: [m], enlargement of that box on its sides and at its top.
        edge: [m], distance from both ends of the ball's trajectory between the boxes, a reserve for
            the error along the trajectory.
        at_rest: whether the arm must be at rest at the contact even if the case does not require
            it; then a late ball is blocked too.
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
    """Return errors of fits normal to the flight, midway between the boxes of the true balls.

    Returns:
        error: (B,) [m].
        std: (B,) [m], their estimated standard deviations.
    """

    def one(case: BlockCase, fit: FlightFit) -> tuple[Array, Array]:
        flight = flight_of(case)
        middle = 0.5 * (flight.earliest + flight.latest)
        belief = belief_at(fit, middle, case.gravity)
        truth = drag_free_flight(case.ball, middle, case.gravity)
        return error_across(belief, truth), across_std(belief)

    return jax.vmap(one)(cases, fits)
