"""Bang-bang motions of joints: accelerate at the limit, coast, and brake to standstill.

Each joint is a double integrator with a velocity limit v and an acceleration limit a. The quickest
motion by an angle d from an initial rate u accelerates towards the goal, coasts at v if v is
reached, and brakes. The joint that needs the longest time T moves in this manner. All other joints
coast at a lower rate p, which solves the next equation, so that all joints arrive together:

    d = (u + p) |p - u| / 2a  +  p (T - |p - u| / a - p / a)  +  p^2 / 2a.
"""

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.trajectory.polynomial import PiecewisePolynomial


@struct.dataclass
class _MirroredJoints:
    """Joints whose signs are flipped so that each joint brakes from a rate >= 0."""

    side: Array  # (J,), the sign of each of J joints: -1 if it is flipped, else 1
    turn: Array  # (J,) [rad], angle to the goal
    rate: Array  # (J,) [rad/s], rate at the start


def _mirror(turn: Array, rate: Array, acceleration: Array) -> _MirroredJoints:
    stopping = 0.5 * rate * jnp.abs(rate) / acceleration
    side = jnp.where(turn >= stopping, 1.0, -1.0)
    return _MirroredJoints(side=side, turn=side * turn, rate=side * rate)


def _root(square: Array) -> Array:
    """Return the square root with a finite slope at zero, and zero for negative arguments."""
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def bang_bang(
    start: Array, rate: Array, turn: Array, duration: Array, acceleration: Array
) -> PiecewisePolynomial:
    """Return the motion in which all joints arrive together after `duration`, and stand still.

    Args:
        start: (J,) [rad], angles of J joints at the start.
        rate: (J,) [rad/s], rates at the start.
        turn: (J,) [rad], angle by which each joint turns.
        duration: () [s], at least the greatest of the joints' least times (`motion.least_times`),
            so that rates keep their limits.
        acceleration: (J,) [rad/s^2], > 0, with which the joints accelerate and brake.

    Returns:
        2 J + 1 polynomial pieces of degree 2. A new piece starts when a joint starts or ends
        coasting; pieces may last 0 s.
    """
    joints = _mirror(turn, rate, acceleration)
    u, d, a = joints.rate, joints.turn, acceleration
    # The equation in the module's docstring for the rate p at which a joint coasts is quadratic if
    # p is above the initial rate u, else linear.
    b, c = a * duration + u, a * d + 0.5 * u**2
    above = 2.0 * c / jnp.maximum(b + _root(b**2 - 4.0 * c), 1e-9)
    below = (d - 0.5 * u**2 / a) / jnp.maximum(duration - u / a, 1e-9)
    peak = jnp.where(d < u * duration - 0.5 * u**2 / a, below, above)
    rises = jnp.abs(peak - u) / a  # [s], time at which each joint starts to coast
    brakes = duration - peak / a  # [s], time at which each joint starts to brake
    first = jnp.sign(peak - u) * a

    times = jnp.sort(jnp.clip(jnp.concatenate([rises, brakes]), 0.0, duration))
    times = jnp.concatenate([jnp.zeros_like(times[:1]), times, jnp.full_like(times[:1], duration)])
    begins, ends = times[:-1, None], times[1:, None]
    middle = 0.5 * (begins + ends)
    accelerations = jnp.where(middle < rises, first, jnp.where(middle > brakes, -a, 0.0))
    rising, braking = jnp.minimum(begins, rises), jnp.maximum(begins - brakes, 0.0)
    rates = u + first * rising - a * braking
    coasted = jnp.clip(begins, rises, jnp.maximum(brakes, rises)) - rises
    angles = u * rising + 0.5 * first * rising**2 + peak * (coasted + braking)
    angles = angles - 0.5 * a * braking**2
    rows = [start + joints.side * angles, joints.side * rates, 0.5 * joints.side * accelerations]
    return PiecewisePolynomial(coeffs=jnp.stack(rows, axis=1), durations=times[1:] - times[:-1])
