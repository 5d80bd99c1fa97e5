"""The impact of a ball on a quadrotor's racket by [Yu2023bat, Section IV-B] (eqs 11-14).

The caller chooses two components of the racket's velocity and two of the quadrotor's thrust. The
remaining components follow from the ball and the target.
"""

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.ball.aim import aim_drag_free
from planner_jax.ball.flight import BallState

_LEAST_THRUST_X = 1e-2  # [m/s^2], least size of the thrust's x component
_LEAST_ROOT = 1e-2  # [m/s], least root of the discriminant in eq. 13c of [Yu2023bat]
_LEAST_FLIGHT = 1e-2  # [s], least flight time of the returned ball
_LEAST_PUSH = 1e-3  # [s], least (change of the ball's velocity) / thrust


@struct.dataclass
class DecoupledHit:
    """A hit from y, z of the racket's velocity and x, z of the thrust [Yu2023bat, eqs 13-14]."""

    ball_vel_after: Array  # (3,) [m/s], velocity of the ball after the impact
    flight_time: Array  # () [s], of the ball from the impact to the target
    racket_vel: Array  # (3,) [m/s], its x by eq. 14a
    thrust: Array  # (3,) [m/s^2], per unit mass, its y by eq. 14b
    defect: Array  # () >= 0; if > 0, no hit with the given components reaches the target


def solve_decoupled_hit(
    ball: BallState,
    target: Array,
    racket_vel_yz: Array,
    thrust_xz: Array,
    restitution: Array,
    gravity: Array,
) -> DecoupledHit:
    """Solve [Yu2023bat, eqs 13-14] for a hit that sends the ball to the target.

    Let tau be the thrust, v the ball's velocity before the impact, and g gravity. With
    delta = tau_z / tau_x, xi = target - ball and c = v_z - delta v_x, the flight time t after the
    impact is the later root of g t^2 / 2 - c t - (delta xi_x - xi_z) = 0. The velocity of eq. 13c
    is xi_x / t; this form needs no division by xi_x or delta xi_x - xi_z. By eq. 14b, tau_y is
    tau_x times the change of the ball's v_y divided by the change of its v_x.

    Divisors and roots are kept above small bounds, so that values and gradients are finite. If a
    bound applies, no hit with these components reaches the target, and `defect` is the distance
    from the bound. This happens for tau_x near 0, for a negative discriminant, and if the ball
    would fly backwards in time or the racket would pull it.

    The paper's eq. 13d measures xi from the quadrotor. Here xi is measured from the ball, 6 cm
    away, so that the ball meets the target exactly.

    Args:
        ball: state of the ball just before the impact.
        target: (3,) [m], where the ball should arrive.
        racket_vel_yz: (2,) [m/s], y and z of the racket's velocity.
        thrust_xz: (2,) [m/s^2], tau_x and tau_z, thrust per unit mass.
        restitution: (), coefficient of restitution.
        gravity: () [m/s^2], magnitude.
    """
    size_x = jnp.abs(thrust_xz[0])
    tau_x = jnp.where(thrust_xz[0] < 0.0, -1.0, 1.0) * jnp.maximum(size_x, _LEAST_THRUST_X)
    tau_z = thrust_xz[1]
    delta = tau_z / tau_x
    xi = target - ball.pos
    c = ball.vel[2] - delta * ball.vel[0]
    discriminant = c**2 + 2.0 * gravity * (delta * xi[0] - xi[2])
    root = jnp.sqrt(jnp.maximum(discriminant, _LEAST_ROOT**2))
    flight_time = (c + root) / gravity
    flight = jnp.maximum(flight_time, _LEAST_FLIGHT)
    after = aim_drag_free(ball.pos, target, flight, gravity)
    push = (after[0] - ball.vel[0]) / tau_x
    tau_y = (after[1] - ball.vel[1]) / jnp.maximum(push, _LEAST_PUSH)
    thrust = jnp.stack([tau_x, tau_y, tau_z])
    along = jnp.sum((restitution * ball.vel + after) * thrust) / (1.0 + restitution)
    vel_x = (along - racket_vel_yz[0] * tau_y - racket_vel_yz[1] * tau_z) / tau_x
    shortfalls = jnp.stack(
        [
            _LEAST_THRUST_X - size_x,
            (_LEAST_ROOT**2 - discriminant) / gravity,
            _LEAST_FLIGHT - flight_time,
            _LEAST_PUSH - push,
        ]
    )
    return DecoupledHit(
        ball_vel_after=after,
        flight_time=flight,
        racket_vel=jnp.concatenate([vel_x[None], racket_vel_yz]),
        thrust=thrust,
        defect=jnp.sum(jnp.maximum(shortfalls, 0.0)),
    )


def aim_at_angle(pos: Array, target: Array, angle: float, gravity: Array) -> Array:
    """Return the initial velocity of a drag-free ball that leaves at an angle and hits a target.

    Args:
        pos: (3,) [m], position of the ball at the start.
        target: (3,) [m]. A target above the straight line at that angle cannot be hit; it is
            replaced by a point 0.1 m below the line.
        angle: [rad], above the horizontal, less than pi / 2.
        gravity: () [m/s^2], magnitude.

    Returns:
        (3,) [m/s].
    """
    offset = target - pos
    distance = jnp.sqrt(jnp.maximum(jnp.sum(offset[:2] ** 2), 1e-4))
    slope = jnp.tan(angle)
    below = jnp.maximum(distance * slope - offset[2], 0.1)
    # In the flight time t = sqrt(2 below / g) the ball falls `below` [m] from the line.
    flight_time = jnp.sqrt(2.0 * below / gravity)
    return jnp.concatenate([offset[:2], (distance * slope)[None]]) / flight_time
