"""Which velocity takes a ball to a target in a given time, and how high it flies on the way."""

import jax
import jax.numpy as jnp
from jax import Array, lax

from planner_jax.arithmetic import reciprocal
from planner_jax.ball.flight import BallState, fly, gravity_vector

_NEWTON_STEPS = 3
_FLIGHT_STEPS = 10  # the landing of a 2 s flight is then right to 0.1 mm


def aim_drag_free(pos: Array, target: Array, flight_time: Array, gravity: Array) -> Array:
    """Velocity with which a drag-free ball reaches the target after `flight_time`.

    Args:
        pos: (3,) [m].
        target: (3,) [m].
        flight_time: () [s], > 0.
        gravity: () [m/s^2], magnitude.

    Returns:
        (3,) [m/s].
    """
    return (target - pos) * reciprocal(flight_time) - 0.5 * gravity_vector(gravity) * flight_time


def aim_with_drag(
    pos: Array, target: Array, flight_time: Array, drag: Array, gravity: Array
) -> Array:
    """Velocity with which a ball with quadratic drag reaches the target after `flight_time`.

    Newton's method on the landing point from the drag-free velocity. Only the last step is
    differentiated: at the root that is the implicit function theorem, so gradients are exact
    and cost one step.

    Args:
        pos: (3,) [m].
        target: (3,) [m].
        flight_time: () [s], > 0.
        drag: () K_D [1/m].
        gravity: () [m/s^2], magnitude.

    Returns:
        (3,) [m/s].
    """

    def landing(vel: Array) -> Array:
        ball = BallState(pos=pos, vel=vel)
        return fly(ball, flight_time, drag, gravity, num_steps=_FLIGHT_STEPS)[0].pos

    def newton_step(vel: Array) -> Array:
        slope = lax.stop_gradient(jax.jacfwd(landing)(vel))
        return vel - _solve3(slope, landing(vel) - target)

    start = lax.stop_gradient(aim_drag_free(pos, target, flight_time, gravity))
    # A loop, not three copies: the program that an optimiser compiles is a third the size.
    near = lax.fori_loop(0, _NEWTON_STEPS - 1, lambda _, vel: newton_step(vel), start)
    return newton_step(lax.stop_gradient(near))


def _solve3(matrix: Array, rhs: Array) -> Array:
    """Solution of a 3 x 3 system by Cramer's rule, which `vmap` keeps free of LAPACK calls."""
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    bc, ca, ab = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
    return jnp.stack([jnp.sum(bc * rhs), jnp.sum(ca * rhs), jnp.sum(ab * rhs)]) / jnp.sum(a * bc)


def apex_with_drag(ball: BallState, flight_time: Array, drag: Array, gravity: Array) -> Array:
    """Greatest height [m] of a ball with quadratic drag within `flight_time`.

    From the last step that still rises, the rest of the climb is v_z^2 / (2 (g + K_D |v| v_z))
    to second order in a step. A falling ball is highest now.
    """
    _, path = fly(ball, flight_time, drag, gravity, num_steps=_FLIGHT_STEPS)
    height = jnp.concatenate([ball.pos[None, 2], path.pos[:-1, 2]])
    vel = jnp.concatenate([ball.vel[None], path.vel[:-1]])
    rising = jnp.maximum(vel[:, 2], 0.0)
    speed = jnp.sqrt(jnp.maximum(jnp.sum(vel**2, axis=1), 1e-12))
    reach = height + 0.5 * rising**2 / (gravity + drag * speed * rising * 2.0 / 3.0)
    last = jnp.maximum(jnp.sum(vel[:, 2] > 0.0) - 1, 0)
    return reach[last]
