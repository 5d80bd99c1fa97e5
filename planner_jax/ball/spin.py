"""Flight of a spinning ball with quadratic drag, lift and wind, which bounces on a plane.

With the velocity u = v - w relative to the wind w, the acceleration is g - K_D s u + l x u. The
lift vector l = K_M omega [1/s] is proportional to the spin omega [rad/s]; between two bounces it is
constant. Spin increases the drag: s^2 = |u|^2 + |r omega x u|^2 / |u|^2, where r is the radius.
World frame, z up, SI units. Functions take one ball; use `jax.vmap` for many.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.ball.flight import BallState, rk4_step
from planner_jax.ball.flight_table import FlightTable, graded_times, integrate_at, pace_of
from planner_jax.core.arithmetic import at_least, components, reciprocal

_LEAST_SPEED = 1e-3  # [m/s], smaller speeds count as this speed in divisions


@struct.dataclass
class SpinningBall:
    """Position and velocity of a ball at one instant, its drag, and its lift vector."""

    pos: Array  # (3,) [m]
    vel: Array  # (3,) [m/s]
    drag: Array  # () K_D [1/m]
    lift: Array  # (3,) l = K_M omega [1/s]


@struct.dataclass
class Surroundings:
    """Gravity, wind, and a horizontal plane on which the ball bounces."""

    gravity: Array  # () [m/s^2], magnitude
    wind: Array  # (3,) w [m/s]
    height: Array  # () [m], height of the ball's centre while it touches the plane
    restitution: Array  # () e, ratio of the vertical speeds after and before a bounce
    friction: Array  # () mu, coefficient of sliding friction
    # () change of the tangential velocity by a bounce that ends without slip, divided by the slip:
    # 2/5 for a hollow ball, 2/7 for a solid ball.
    grip: Array
    reach: Array  # () [m], speed of the ball's surface r omega, divided by the lift K_M omega


def spin_acceleration(ball: SpinningBall, air: Surroundings) -> Array:
    """Return the acceleration g - K_D s u + l x u (3,) [m/s^2] of a spinning ball in flight."""
    return jnp.stack(_rate(components(ball.vel), ball, air))


def _rate(vel: Sequence[Array], ball: SpinningBall, air: Surroundings) -> PyTree:
    u, lift = tuple(v - w for v, w in zip(vel, air.wind, strict=True)), components(ball.lift)
    push = tuple(lift[k - 2] * u[k - 1] - lift[k - 1] * u[k - 2] for k in range(3))
    squared = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
    moving = squared > 0.0
    squared = jnp.where(moving, squared, 1.0)
    turning = air.reach**2 * sum(a * a for a in push) / squared  # squared speed of the surface
    braking = jnp.where(moving, ball.drag * jnp.sqrt(squared + turning), 0.0)
    fall = (0.0, 0.0, -air.gravity)
    return tuple(fall[k] - braking * u[k] + push[k] for k in range(3))


def spin_step(ball: SpinningBall, duration: Array, air: Surroundings) -> SpinningBall:
    """Return the ball after `duration` [s] without a bounce, by one Runge-Kutta step of order 4."""
    pos, vel = (tuple(components(each)) for each in (ball.pos, ball.vel))
    rate = lambda vel, *_: _rate(vel, ball, air)  # noqa: E731
    end: PyTree = rk4_step(BallState(pos, vel), duration, ball.drag, air.gravity, rate)  # pyright: ignore[reportArgumentType]
    return SpinningBall(jnp.stack(end.pos), jnp.stack(end.vel), ball.drag, ball.lift)


def tabulate_spin(
    ball: SpinningBall, duration: Array, air: Surroundings, num: int, substeps: int
) -> FlightTable:
    """Return the table of a flight without bounces in a duration () [s], of `num` states."""
    pace = pace_of(jnp.sum((ball.vel - air.wind) ** 2), ball.drag, air.gravity)
    times, growth = graded_times(pace, duration, num)
    nodes = integrate_at(lambda now, h: spin_step(now, h, air), ball, times, substeps)
    acc = jax.vmap(lambda each: spin_acceleration(each, air))(nodes)
    return FlightTable(nodes.pos, nodes.vel, acc, times, growth)


def spin_bounce(ball: SpinningBall, air: Surroundings) -> SpinningBall:
    """Return the ball after its bounce on the plane.

    The ball is rigid, with restitution and Coulomb friction; compare [Nakashima2010]. The vertical
    velocity v_z becomes -e v_z. The point of contact slips with s = v_t + r omega x (-z). Friction
    changes the tangential velocity v_t by -min(mu (1 + e) |v_z| / |s|, grip) s: either the point
    slides until the end of the contact, or the slip ends before.
    """
    surface = air.reach * ball.lift
    slip = jnp.stack([ball.vel[0] - surface[1], ball.vel[1] + surface[0]])
    size = jnp.sqrt(at_least(jnp.sum(slip * slip), _LEAST_SPEED**2))
    push = air.friction * (1.0 + air.restitution) * jnp.abs(ball.vel[2])
    x, y = -jnp.minimum(push / size, air.grip) * slip
    spun = (reciprocal(air.grip) - 1.0) * jnp.stack([y, -x, jnp.zeros_like(x)])
    vel = jnp.stack([ball.vel[0] + x, ball.vel[1] + y, -air.restitution * ball.vel[2]])
    return SpinningBall(ball.pos, vel, ball.drag, ball.lift + spun * reciprocal(air.reach))


def spin_flight(
    ball: SpinningBall, times: Array, air: Surroundings, *, bounces: int, steps: int
) -> tuple[Array, Array]:
    """Return positions (N, 3) [m] and velocities (N, 3) [m/s] of a ball at times (N,) >= 0 [s].

    Each flight between two bounces is integrated in equal steps, and a cubic Hermite polynomial
    interpolates the positions. Each bounce starts a new flight at its exact time. The first
    `bounces` bounces are simulated; after them the ball falls through the plane.
    """
    end, start = jnp.max(times), jnp.zeros((), times.dtype)
    pos = vel = jnp.zeros((*times.shape, 3), times.dtype)
    for flight in range(bounces + 1):
        step = (end - start) / steps

        def advance(
            state: SpinningBall, _: None, step: Array = step
        ) -> tuple[SpinningBall, SpinningBall]:
            return spin_step(state, step, air), state

        last, before = lax.scan(advance, ball, None, length=steps)
        nodes = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), before, last)
        p, v = nodes.pos, nodes.vel
        where = jnp.clip((times - start) / jnp.where(step > 0.0, step, 1.0), 0.0, steps)
        k = jnp.minimum(where.astype(jnp.int32), steps - 1)
        u, h = (where - k.astype(times.dtype))[:, None], step
        way, a, b = p[k + 1] - p[k], h * v[k], h * v[k + 1]
        here = p[k] + u * (a + u * (3.0 * way - 2.0 * a - b + u * (a + b - 2.0 * way)))
        is_later = (times >= start)[:, None] if flight else True
        pos = jnp.where(is_later, here, pos)
        vel = jnp.where(is_later, v[k] + u * (v[k + 1] - v[k]), vel)
        if flight < bounces:
            ball, start = _next_flight(nodes, step, start, end, air)
    return pos, vel


def _next_flight(
    nodes: SpinningBall, step: Array, start: Array, end: Array, air: Surroundings
) -> tuple[SpinningBall, Array]:
    """Return the ball after its first bounce and the time of that bounce; `end` if none."""
    hits = (nodes.pos[1:, 2] < air.height) & (nodes.vel[1:, 2] < 0.0)
    first, bounced = jnp.argmax(hits), jnp.any(hits)
    before = jax.tree.map(lambda leaf: leaf[first], nodes)

    def newton(after: Array) -> Array:
        now = spin_step(before, after, air)
        return after - (now.pos[2] - air.height) / jnp.minimum(now.vel[2], -_LEAST_SPEED)

    above = jnp.maximum(before.pos[2] - air.height, 0.0)
    fall = jnp.sqrt(at_least(before.vel[2] ** 2 + 2.0 * air.gravity * above, _LEAST_SPEED**2))
    after = jnp.clip((before.vel[2] + fall) / jnp.maximum(air.gravity, _LEAST_SPEED), 0.0, step)
    # The last step of Newton's method has the derivatives of the implicit function theorem.
    after = newton(lax.stop_gradient(newton(newton(after))))
    ball = spin_bounce(spin_step(before, after, air), air)
    ball = jax.tree.map(lambda a, b: jnp.where(bounced, a, b[-1]), ball, nodes)
    return ball, jnp.where(bounced, start + first.astype(step.dtype) * step + after, end)
