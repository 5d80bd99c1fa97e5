"""Flight of a ball with linear drag in closed form [Yu2023catch]; world frame, z up, SI units."""

import math

import jax.numpy as jnp
from jax import Array

from planner_jax.ball.flight import BallState, gravity_vector


def linear_drag_flight(ball: BallState, duration: Array, drag: Array, gravity: Array) -> BallState:
    """Return the ball after a flight with drag acceleration -K_i v_i on each axis i.

    On each axis, with K = K_i, s(t) = s_0 + (v_0 - g/K)(1 - exp(-K t))/K + g t/K is the position,
    and g the component of the gravitational acceleration. [Yu2023bat, eq. 4a] and [Yu2023catch,
    eq. 9a] omit the constant of integration. The result is exact to rounding for any K >= 0.
    """
    x = drag * duration
    phi_1, phi_2 = _phi(x)
    g = gravity_vector(gravity)
    return BallState(
        pos=ball.pos + ball.vel * duration * phi_1 + g * duration**2 * phi_2,
        vel=ball.vel * jnp.exp(-x) + g * duration * phi_1,
    )


def _phi(x: Array) -> tuple[Array, Array]:
    """Return phi_1 = (1 - exp(-x))/x and phi_2 = (1 - phi_1)/x, exact to rounding for any x."""
    # For |x| < 1/2 a power series of thirteen terms avoids the cancellation in 1 - phi_1.
    small = jnp.abs(x) < 0.5
    near = jnp.where(small, x, 0.0)
    series = sum((-near) ** k / float(math.factorial(k + 2)) for k in range(13))
    far = jnp.where(small, 1.0, x)
    phi_2 = jnp.where(small, series, (1.0 + jnp.expm1(-far) / far) / far)
    return 1.0 - x * phi_2, phi_2
