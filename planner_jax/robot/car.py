"""A car with front steering: kinematics, limits, body, and plans.

The state is [Qu2022, eq. 1]: middle of the rear axle, heading, and speed. The curvature of the rear
axle's path is  kappa = tan(delta) / wheelbase  for a steering angle delta. World frame in the
plane, SI units, headings counter-clockwise from the x axis.
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
    """Limits of a car; infinity means no limit."""

    speed: Array  # () [m/s]; the car does not reverse
    acceleration: Array  # () [m/s^2], along the path, of either sign
    lateral_acceleration: Array  # () [m/s^2], speed^2 * curvature of the rear axle
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
        """Distance of the rectangle's middle ahead of the rear axle, () [m]."""
        return 0.5 * self.length - self.rear_overhang


@dataclasses.dataclass(frozen=True)
class CarSetpoints:
    """Samples of a plan at K equally spaced times.

    In a batch every array but `time` has a leading axis B, and is NaN past the end of each plan.
    """

    time: np.ndarray  # (K,) [s] since the start of the plan
    pos: np.ndarray  # (K, 2) [m], middle of the rear axle
    heading: np.ndarray  # (K,) [rad]
    speed: np.ndarray  # (K,) [m/s]
    acceleration: np.ndarray  # (K,) [m/s^2], along the path
    curvature: np.ndarray  # (K,) [1/m]
    yaw_rate: np.ndarray  # (K,) [rad/s]


@struct.dataclass
class CarPlan(Plan):
    """A plan of a car: speed and curvature are linear in time between K + 1 equidistant knots."""

    start: Array  # (3,) x [m], y [m] of the rear axle's middle and heading [rad] at time 0
    time: Array  # () [s], end of the plan
    speed: Array  # (K + 1,) [m/s], at the knots, the first at time 0, the last at `time`
    curvature: Array  # (K + 1,) [1/m], at the knots

    def sample(self, rate: float) -> CarSetpoints:
        """Sample the plan, or the batch, at a rate [Hz] from start to end.

        Raises:
            ValueError: the rate is not positive.
        """
        leaves = (self.start, self.time, self.speed, self.curvature)
        return CarSetpoints(**sample_at_rate(rate, self.time, leaves, _setpoint_at))


# Gauss-Legendre nodes and weights on (0, 1), exact to order 9.
_NODES = np.polynomial.legendre.leggauss(5)
_NODE, _WEIGHT = 0.5 * (_NODES[0] + 1.0), 0.5 * _NODES[1]


def pose_at(start: Array, end: Array, speed: Array, curvature: Array, time: Array) -> Array:
    """Return the rear axle's pose (3,) at a time () [s] of a plan with K + 1 knots up to `end` [s].

    `start` (3,) is the pose at time 0.
    """
    num = speed.shape[0] - 1
    step = end / num
    # Time driven in each piece
    length = jnp.clip(time - step * jnp.arange(num, dtype=speed.dtype), 0.0, step)
    rise = (speed[1:] - speed[:-1]) / step
    bend = (curvature[1:] - curvature[:-1]) / step
    v, c = speed[:-1], curvature[:-1]

    def turn(tau: Array) -> Array:
        """Return the angle turned in each piece until a time `tau` since its start."""
        return tau * (v * c + tau * ((v * bend + rise * c) / 2.0 + tau * rise * bend / 3.0))

    whole = turn(length)
    heading = start[2] + jnp.cumsum(whole) - whole
    tau = length[:, None] * jnp.asarray(_NODE, speed.dtype)[None]
    angle = heading[:, None] + jax.vmap(turn, in_axes=1, out_axes=1)(tau)
    moved = (
        (v[:, None] + rise[:, None] * tau)
        * length[:, None]
        * jnp.asarray(_WEIGHT, speed.dtype)[None]
    )
    x, y = jnp.sum(moved * jnp.cos(angle)), jnp.sum(moved * jnp.sin(angle))
    return start + jnp.stack([x, y, jnp.sum(whole)])


def knots_at(end: Array, speed: Array, curvature: Array, time: Array) -> tuple[Array, Array, Array]:
    """Return speed [m/s], curvature [1/m] and acceleration [m/s^2] at a time () [s]."""
    num = speed.shape[0] - 1
    position = jnp.clip(time / end * num, 0.0, num)
    k = jnp.clip(position.astype(jnp.int32), 0, num - 1)
    share = position - k.astype(position.dtype)
    v = (1.0 - share) * speed[k] + share * speed[k + 1]
    c = (1.0 - share) * curvature[k] + share * curvature[k + 1]
    return v, c, (speed[k + 1] - speed[k]) * num / end


def _setpoint_at(leaves: tuple[Array, Array, Array, Array], time: Array) -> dict[str, Array]:
    """Return the setpoint of one plan at a time () [s]; leaves are start, end and knots."""
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
