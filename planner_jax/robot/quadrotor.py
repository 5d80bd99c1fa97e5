"""A quadrotor: limits, differential flatness [Yu2023bat, eq. 1], bounds on reach, and plans.

The body z axis follows the net thrust  tau = a + g e_3  (per unit mass). With the heading
held at zero, the Hopf fibration gives the body rates from tau and the jerk alone [Watterson2020].
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

# By how much limits may be exceeded here, far more than in any plan that is solved: how closely
# peaks are looked at must not matter to a bound.
ALLOWED = 1.01
_SHORTEST = 1e-3  # [s], so that a limit which is infinite is not multiplied by zero


@struct.dataclass
class RotorLimits:
    """What every rotor can do, and what it has to carry."""

    mass: Array  # () [kg]
    inertia: Array  # (3,) [kg m^2], principal, about the body's axes
    mixer: Array  # (4, 4), from total thrust [N] and torque [N m] to the rotors' thrusts [N]
    min_thrust: Array  # () [N], of a rotor
    max_thrust: Array  # () [N], of a rotor


@struct.dataclass
class QuadrotorLimits:
    """What the quadrotor may not exceed; there is no limit where None stands.

    Another number compiles nothing anew, one in the place of None does.
    """

    speed: Array  # () [m/s]
    body_rate: Array  # () [rad/s], with the yaw part of the Hopf fibration
    min_height: Array  # () [m], of the propeller plane
    acceleration: Array | None = None  # () [m/s^2]
    min_thrust: Array | None = None  # () [m/s^2], per unit mass; there if `max_thrust` is
    max_thrust: Array | None = None  # () [m/s^2], per unit mass
    rotors: RotorLimits | None = None

    @property
    def thrust_bounds(self) -> tuple[Array, Array]:
        """Least and greatest thrust [m/s^2]; zero and infinite where there is no limit."""
        none = jnp.zeros_like(self.speed)
        least = none if self.min_thrust is None else self.min_thrust
        return least, none + jnp.inf if self.max_thrust is None else self.max_thrust

    def scaled(self, factor: float, gravity: Array) -> "QuadrotorLimits":
        """Scale speed, acceleration, body rate and the thrust's distance from hover by a factor."""
        scaled = {"speed": factor * self.speed, "body_rate": factor * self.body_rate}
        if self.acceleration is not None:
            scaled["acceleration"] = factor * self.acceleration
        if self.min_thrust is not None and self.max_thrust is not None:
            least = jnp.maximum(gravity + factor * (self.min_thrust - gravity), 0.0)
            scaled["min_thrust"] = least
            scaled["max_thrust"] = gravity + factor * (self.max_thrust - gravity)
        return dataclasses.replace(self, **scaled)


def net_thrust(acc: Array, gravity: Array) -> Array:
    """Return thrust per unit mass  a + g e_3  [m/s^2], shape (..., 3)."""
    return acc + gravity * jnp.array([0.0, 0.0, 1.0], acc.dtype)


def body_z(acc: Array, gravity: Array) -> Array:
    """Return unit vector along the net thrust, shape (..., 3); zero where there is no thrust."""
    thrust = net_thrust(acc, gravity)
    size_squared = jnp.sum(thrust**2, axis=-1, keepdims=True)
    pushing = size_squared > 0.0
    return jnp.where(pushing, thrust / jnp.sqrt(jnp.where(pushing, size_squared, 1.0)), 0.0)


def body_rate_squared(acc: Components, jerk: Components, gravity: Array) -> Array:
    """Return squared body rate  |omega|^2  of the Hopf fibration at zero heading [rad^2/s^2].

    |z'|^2 + ((z_y z_x' - z_x z_y') / (1 + z_z))^2 , where z' is the jerk across the thrust
    over the thrust's size. Written without square roots, so that its gradient is finite
    wherever the value is.

    Args:
        acc: (..., 3) [m/s^2].
        jerk: (..., 3) [m/s^3].
        gravity: () [m/s^2].

    Returns:
        (...,). Near free fall (no thrust) and upside down, where the attitude is not
        defined, the value is large but finite.
    """
    # Component by component, and each reciprocal once: sums over an axis of three and
    # divisions are what a CPU spends most of a plan's time on.
    tx, ty, az = components(acc)
    tz = az + gravity
    jx, jy, jz = components(jerk)
    size_squared = at_least(tx * tx + ty * ty + tz * tz, 1e-4)
    inverse_size = inverse_sqrt(size_squared)
    inverse_squared = inverse_size * inverse_size
    along = tx * jx + ty * jy + tz * jz
    tilt_squared = (jx * jx + jy * jy + jz * jz - along * along * inverse_squared) * inverse_squared
    # z_y z_x' - z_x z_y' = (tau_y j_x - tau_x j_y) / |tau|^2 : the part along tau drops out.
    twist = (ty * jx - tx * jy) * inverse_size
    twist = twist * reciprocal(at_least(size_squared * inverse_size + tz, 1e-2))
    return tilt_squared + twist * twist


def body_rate(acc: Components, jerk: Components, gravity: Array) -> tuple[Array, Array, Array]:
    """Return components (...) of the body rate [rad/s] of the Hopf fibration, body frame.

    The arguments are those of `body_rate_squared`.
    """
    tx, ty, az = components(acc)
    tz = az + gravity
    jx, jy, jz = components(jerk)
    inverse_size = inverse_sqrt(at_least(tx * tx + ty * ty + tz * tz, 1e-4))
    x, y, z = tx * inverse_size, ty * inverse_size, tz * inverse_size
    along = x * jx + y * jy + z * jz
    dx, dy, dz = ((j - along * n) * inverse_size for j, n in ((jx, x), (jy, y), (jz, z)))
    k = reciprocal(at_least(1.0 + z, 1e-2))
    # The body's x axis is (1 - k x^2, -k x y, -x), its y axis (-k x y, 1 - k y^2, -y).
    sway = k * (x * dx + y * dy)
    return -(dy - y * sway - y * dz), dx - x * sway - x * dz, (y * dx - x * dy) * k


def rotor_thrusts(
    acc: Components, jerk: Components, snap: Components, gravity: Array, rotors: RotorLimits
) -> tuple[Array, ...]:
    """Return thrust of each of the four rotors that a motion at zero heading takes [N], (...) each.

    The arguments are those of `body_rate_squared`, the snap (..., 3) [m/s^4], and the rotors with
    the body that they carry.
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

    They are smooth except at straight down.
    """
    x, y, z = components(normal)
    k = reciprocal(at_least(1.0 + z, 1e-6))
    return (
        jnp.stack([1.0 - k * x * x, -k * x * y, -x]),
        jnp.stack([-k * x * y, 1.0 - k * y * y, -y]),
    )


def flat_attitude(acc: Array, jerk: Array, gravity: Array) -> tuple[Array, Array]:
    """Return rotation (3, 3), body to world, and body rate (3,) [rad/s] at zero heading.

    Acceleration (3,) [m/s^2] and jerk (3,) [m/s^3] determine them by the Hopf fibration.
    """
    z = body_z(acc, gravity)
    size = jnp.sqrt(jnp.maximum(jnp.sum(net_thrust(acc, gravity) ** 2), 1e-2))
    z_dot = (jerk - jnp.sum(jerk * z) * z) / size
    x, y = tangent_basis(z)
    twist = (z[1] * z_dot[0] - z[0] * z_dot[1]) / jnp.maximum(1.0 + z[2], 1e-2)
    rate = jnp.stack([-jnp.sum(y * z_dot), jnp.sum(x * z_dot), twist])
    return jnp.stack([x, y, z], axis=1), rate


def tilt_quaternion(normal: Array) -> Array:
    """Return the attitude at zero heading of the Hopf fibration, of the body z axis, (4,) w x y z.

    The shortest turn from upright: (1 + z, -y, x, 0) / sqrt(2 (1 + z)).
    """
    x, y, z = components(normal)
    w = jnp.sqrt(0.5 * at_least(1.0 + z, 1e-6))
    return jnp.stack([w, -0.5 * y / w, 0.5 * x / w, jnp.zeros_like(w)])


def greatest_speed(head_state: Array, limits: QuadrotorLimits) -> Array:
    """Return the greatest speed of the quadrotor, () [m/s]."""
    first = jnp.sqrt(jnp.sum(head_state[1] * head_state[1]))
    return jnp.maximum(ALLOWED * limits.speed, first)


def beyond_reach(
    places: Array, times: Array, head_state: Array, limits: QuadrotorLimits, gravity: Array
) -> Array:
    """Return how far places lie beyond all that a quadrotor can reach by certain times, (K,) [m].

    A bound from below: zero or less says nothing. By the time t the quadrotor is in each of

    - the ball around the start whose radius is the integral of the greatest speed, which rises
      with the greatest acceleration A up to its limit,
    - the ball of radius A t^2 / 2 around where the first velocity alone takes it,
    - the ball of radius T t^2 / 2 around where it falls freely, with the greatest thrust T,

    as far as there are such limits: the mean of accelerations lies in a ball that holds them all.

    Args:
        places: (K, 3) [m].
        times: (K,) [s], >= 0.
        head_state: (4, 3) of the quadrotor at time 0.
        limits: of the quadrotor.
        gravity: () [m/s^2], magnitude.
    """
    start, vel = head_state[0], head_state[1]
    x, y, z = (place - start[k] for k, place in enumerate(components(places)))
    half_square = 0.5 * jnp.maximum(times, _SHORTEST) ** 2
    thrust = _greatest_thrust(limits)
    acceleration = _greatest_acceleration(limits, thrust, gravity)
    first, most = jnp.sqrt(jnp.sum(vel * vel)), greatest_speed(head_state, limits)
    if acceleration is None:
        return _length(x, y, z) - most * times
    rise = (most - first) / acceleration
    hurried = first * times + acceleration * half_square
    reached = jnp.where(times < rise, hurried, most * times - 0.5 * (most - first) * rise)
    beyond = _length(x, y, z) - reached
    x, y, z = x - vel[0] * times, y - vel[1] * times, z - vel[2] * times
    beyond = jnp.maximum(beyond, _length(x, y, z) - acceleration * half_square)
    if thrust is None:
        return beyond
    return jnp.maximum(beyond, _length(x, y, z + gravity * half_square) - thrust * half_square)


def _greatest_thrust(limits: QuadrotorLimits) -> Array | None:
    """Return the greatest thrust of all rotors per unit mass, () [m/s^2]; None without a limit."""
    found = [] if limits.max_thrust is None else [limits.max_thrust]
    if limits.rotors is not None:
        found.append(4.0 * limits.rotors.max_thrust / limits.rotors.mass)
    return ALLOWED * jnp.min(jnp.stack(found)) if found else None


def _greatest_acceleration(
    limits: QuadrotorLimits, thrust: Array | None, gravity: Array
) -> Array | None:
    """Return the greatest acceleration, () [m/s^2]; None without a limit."""
    found = [] if limits.acceleration is None else [ALLOWED * limits.acceleration]
    if thrust is not None:
        found.append(thrust + gravity)
    return jnp.min(jnp.stack(found)) if found else None


def _length(x: Array, y: Array, z: Array) -> Array:
    return jnp.sqrt(x * x + y * y + z * z)


@dataclasses.dataclass(frozen=True)
class QuadrotorSetpoints:
    """A plan at K equally spaced times; world frame, z up; body x forward, z along the thrust.

    Of a batch every array but `time` has a leading axis B, and is NaN past the end of each plan.
    """

    time: np.ndarray  # (K,) [s] since the plan began
    pos: np.ndarray  # (K, 3) [m], of the propeller plane's centre
    vel: np.ndarray  # (K, 3) [m/s]
    acc: np.ndarray  # (K, 3) [m/s^2]
    jerk: np.ndarray  # (K, 3) [m/s^3]
    quat_wxyz: np.ndarray  # (K, 4), body to world, at zero heading of the Hopf fibration
    body_rate: np.ndarray  # (K, 3) [rad/s], body frame
    thrust: np.ndarray  # (K,) [m/s^2], per unit mass


@struct.dataclass
class QuadrotorPlan(Plan):
    """A plan with the trajectory of a quadrotor's propeller plane."""

    trajectory: PiecewisePolynomial  # up to the last contact
    gravity: Array  # () [m/s^2], magnitude, for which it was planned
    # From there on to rest, where it was asked for.
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
    """Return `QuadrotorSetpoints` but times, of a trajectory and its gravity at a time () [s]."""
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
