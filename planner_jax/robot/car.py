"""A car with front steering: kinematics, limits, body, and plans that it drives.

Its state is that of [Qu2022, eq. 1]: the middle of the rear axle, the heading, the speed, and
for the steering angle delta the curvature kappa = tan(delta) / wheelbase of the way that the rear
axle takes. World frame in the plane, SI units, headings counter-clockwise from the x axis.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.protocol import Plan
from planner_jax.robot.setpoints import sample_at_rate


@struct.dataclass
class CarLimits:
    """What the car may not exceed; an infinite limit is none."""

    speed: Array  # () [m/s]; it does not reverse
    acceleration: Array  # () [m/s^2], along the way, either sign
    lateral_acceleration: Array  # () [m/s^2], of the rear axle: speed^2 * curvature
    curvature: Array  # () [1/m]
    steering_rate: Array  # () [rad/s], of the steering angle


@struct.dataclass
class CarBody:
    """A rectangle around the rear axle."""

    length: Array  # () [m]
    width: Array  # () [m]
    wheelbase: Array  # () [m]
    rear_overhang: Array  # () [m], from the rear axle to the rear end

    @property
    def middle(self) -> Array:
        """How far the rectangle's middle is ahead of the rear axle, () [m]."""
        return 0.5 * self.length - self.rear_overhang


@dataclasses.dataclass(frozen=True)
class CarSetpoints:
    """A plan at K equally spaced times; of a batch every array but `time` has a leading axis B.

    Entries past the end of a plan are NaN.
    """

    time: np.ndarray  # (K,) [s] since the plan began
    pos: np.ndarray  # (K, 2) [m], of the rear axle's middle
    heading: np.ndarray  # (K,) [rad]
    speed: np.ndarray  # (K,) [m/s]
    acceleration: np.ndarray  # (K,) [m/s^2], along the way
    curvature: np.ndarray  # (K,) [1/m]
    yaw_rate: np.ndarray  # (K,) [rad/s]


@struct.dataclass
class CarPlan(Plan):
    """A plan that a car drives: speed and curvature change evenly between K + 1 equal knots."""

    start: Array  # (3,) x [m], y [m] of the rear axle's middle and heading [rad] at time 0
    time: Array  # () [s], until when
    speed: Array  # (K + 1,) [m/s], at the knots, the first at time 0, the last at `time`
    curvature: Array  # (K + 1,) [1/m], at the knots

    def sample(self, rate: float) -> CarSetpoints:
        """Return the plan, or the batch, at a rate [Hz], from its beginning up to its end.

        Raises:
            ValueError: the rate is not positive.
        """
        leaves = (self.start, self.time, self.speed, self.curvature)
        return CarSetpoints(**sample_at_rate(rate, self.time, leaves, _setpoint_at))


# Gauss-Legendre nodes and weights on (0, 1), exact to order 9.
_NODES = np.polynomial.legendre.leggauss(5)
_NODE, _WEIGHT = 0.5 * (_NODES[0] + 1.0), 0.5 * _NODES[1]


def pose_at(start: Array, end: Array, speed: Array, curvature: Array, time: Array) -> Array:
    """Return the rear axle's pose (3,) at a time () of a plan with knots (K + 1,)."""
    num = speed.shape[0] - 1
    step = end / num
    length = jnp.clip(time - step * jnp.arange(num), 0.0, step)  # of every piece that is driven
    rise = (speed[1:] - speed[:-1]) / step
    bend = (curvature[1:] - curvature[:-1]) / step
    v, c = speed[:-1], curvature[:-1]

    def turned(tau: Array) -> Array:
        """Return angle turned since the beginning of a piece."""
        return tau * (v * c + tau * ((v * bend + rise * c) / 2.0 + tau * rise * bend / 3.0))

    whole = turned(length)
    heading = start[2] + jnp.cumsum(whole) - whole
    tau = length[:, None] * jnp.asarray(_NODE, speed.dtype)
    angle = heading[:, None] + jax.vmap(turned, in_axes=1, out_axes=1)(tau)
    moved = (v[:, None] + rise[:, None] * tau) * length[:, None] * jnp.asarray(_WEIGHT, speed.dtype)
    x, y = jnp.sum(moved * jnp.cos(angle)), jnp.sum(moved * jnp.sin(angle))
    return start + jnp.stack([x, y, jnp.sum(whole)])


def knots_at(end: Array, speed: Array, curvature: Array, time: Array) -> tuple[Array, Array, Array]:
    """Return speed [m/s], curvature [1/m] and acceleration [m/s^2] at a time ()."""
    num = speed.shape[0] - 1
    place = jnp.clip(time / end * num, 0.0, num)
    k = jnp.clip(place.astype(jnp.int32), 0, num - 1)
    share = place - k
    v = (1.0 - share) * speed[k] + share * speed[k + 1]
    c = (1.0 - share) * curvature[k] + share * curvature[k + 1]
    return v, c, (speed[k + 1] - speed[k]) * num / end


def _setpoint_at(leaves: tuple[Array, Array, Array, Array], time: Array) -> dict[str, Array]:
    """Return one setpoint of one plan's start, end and knots at a time () [s]."""
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
