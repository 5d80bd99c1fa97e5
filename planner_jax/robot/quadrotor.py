"""A quadrotor: limits, differential flatness [Yu2023bat, eq. 1], bounds on reach, and plans.

The body z axis is along the net thrust per unit mass  tau = a + g e_3 , for the acceleration a, the
magnitude g of gravity, and the upward unit vector e_3. The heading is zero in the sense of the Hopf
fibration [Watterson2020]. Attitude and body rate are then functions of tau and the jerk alone. At a
constant heading psi the body rate is turned by R_z(-psi), so that only limits of rotors differ.
"""

import dataclasses
from typing import TYPE_CHECKING, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import (
    Components,
    at_least,
    components,
    inverse_sqrt,
    numpy_of,
    reciprocal,
)
from planner_jax.core.checks import require_values
from planner_jax.core.origin import Located, to_world
from planner_jax.core.protocol import Plan
from planner_jax.robot.quadrotor_model import MORE_TILT, RECOVERY_TILT
from planner_jax.trajectory.polynomial import PiecewisePolynomial, join

if TYPE_CHECKING:
    from planner_jax.robot.attitude import QuadrotorSetpoints

# Factor on the limits when `beyond_reach` computes how far a quadrotor can fly. Solved plans exceed
# their limits by far less than 1 %.
ALLOWED = 1.01
_SHORTEST = 1e-3  # [s], least time in `beyond_reach`; avoids the product of zero and infinity


@struct.dataclass
class RotorLimits:
    """Thrust limits of a rotor, and mass, inertia and mixer, which give the thrusts of a motion.

    Attributes:
        mass: () [kg], mass of the quadrotor.
        inertia: (3,) or (6,) [kg m^2], inertia about the body's axes: I_xx, I_yy, I_zz, and maybe
            I_xy, I_xz, I_yz.
        mixer: (R, 4) matrix from total thrust [N] and torque [N m] to the R rotors' thrusts [N].
        min_thrust: () [N], least thrust of one rotor.
        max_thrust: () [N], greatest thrust of one rotor.
        heading: () [rad], constant heading of the flight; None: 0.
    """

    mass: Array
    inertia: Array
    mixer: Array
    min_thrust: Array
    max_thrust: Array
    heading: Array | None = None


@struct.dataclass
class Air:
    """Linear drag of the rotors in a constant wind: forces that no trajectory can avoid.

    The drag per unit mass is  -D (v - w)  for the velocity v and the wind w. The matrix D has the
    eigenvalue `drag` across the thrust, and `thrust_drag` along it [Faessler2018].
    """

    drag: Array  # () [1/s], across the thrust
    thrust_drag: Array  # () [1/s], along the thrust
    wind: Array  # (3,) [m/s], velocity of the air


@struct.dataclass
class QuadrotorLimits:
    """Limits of a quadrotor; None means no limit.

    Which limits are None determines the compiled program. To change a number compiles nothing, but
    to replace None by a number compiles a new program.

    Attributes:
        speed: () [m/s], greatest speed.
        body_rate: () [rad/s], greatest body rate, including its component about body z.
        min_height: () [m], least height of the propeller plane.
        acceleration: () [m/s^2], greatest acceleration.
        min_thrust: () [m/s^2], least thrust per unit mass; None if `max_thrust` is None.
        max_thrust: () [m/s^2], greatest thrust per unit mass.
        rotors: limits of the rotors' thrusts; None: only the total thrust is limited.
        max_tilt: () [rad], greatest tilt, the angle between thrust and vertical.
        recovery_tilt: () [rad], greatest tilt of recoveries; None: 40 degrees.
        air: drag and wind; None: there are neither drag nor wind.
    """

    speed: Array
    body_rate: Array
    min_height: Array
    acceleration: Array | None = None
    min_thrust: Array | None = None
    max_thrust: Array | None = None
    rotors: RotorLimits | None = None
    max_tilt: Array | None = None
    recovery_tilt: Array | None = None
    air: Air | None = None

    @property
    def thrust_bounds(self) -> tuple[Array, Array]:
        """Least and greatest thrust per unit mass [m/s^2]; zero and infinity if not limited."""
        none = jnp.zeros_like(self.speed)
        least = none if self.min_thrust is None else self.min_thrust
        return least, none + jnp.inf if self.max_thrust is None else self.max_thrust

    def scale(self, factor: float, gravity: Array) -> "QuadrotorLimits":
        """Return limits times `factor`; thrust limits f become gravity + factor * (f - gravity)."""
        limits = {"speed": factor * self.speed, "body_rate": factor * self.body_rate}
        if self.acceleration is not None:
            limits["acceleration"] = factor * self.acceleration
        if self.min_thrust is not None and self.max_thrust is not None:
            limits["min_thrust"] = jnp.maximum(gravity + factor * (self.min_thrust - gravity), 0.0)
            limits["max_thrust"] = gravity + factor * (self.max_thrust - gravity)
        return dataclasses.replace(self, **limits)

    def of_recovery(self, state: Array, gravity: Array) -> "QuadrotorLimits":
        """Return the limits of a recovery that starts at a state (..., 4, 3), position to jerk.

        The greatest tilt is `recovery_tilt`, but at least 10 degrees more than the tilt at the
        start, since the body may rotate away from upright there, and at most `max_tilt`.
        """
        xp = numpy_of(state, gravity)
        acc = add_drag(self.air, state[..., 1, :], state[..., 2, :])
        start = xp.arctan2(xp.hypot(acc[..., 0], acc[..., 1]), acc[..., 2] + gravity)
        tilt = RECOVERY_TILT if self.recovery_tilt is None else self.recovery_tilt
        tilt = xp.maximum(start + MORE_TILT, tilt)
        if self.max_tilt is not None:
            tilt = xp.minimum(tilt, self.max_tilt)
        return dataclasses.replace(self, max_tilt=tilt.astype(start.dtype), recovery_tilt=None)


def velocity_in_air(air: Air, vel: Array) -> Array:
    """Return the velocity v - w relative to the air, for velocities (..., 3) [m/s]."""
    return vel - air.wind.reshape((1,) * (vel.ndim - air.wind.ndim) + air.wind.shape)


def add_drag(air: Air | None, vel: Array, acc: Array) -> Array:
    """Return a + d (v - w): without drag, this acceleration needs the same thrust direction.

    The thrust per unit mass that balances the drag is  a + g e_3 + D (v - w) , and D (v - w) is
    d (v - w)  plus a vector along the thrust. So the thrust is along  a + g e_3 + d (v - w) .
    """
    return acc if air is None else add_drag_rate(air, velocity_in_air(air, vel), acc)


def add_drag_rate(air: Air | None, acc: Array, jerk: Array) -> Array:
    """Return j + d a, the derivative of `add_drag`; of jerk and snap its second derivative."""
    if air is None:
        return jerk
    drag = air.drag[..., None]
    return jerk + drag.reshape((1,) * (acc.ndim - drag.ndim) + drag.shape) * acc


def thrust_in_air(air: Air, vel: Array, load: Array, gravity: Array) -> Array:
    """Return the thrust per unit mass (...) [m/s^2] for a velocity and the result of `add_drag`.

    With t = `load` + g e_3, n = t / |t|, and the coefficients d and d_z of the drag,
    it is  |t| + (d_z - d) n . (v - w) .
    """
    x, y, z = components(load)
    z = z + gravity
    u, v, w = components(velocity_in_air(air, vel))
    square = at_least(x * x + y * y + z * z, 1e-4)
    along = (air.thrust_drag - air.drag) * (x * u + y * v + z * w)
    return (square + along) * inverse_sqrt(square)


def net_thrust(acc: Array, gravity: Array) -> Array:
    """Return the thrust per unit mass (..., 3) [m/s^2]: the acceleration minus gravity's vector."""
    return acc + jnp.broadcast_to(gravity * jnp.array([0.0, 0.0, 1.0], acc.dtype), acc.shape)


def body_z(acc: Array, gravity: Array) -> Array:
    """Return the body z axis (..., 3): the unit vector along the thrust, or 0 if there is none."""
    thrust = net_thrust(acc, gravity)
    square = jnp.sum(thrust**2, axis=-1, keepdims=True)
    has_thrust = square > 0.0
    return jnp.where(has_thrust, thrust / jnp.sqrt(jnp.where(has_thrust, square, 1.0)), 0.0)


def body_rate_squared(acc: Components, jerk: Components, gravity: Array) -> Array:
    """Return the squared body rate  |omega|^2  of the Hopf fibration at zero heading [rad^2/s^2].

    |omega|^2 = |z'|^2 + ((z_y z_x' - z_x z_y') / (1 + z_z))^2 , where z is the body z axis, and its
    derivative z' is the component of the jerk perpendicular to the thrust, over the magnitude of
    the thrust. |omega| itself is not computed, since the square root has no gradient at zero.

    Args:
        acc: (..., 3) [m/s^2].
        jerk: (..., 3) [m/s^3].
        gravity: () [m/s^2].

    Returns:
        (...,). Near free fall (no thrust) and upside down, where the attitude is undefined, the
        value is large but finite.
    """
    # Components are separate arrays, and every reciprocal is computed once. On a CPU, sums over an
    # axis of length three and divisions would take most of a planner's time.
    tx, ty, az = components(acc)
    tz = az + gravity
    jx, jy, jz = components(jerk)
    size_squared = at_least(tx * tx + ty * ty + tz * tz, 1e-4)
    inverse_size = inverse_sqrt(size_squared)
    inverse_squared = inverse_size * inverse_size
    along = tx * jx + ty * jy + tz * jz
    tilt_squared = (jx * jx + jy * jy + jz * jz - along * along * inverse_squared) * inverse_squared
    # With thrust tau and jerk j,  z_y z_x' - z_x z_y' = (tau_y j_x - tau_x j_y) / |tau|^2 .
    twist = (ty * jx - tx * jy) * inverse_size
    twist = twist * reciprocal(at_least(size_squared * inverse_size + tz, 1e-2))
    return tilt_squared + twist * twist


def body_rate(acc: Components, jerk: Components, gravity: Array) -> tuple[Array, Array, Array]:
    """Return the body rate (three components) [rad/s], body frame, for acceleration and jerk."""
    tx, ty, az = components(acc)
    tz = az + gravity
    jx, jy, jz = components(jerk)
    inverse_size = inverse_sqrt(at_least(tx * tx + ty * ty + tz * tz, 1e-4))
    x, y, z = tx * inverse_size, ty * inverse_size, tz * inverse_size
    along = x * jx + y * jy + z * jz
    dx, dy, dz = ((j - along * n) * inverse_size for j, n in ((jx, x), (jy, y), (jz, z)))
    k = reciprocal(at_least(1.0 + z, 1e-2))
    # If (x, y, z) is the body's z axis and k = 1 / (1 + z), the body's x axis is
    # (1 - k x^2, -k x y, -x), and its y axis is (-k x y, 1 - k y^2, -y).
    sway = k * (x * dx + y * dy)
    return -(dy - y * sway - y * dz), dx - x * sway - x * dz, (y * dx - x * dy) * k


def tangent_basis(normal: Array) -> tuple[Array, Array]:
    """Return the body's x and y axes (3,) at zero heading for its z axis `normal` (3,)."""
    x, y, z = components(normal)
    k = reciprocal(at_least(1.0 + z, 1e-6))
    return (
        jnp.stack([1.0 - k * x * x, -k * x * y, -x]),
        jnp.stack([-k * x * y, 1.0 - k * y * y, -y]),
    )


def greatest_speed(head_state: Array, limits: QuadrotorLimits) -> Array:
    """Return an upper bound () [m/s] on the speed: the limit, or the speed at time 0 if greater."""
    return jnp.maximum(ALLOWED * limits.speed, jnp.sqrt(jnp.sum(head_state[1] * head_state[1])))


def beyond_reach(
    positions: Array, times: Array, head_state: Array, limits: QuadrotorLimits, gravity: Array
) -> Array:
    """Return lower bounds (K,) [m] on a quadrotor's distances from K positions at K times.

    Zero or less means that the position may be reached. At the time t the quadrotor is inside each
    of these spheres, if the limits exist:

    - around the start, with the integral of the greatest speed as radius; this speed rises with the
      greatest acceleration A up to its limit;
    - around the position that the quadrotor reaches at its initial velocity, with radius A t^2 / 2;
    - around the position that the quadrotor reaches in free fall, with radius T t^2 / 2, where T is
      the greatest thrust per unit mass.

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
    first, most = jnp.sqrt(jnp.sum(vel * vel)), greatest_speed(head_state, limits)
    if limits.air is not None and thrust is not None:  # the air accelerates by at most this much
        speed = most + jnp.sqrt(jnp.sum(limits.air.wind**2))
        thrust = thrust + jnp.maximum(limits.air.drag, limits.air.thrust_drag) * speed
    acceleration = _greatest_acceleration(limits, thrust, gravity)
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
    """Return an upper bound () [m/s^2] on the thrust per unit mass; None if there is no limit."""
    bounds = [] if limits.max_thrust is None else [limits.max_thrust]
    if limits.rotors is not None:
        num = limits.rotors.mixer.shape[-2]
        bounds.append(num * limits.rotors.max_thrust / limits.rotors.mass)
    return ALLOWED * jnp.min(jnp.stack(bounds)) if bounds else None


def _greatest_acceleration(
    limits: QuadrotorLimits, thrust: Array | None, gravity: Array
) -> Array | None:
    """Return an upper bound () [m/s^2] on the acceleration; None if there is no limit."""
    bounds = [] if limits.acceleration is None else [ALLOWED * limits.acceleration]
    if thrust is not None:
        bounds.append(thrust + gravity)
    return jnp.min(jnp.stack(bounds)) if bounds else None


def _length(x: Array, y: Array, z: Array) -> Array:
    return jnp.sqrt(x * x + y * y + z * z)


@struct.dataclass
class QuadrotorPlan(Plan, Located):
    """A quadrotor's plan: the trajectory of the centre of the propeller plane.

    Positions in its arrays are relative to `origin`; positions of `sample` are not.

    Attributes:
        trajectory: positions [m] over time up to the last contact with a ball or target.
        gravity: () [m/s^2], magnitude of gravity.
        recovery: trajectory from the last contact to standstill; None if none was requested.
        air: drag and wind of the case.
        heading: heading [rad] over time, a polynomial of one dimension, up to the end of `whole`;
            None: 0.
    """

    trajectory: PiecewisePolynomial
    gravity: Array
    recovery: PiecewisePolynomial | None = struct.field(default=None, kw_only=True)
    air: Air | None = struct.field(default=None, kw_only=True)
    heading: PiecewisePolynomial | None = struct.field(default=None, kw_only=True)

    @property
    def whole(self) -> PiecewisePolynomial:
        """The trajectory and the recovery, joined to one polynomial, of a plan or of a batch."""
        return self.trajectory if self.recovery is None else join(self.trajectory, self.recovery)

    def with_heading(self, case: PyTree) -> Self:
        """Return the plan, or batch, with the heading that its case requests, if any."""
        if case.heading is None:
            return self
        from planner_jax.robot import heading  # few cases request a heading

        find = heading.plan_headings if case.batch_shape else heading.plan_heading
        return dataclasses.replace(self, heading=find(self, case))

    def sample(self, rate: float) -> "QuadrotorSetpoints":
        """Sample the plan, or the batch, `rate` times a second, including a recovery trajectory.

        Raises:
            ValueError: the rate is not positive.
        """
        from planner_jax.robot.attitude import QuadrotorSetpoints, setpoint_at  # rarely needed
        from planner_jax.robot.setpoints import sample_at_rate

        require_values("sample", self)
        path = jax.tree.map(np.asarray, self).whole
        leaves = jax.tree.map(np.asarray, (path, self.gravity, self.air, self.heading))
        found = sample_at_rate(rate, np.sum(path.durations, axis=-1), leaves, setpoint_at)
        return QuadrotorSetpoints(**{**found, "pos": to_world(found["pos"], self.origin)})
