"""Ball flight with quadratic drag [Yu2023bat, eq. 2] or linear drag, and solved impacts.

World frame, z up, SI units. Functions take one ball; use `jax.vmap` for many. Positions and
velocities are (3,) [m] and [m/s], durations () [s], `gravity` () is a magnitude [m/s^2], and `drag`
is K_D () [1/m] if quadratic, or K_i (3,) [1/s] if linear, both >= 0.
"""

from typing import ClassVar, TypeVar

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import components, inverse_sqrt, reciprocal
from planner_jax.core.checks import require_kind, require_number, shape_of
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError

Vector = TypeVar("Vector", Array, tuple[Array, Array, Array])


@struct.dataclass
class BallState:
    """Position and velocity of a ball at one instant, in the world frame with z up.

    Attributes:
        pos: (3,) [m], position.
        vel: (3,) [m/s], velocity.
    """

    positions: ClassVar[dict] = {"pos": ()}

    pos: Array
    vel: Array


def require_ball(ball: object) -> None:
    """Raise an error unless the argument `ball` is one `BallState` with vectors of shape (3,)."""
    require_kind("ball", ball, BallState)
    for name in ("pos", "vel"):
        shape = shape_of(f"ball.{name}", vars(ball)[name])
        if shape != (3,):
            raise ArgumentError(f"ball.{name}", "the shape (3,)", shape, verb="have")


def gravity_vector(gravity: Array) -> Array:
    """Return the acceleration (0, 0, -gravity) [m/s^2] of free fall, shape (3,)."""
    gravity = jnp.asarray(gravity)
    return jnp.stack([jnp.zeros_like(gravity), jnp.zeros_like(gravity), -gravity])


def ball_acceleration(vel: Vector, drag: Array, gravity: Array) -> Vector:
    """Return the acceleration g - K_D |v| v [m/s^2] of a ball in flight [Yu2023bat, eq. 2].

    `vel` is its velocity v, and `drag` is K_D [1/m]. The result is a tuple if the velocity is a
    tuple. The gradient is finite at zero velocity.
    """
    x, y, z = components(vel)
    speed_squared = x * x + y * y + z * z
    moving = speed_squared > 0.0
    # sqrt has no finite gradient at zero. The inner `where` replaces a zero argument by 1.
    speed = jnp.where(moving, jnp.sqrt(jnp.where(moving, speed_squared, 1.0)), 0.0)
    braking = -drag * speed
    acc: PyTree = (braking * x, braking * y, braking * z - gravity)
    if not isinstance(vel, tuple):
        acc = jnp.stack(acc)
    return acc


def rk4_step(
    ball: BallState, duration: Array, drag: Array, gravity: Array, acceleration=ball_acceleration
) -> BallState:
    """Return the ball after a time `duration` [s], by one Runge-Kutta step of order 4.

    The drag is quadratic. A negative duration goes back in time.
    """

    def rate(state: BallState) -> BallState:
        slopes: PyTree = acceleration(state.vel, drag, gravity)
        return BallState(pos=state.vel, vel=slopes)

    def ahead(slope: BallState, step: Array) -> BallState:
        return jax.tree.map(lambda x, dx: x + step * dx, ball, slope)

    k1 = rate(ball)
    k2 = rate(ahead(k1, 0.5 * duration))
    k3 = rate(ahead(k2, 0.5 * duration))
    k4 = rate(ahead(k3, duration))
    return jax.tree.map(
        lambda x, a, b, c, d: x + duration / 6.0 * (a + 2.0 * b + 2.0 * c + d), ball, k1, k2, k3, k4
    )


def fly(
    ball: BallState, duration: Array, drag: Array, gravity: Array, *, num_steps: int
) -> tuple[BallState, BallState]:
    """Integrate the flight of a ball with quadratic drag.

    Args:
        ball: position and velocity at the start.
        duration: () [s]; a negative duration goes back in time.
        drag: () K_D [1/m].
        gravity: () [m/s^2], magnitude.
        num_steps: number of equal Runge-Kutta steps.

    Returns:
        final: the ball at the end.
        path: the ball after each step, leaves (num_steps, 3).
    """
    require_ball(ball)
    require_number("duration", duration)
    require_number("drag", drag)
    require_number("gravity", gravity)
    require_size("num_steps", num_steps)
    step = jnp.asarray(duration, ball.pos.dtype) / num_steps

    def advance(state: BallState, _: None) -> tuple[BallState, BallState]:
        after = rk4_step(state, step, drag, gravity)
        return after, after

    return jax.lax.scan(advance, ball, None, length=num_steps)


def drag_free_flight(ball: BallState, duration: Array, gravity: Array) -> BallState:
    """Return the ball after `duration` [s] of flight without drag [Natarajan2024, eqs 5 to 7]."""
    g = gravity_vector(gravity)
    return BallState(
        pos=ball.pos + ball.vel * duration + 0.5 * g * duration**2, vel=ball.vel + g * duration
    )


def drag_free_apex(ball: BallState, gravity: Array) -> Array:
    """Return the greatest future height [m] of a drag-free ball [Yu2023bat, eq. 22].

    The height is z + v_z^2 / (2 g) for a rising ball, and its present height z for a falling ball.
    The paper prints v_x for v_z.
    """
    return ball.pos[2] + jnp.maximum(ball.vel[2], 0.0) ** 2 / (2.0 * gravity)


def drag_free_fall_time(ball: BallState, height: Array, gravity: Array) -> tuple[Array, Array]:
    """Return the time () [s] at which a drag-free ball falls through a horizontal plane.

    Also return whether the ball reaches the plane's `height`; if not, the time is 0.
    """
    discriminant = ball.vel[2] ** 2 + 2.0 * gravity * (ball.pos[2] - height)
    real = discriminant > 0.0
    # The inner `where` keeps the gradient of sqrt finite if the ball never reaches the plane.
    time = (ball.vel[2] + jnp.sqrt(jnp.where(real, discriminant, 1.0))) / gravity
    reached = real & (time > 0.0)
    return jnp.where(reached, time, 0.0), reached


def solve_impact(ball_vel: Array, ball_vel_after: Array, restitution: Array) -> tuple[Array, Array]:
    """Return the racket's unit normal (3,) and its speed () along the normal for a desired bounce.

    The bounce changes the ball's velocity v- to v+. The normal has the direction of v+ - v-; in
    [Yu2023bat, eqs 11 and 12] normal and speed have the opposite sign.
    """
    import chex  # only where a function is traced, as its import takes a tenth of a second

    chex.assert_shape([ball_vel, ball_vel_after, restitution], [(3,), (3,), ()])
    change = ball_vel_after - ball_vel
    size_squared = jnp.sum(change**2)
    normal = change * inverse_sqrt(jnp.where(size_squared > 0.0, size_squared, 1.0))
    mean = (restitution * ball_vel + ball_vel_after) * reciprocal(1.0 + restitution)
    return normal, jnp.sum(mean * normal)
