"""A quadrotor: limits, differential flatness [Yu2023bat, eq. 1], bounds on reach, and plans.

The body z axis is along the net thrust  tau = a + g e_3  (per unit mass). At zero heading, the Hopf
fibration determines the body rate by tau and the jerk alone [Watterson2020].
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.arithmetic import Components, at_least, components, inverse_sqrt, reciprocal
from planner_jax.core.protocol import Plan
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, join

# Factor on limits in bounds on reach. Solved plans exceed their limits by far less, so that the
# bounds hold for plans whose peaks lie between the samples of a check.
ALLOWED = 1.01
_SHORTEST = 1e-3  # [s]; prevents the product of an infinite limit and zero


@struct.dataclass
class RotorLimits:
    """Bounds of thrust of the rotors, and the body that they carry."""

    mass: Array  # () [kg]
    inertia: Array  # (3,) [kg m^2], principal, about the body's axes
    mixer: Array  # (4, 4), from total thrust [N] and torque [N m] to the rotors' thrusts [N]
    min_thrust: Array  # () [N], of one rotor
    max_thrust: Array  # () [N], of one rotor


@struct.dataclass
class QuadrotorLimits:
    """Limits of a quadrotor; None means no limit.

    New numbers reuse a compiled program; a number in the place of None does not.
    """

    speed: Array  # () [m/s]
    body_rate: Array  # () [rad/s], with the yaw part of the Hopf fibration
    min_height: Array  # () [m], of the propeller plane
    acceleration: Array | None = None  # () [m/s^2]
    min_thrust: Array | None = None  # () [m/s^2], per unit mass; None if `max_thrust` is None
    max_thrust: Array | None = None  # () [m/s^2], per unit mass
    rotors: RotorLimits | None = None

    @property
    def thrust_bounds(self) -> tuple[Array, Array]:
        """Least and greatest thrust [m/s^2]; zero and infinity without limits."""
        none = jnp.zeros_like(self.speed)
        least = none if self.min_thrust is None else self.min_thrust
        return least, none + jnp.inf if self.max_thrust is None else self.max_thrust

    def scale(self, factor: float, gravity: Array) -> "QuadrotorLimits":
        """Return limits with speed, acceleration, body rate and thrust scaled by a factor.

        Of the thrust, the difference from `gravity` is scaled.
        """
        limits = {"speed": factor * self.speed, "body_rate": factor * self.body_rate}
        if self.acceleration is not None:
            limits["acceleration"] = factor * self.acceleration
        if self.min_thrust is not None and self.max_thrust is not None:
            least = jnp.maximum(gravity + factor * (self.min_thrust - gravity), 0.0)
            limits["min_thrust"] = least
            limits["max_thrust"] = gravity + factor * (self.max_thrust - gravity)
        return dataclasses.replace(self, **limits)


def net_thrust(acc: Array, gravity: Array) -> Array:
    """Return the thrust per unit mass  a + g e_3  [m/s^2], (..., 3)."""
    return acc + jnp.broadcast_to(gravity * jnp.array([0.0, 0.0, 1.0], acc.dtype), acc.shape)


def body_z(acc: Array, gravity: Array) -> Array:
    """Return the unit vector along the net thrust, (..., 3); zero without thrust."""
    thrust = net_thrust(acc, gravity)
    square = jnp.sum(thrust**2, axis=-1, keepdims=True)
    has_thrust = square > 0.0
    return jnp.where(has_thrust, thrust / jnp.sqrt(jnp.where(has_thrust, square, 1.0)), 0.0)


def body_rate_squared(acc: Components, jerk: Components, gravity: Array) -> Array:
    """Return the squared body rate  |omega|^2  of the Hopf fibration at zero heading [rad^2/s^2].

    |omega|^2 = |z'|^2 + ((z_y z_x' - z_x z_y') / (1 + z_z))^2 , where z' is the component of the
    jerk perpendicular to the thrust, over the magnitude of the thrust. The computation has no
    square root of the result, so that its gradient is finite wherever the value is.

    Args:
        acc: (..., 3) [m/s^2].
        jerk: (..., 3) [m/s^3].
        gravity: () [m/s^2].

    Returns:
        (...,). Near free fall (no thrust) and upside down, where the attitude is undefined, the
        value is large but finite.
    """
    # By components, and each reciprocal once: sums over an axis of three and divisions cost a CPU
    # most of a plan's time.
    tx, ty, az = components(acc)
    tz = az + gravity
    jx, jy, jz = components(jerk)
    size_squared = at_least(tx * tx + ty * ty + tz * tz, 1e-4)
    inverse_size = inverse_sqrt(size_squared)
    inverse_squared = inverse_size * inverse_size
    along = tx * jx + ty * jy + tz * jz
    tilt_squared = (jx * jx + jy * jy + jz * jz - along * along * inverse_squared) * inverse_squared
    # z_y z_x' - z_x z_y' = (tau_y j_x - tau_x j_y) / |tau|^2 : the jerk along tau cancels.
    twist = (ty * jx - tx * jy) * inverse_size
    twist = twist * reciprocal(at_least(size_squared * inverse_size + tz, 1e-2))
    return tilt_squared + twist * twist


def body_rate(acc: Components, jerk: Components, gravity: Array) -> tuple[Array, Array, Array]:
    """Return the components (...) of the body rate [rad/s] of the Hopf fibration, body frame.

    See `body_rate_squared` for the arguments.
    """
    tx, ty, az = components(acc)
    tz = az + gravity
    jx, jy, jz = components(jerk)
    inverse_size = inverse_sqrt(at_least(tx * tx + ty * ty + tz * tz, 1e-4))
    x, y, z = tx * inverse_size, ty * inverse_size, tz * inverse_size
    along = x * jx + y * jy + z * jz
    dx, dy, dz = ((j - along * n) * inverse_size for j, n in ((jx, x), (jy, y), (jz, z)))
    k = reciprocal(at_least(1.0 + z, 1e-2))
    # The body's x axis is (1 - k x^2, -k x y, -x), the y axis (-k x y, 1 - k y^2, -y).
    sway = k * (x * dx + y * dy)
    return -(dy - y * sway - y * dz), dx - x * sway - x * dz, (y * dx - x * dy) * k


def rotor_thrusts(
    acc: Components, jerk: Components, snap: Components, gravity: Array, rotors: RotorLimits
) -> tuple[Array, ...]:
    """Return the thrusts (...) [N] of the four rotors in a motion at zero heading.

    The snap is (..., 3) [m/s^4]; see `body_rate_squared` for the other arguments.
    """
    a, j, s = (tuple(components(each)) for each in (acc, jerk, snap))
    rate, turning = jax.jvp(lambda acc, jerk: body_rate(acc, jerk, gravity), (a, j), (j, s))
    x, y, z = a
    thrust = rotors.mass * jnp.sqrt(at_least(x * x + y * y + (z + gravity) ** 2, 1e-4))
    about_x, about_y, about_z = (rotors.inertia[..., k] for k in range(3))
    roll = about_x * turning[0] + (about_z - about_y) * rate[1] * rate[2]
    pitch = about_y * turning[1] + (about_x - about_z) * rate[2] * rate[0]
    yaw = about_z * turning[2] + (about_y - about_x) * rate[0] * rate[1]
    rows = (rotors.mixer[..., i, :] for i in range(4))
    return tuple(
        row[..., 0] * thrust + row[..., 1] * roll + row[..., 2] * pitch + row[..., 3] * yaw
        for row in rows
    )


def tangent_basis(normal: Array) -> tuple[Array, Array]:
    """Return the body x and y axes (3,) of the Hopf fibration at zero heading for a z axis (3,).

    They are smooth in the z axis, except straight down.
    """
    x, y, z = components(normal)
    k = reciprocal(at_least(1.0 + z, 1e-6))
    return (
        jnp.stack([1.0 - k * x * x, -k * x * y, -x]),
        jnp.stack([-k * x * y, 1.0 - k * y * y, -y]),
    )


def flat_attitude(acc: Array, jerk: Array, gravity: Array) -> tuple[Array, Array]:
    """Return the rotation (3, 3), body to world, and body rate (3,) [rad/s] at zero heading.

    The Hopf fibration determines them by acceleration (3,) [m/s^2] and jerk (3,) [m/s^3].
    """
    z = body_z(acc, gravity)
    size = jnp.sqrt(jnp.maximum(jnp.sum(net_thrust(acc, gravity) ** 2), 1e-2))
    z_dot = (jerk - jnp.sum(jerk * z) * z) / size
    x, y = tangent_basis(z)
    twist = (z[1] * z_dot[0] - z[0] * z_dot[1]) / jnp.maximum(1.0 + z[2], 1e-2)
    rate = jnp.stack([-jnp.sum(y * z_dot), jnp.sum(x * z_dot), twist])
    return jnp.stack([x, y, z], axis=1), rate


def tilt_quaternion(normal: Array) -> Array:
    """Return the attitude (4,) w x y z of the Hopf fibration at zero heading for a z axis (3,).

    It is the shortest rotation from upright: (1 + z, -y, x, 0) / sqrt(2 (1 + z)).
    """
    x, y, z = components(normal)
    w = jnp.sqrt(0.5 * at_least(1.0 + z, 1e-6))
    return jnp.stack([w, -0.5 * y / w, 0.5 * x / w, jnp.zeros_like(w)])


def greatest_speed(head_state: Array, limits: QuadrotorLimits) -> Array:
    """Return the bound () [m/s] on the speed from a state (4, 3): the limit or the first speed."""
    first = jnp.sqrt(jnp.sum(head_state[1] * head_state[1]))
    return jnp.maximum(ALLOWED * limits.speed, first)


def beyond_reach(
    positions: Array, times: Array, head_state: Array, limits: QuadrotorLimits, gravity: Array
) -> Array:
    """Return lower bounds (K,) [m] on a quadrotor's distances from positions at given times.

    Zero or less means that the position may be reached. At the time t the quadrotor is in each of

    - the ball around the start whose radius is the integral of the greatest speed, which rises
      with the greatest acceleration A up to its limit,
    - the ball of radius A t^2 / 2 around the position that the first velocity alone leads to,
    - the ball of radius T t^2 / 2 around the position in free fall, with the greatest thrust T,

    where such limits exist: the mean of accelerations lies in every ball that contains all of them.

    Args:
        positions: (K, 3) [m], one for each time.
        times: (K,) [s], >= 0.
        head_state: (4, 3), state of the quadrotor at time 0.
        limits: limits of the quadrotor.
        gravity: () [m/s^2], magnitude.
    """
    start, vel = head_state[0], head_state[1]
    x, y, z = (each - start[k] for k, each in enumerate(components(positions)))
    half_square = 0.5 * jnp.maximum(times, _SHORTEST) ** 2
    thrust = _greatest_thrust(limits)
    acceleration = _greatest_acceleration(limits, thrust, gravity)
    first, most = jnp.sqrt(jnp.sum(vel * vel)), greatest_speed(head_state, limits)
    if acceleration is None:
        return _length(x, y, z) - most * times
    rise = (most - first) / acceleration
    rising = first * times + acceleration * half_square
    reached = jnp.where(times < rise, rising, most * times - 0.5 * (most - first) * rise)
    beyond = _length(x, y, z) - reached
    x, y, z = x - vel[0] * times, y - vel[1] * times, z - vel[2] * times
    beyond = jnp.maximum(beyond, _length(x, y, z) - acceleration * half_square)
    if thrust is None:
        return beyond
    return jnp.maximum(beyond, _length(x, y, z + gravity * half_square) - thrust * half_square)


def _greatest_thrust(limits: QuadrotorLimits) -> Array | None:
    """Return the greatest total thrust per unit mass, () [m/s^2]; None without a limit."""
    bounds = [] if limits.max_thrust is None else [limits.max_thrust]
    if limits.rotors is not None:
        bounds.append(4.0 * limits.rotors.max_thrust / limits.rotors.mass)
    return ALLOWED * jnp.min(jnp.stack(bounds)) if bounds else None


def _greatest_acceleration(
    limits: QuadrotorLimits, thrust: Array | None, gravity: Array
) -> Array | None:
    """Return the greatest acceleration, () [m/s^2]; None without a limit."""
    bounds = [] if limits.acceleration is None else [ALLOWED * limits.acceleration]
    if thrust is not None:
        bounds.append(thrust + gravity)
    return jnp.min(jnp.stack(bounds)) if bounds else None


def _length(x: Array, y: Array, z: Array) -> Array:
    return jnp.sqrt(x * x + y * y + z * z)


@dataclasses.dataclass(frozen=True)
class QuadrotorSetpoints:
    """Samples of a plan at K equally spaced times; world frame, z up; body x forward, z up.

    In a batch every array but `time` has a leading axis B, and is NaN past the end of each plan.
    """

    time: np.ndarray  # (K,) [s] since the start of the plan
    pos: np.ndarray  # (K, 3) [m], centre of the propeller plane
    vel: np.ndarray  # (K, 3) [m/s]
    acc: np.ndarray  # (K, 3) [m/s^2]
    jerk: np.ndarray  # (K, 3) [m/s^3]
    quat_wxyz: np.ndarray  # (K, 4), body to world, at zero heading of the Hopf fibration
    body_rate: np.ndarray  # (K, 3) [rad/s], body frame
    thrust: np.ndarray  # (K,) [m/s^2], per unit mass


@struct.dataclass
class QuadrotorPlan(Plan):
    """A plan with the trajectory of the centre of a quadrotor's propeller plane."""

    trajectory: PiecewisePolynomial  # up to the last contact
    gravity: Array  # () [m/s^2], magnitude
    # From the last contact to standstill; None if it was not requested.
    recovery: PiecewisePolynomial | None = struct.field(default=None, kw_only=True)

    @property
    def whole(self) -> PiecewisePolynomial:
        """The trajectory and the recovery in one, of a plan or of a batch."""
        return self.trajectory if self.recovery is None else join(self.trajectory, self.recovery)

    def sample(self, rate: float) -> QuadrotorSetpoints:
        """Sample the plan, or the batch, at a rate [Hz] up to its end, `recovery` included.

        Raises:
            ValueError: the rate is not positive.
        """
        from planner_jax.robot.setpoints import sample_at_rate  # few plans are sampled

        path = jax.tree.map(np.asarray, self.whole)
        ends = np.sum(path.durations, axis=-1)
        return QuadrotorSetpoints(**sample_at_rate(rate, ends, (path, self.gravity), setpoint_at))


def setpoint_at(leaves: tuple[PiecewisePolynomial, Array], time: Array) -> dict[str, Array]:
    """Return the fields of `QuadrotorSetpoints`, except `time`, of one plan at a time () [s].

    The leaves are the trajectory and gravity.
    """
    path, gravity = leaves
    pos, vel, acc, jerk = (evaluate(path, time, order) for order in range(4))
    return {
        "pos": pos,
        "vel": vel,
        "acc": acc,
        "jerk": jerk,
        "quat_wxyz": tilt_quaternion(body_z(acc, gravity)),
        "body_rate": flat_attitude(acc, jerk, gravity)[1],
        "thrust": jnp.sqrt(jnp.sum(net_thrust(acc, gravity) ** 2)),
    }
