"""A car with front steering: kinematics, limits, body, and plans.

The state is the position of the rear axle's middle, the heading, and the speed [Qu2022, eq. 1]. The
curvature of the rear axle's path is  kappa = tan(delta) / wheelbase  for a steering angle delta.
World frame in the plane, SI units, headings counter-clockwise from the x axis.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.checks import require_values
from planner_jax.core.protocol import Plan
from planner_jax.robot.setpoints import sample_at_rate


@struct.dataclass
class CarLimits:
    """Limits of a car [Qu2022, eq. 8b]; infinity means no limit."""

    speed: Array  # () [m/s], greatest speed
    acceleration: Array  # () [m/s^2], greatest magnitude of the acceleration along the path
    lateral_acceleration: Array  # () [m/s^2], greatest magnitude of speed^2 * curvature
    curvature: Array  # () [1/m], greatest magnitude of the rear axle's curvature
    steering_rate: Array  # () [rad/s], greatest magnitude of the steering angle's rate
    reverse_speed: Array | None = None  # () [m/s], greatest speed in reverse; None: no reverse gear
    # () [m/s^3], greatest magnitude of the longitudinal jerk. The acceleration is constant between
    # two knots of a plan. The jerk is its change at a knot, divided by the time between two knots.
    jerk: Array | None = None

    @property
    def least_speed(self) -> Array:
        """Least speed, () [m/s]: negative if the car may drive in reverse, else 0."""
        reverse = self.reverse_speed
        return jnp.zeros_like(self.speed) if reverse is None else -reverse


@struct.dataclass
class CarBody:
    """The body of a car: a rectangle that is fixed to the rear axle."""

    length: Array  # () [m], of the rectangle
    width: Array  # () [m], of the rectangle
    wheelbase: Array  # () [m], distance between the axles
    rear_overhang: Array  # () [m], distance of the rear end behind the rear axle

    @property
    def middle(self) -> Array:
        """Distance of the rectangle's middle ahead of the rear axle, () [m]."""
        return 0.5 * self.length - self.rear_overhang

    def middle_at(self, pose: Array) -> Array:
        """Return the position (2,) [m] of the rectangle's middle at a pose (3,) of the rear axle.

        A pose has x [m], y [m] and the heading [rad].
        """
        return pose[:2] + self.middle * jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])


@dataclasses.dataclass(frozen=True)
class CarSetpoints:
    """Samples of a car's plan at K equally spaced times.

    In a batch every array but `time` has a leading axis B. Entries after a plan's end are NaN.
    """

    time: np.ndarray  # (K,) [s] since the start of the plan
    pos: np.ndarray  # (K, 2) [m], middle of the rear axle
    heading: np.ndarray  # (K,) [rad]
    speed: np.ndarray  # (K,) [m/s], negative in reverse
    acceleration: np.ndarray  # (K,) [m/s^2], along the path
    curvature: np.ndarray  # (K,) [1/m]
    yaw_rate: np.ndarray  # (K,) [rad/s]


@struct.dataclass
class CarPlan(Plan):
    """A plan of a car: speed and curvature are linear in time between K + 1 equidistant knots.

    Attributes:
        start: (3,) x [m], y [m] of the rear axle's middle and heading [rad] at time 0.
        time: () [s], end of the plan.
        speed: (K + 1,) [m/s], speed at the knots, the first at time 0, the last at `time`; negative
            in reverse.
        curvature: (K + 1,) [1/m], curvature at the knots.
        origin: (2,) [m], world position to which `start` is relative.
    """

    start: Array
    time: Array
    speed: Array
    curvature: Array
    origin: Array

    def sample(self, rate: float) -> CarSetpoints:
        """Sample the plan, or the batch of plans, `rate` times a second from start to end.

        Positions are in the world frame, in float64.

        Raises:
            ValueError: the rate is not positive.
        """
        require_values("sample", self)
        leaves = (self.start, self.time, self.speed, self.curvature)
        samples = sample_at_rate(rate, self.time, leaves, _setpoint_at)
        origin = np.asarray(self.origin, np.float64)[..., None, :]
        return CarSetpoints(**{**samples, "pos": samples["pos"] + origin})


# Nodes and weights of Gauss-Legendre quadrature on (0, 1), exact for polynomials of degree 9.
_NODES = np.polynomial.legendre.leggauss(5)
_NODE, _WEIGHT = 0.5 * (_NODES[0] + 1.0), 0.5 * _NODES[1]


def pose_at(start: Array, end: Array, speed: Array, curvature: Array, time: Array) -> Array:
    """Return the pose (3,) of the rear axle's middle at a time () [s] of a plan.

    The plan starts at the pose `start` (3,): x [m], y [m] and heading [rad]. Speed and curvature
    are the values at K + 1 equidistant knots from time 0 to `end` () [s].
    """
    num = speed.shape[0] - 1
    step = end / num
    # `length` (K,) [s] is the time that the car has spent on each of the K pieces until `time`.
    length = jnp.clip(time - step * jnp.arange(num, dtype=speed.dtype), 0.0, step)
    rise = (speed[1:] - speed[:-1]) / step
    bend = (curvature[1:] - curvature[:-1]) / step
    v, c = speed[:-1], curvature[:-1]

    def turn(tau: Array) -> Array:
        return tau * (v * c + tau * ((v * bend + rise * c) / 2.0 + tau * rise * bend / 3.0))

    whole = turn(length)
    heading = start[2] + jnp.cumsum(whole) - whole
    tau = length[:, None] * jnp.asarray(_NODE, speed.dtype)[None]
    angle = heading[:, None] + jax.vmap(turn, in_axes=1, out_axes=1)(tau)
    weights = jnp.asarray(_WEIGHT, speed.dtype)[None]
    moved = (v[:, None] + rise[:, None] * tau) * length[:, None] * weights
    x, y = jnp.sum(moved * jnp.cos(angle)), jnp.sum(moved * jnp.sin(angle))
    return start + jnp.stack([x, y, jnp.sum(whole)])


def knots_at(end: Array, speed: Array, curvature: Array, time: Array) -> tuple[Array, Array, Array]:
    """Return speed, curvature, acceleration at a time () [s], from values at equal time steps."""
    num = speed.shape[0] - 1
    position = jnp.clip(time / end * num, 0.0, num)
    k = jnp.clip(position.astype(jnp.int32), 0, num - 1)
    share = position - k.astype(position.dtype)
    v = (1.0 - share) * speed[k] + share * speed[k + 1]
    c = (1.0 - share) * curvature[k] + share * curvature[k + 1]
    return v, c, (speed[k + 1] - speed[k]) * num / end


def _setpoint_at(leaves: tuple[Array, Array, Array, Array], time: Array) -> dict[str, Array]:
    start, end, speed, curvature = leaves
    pose = pose_at(start, end, speed, curvature, time)
    v, c, acceleration = knots_at(end, speed, curvature, time)
    return {
        "pos": pose[:2],
        "heading": pose[2],
        "speed": v,
        "acceleration": acceleration,
        "curvature": c,
        "yaw_rate": v * c,
    }
