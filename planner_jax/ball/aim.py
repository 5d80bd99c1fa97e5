"""Which velocity takes a ball to a target in a given time, and how high it flies on the way.

Derivatives are made going forward, and reverse mode only multiplies by them: it would otherwise go
back through every step of a flight for the slopes of a few numbers.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from planner_jax.ball.flight import BallState, fly, gravity_vector
from planner_jax.core.arithmetic import reciprocal

_FLIGHT_STEPS = 10  # the landing of a 2 s flight is then right to 0.2 mm
_COARSE_STEPS = 8  # enough for slopes; fewer go astray where drag is strong

Tangent = Array | SymbolicZero


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

    From the drag-free velocity two steps of Newton's method on the landing of a coarse flight,
    and with the slopes of the last one two steps on that of a fine flight. The derivatives are
    those of the root, by the implicit function theorem.

    Args:
        pos: (3,) [m].
        target: (3,) [m].
        flight_time: () [s], > 0.
        drag: () K_D [1/m].
        gravity: () [m/s^2], magnitude.

    Returns:
        (3,) [m/s].
    """
    return _aimed(target - pos, jnp.asarray(flight_time), jnp.asarray(drag), jnp.asarray(gravity))


@jax.custom_jvp
def _aimed(way: Array, flight_time: Array, drag: Array, gravity: Array) -> Array:
    """`aim_with_drag` over a way (3,) [m]."""

    def newton_step(_: Array, near: tuple[Array, Array]) -> tuple[Array, Array]:
        def landing(vel: Array) -> tuple[Array, Array]:
            landed = _way(vel, flight_time, drag, gravity, _COARSE_STEPS)
            return landed, landed

        vel, _ = near
        slope, landed = jax.jacfwd(landing, has_aux=True)(vel)
        return vel - _solve3(slope, landed - way), slope

    # Loops, not copies: the program that an optimiser compiles is a third the size.
    start = aim_drag_free(jnp.zeros_like(way), way, flight_time, gravity)
    vel, slope = lax.fori_loop(0, 2, newton_step, (start, jnp.eye(3, dtype=start.dtype)))

    def chord_step(_: Array, vel: Array) -> Array:
        return vel - _solve3(slope, _way(vel, flight_time, drag, gravity) - way)

    return lax.fori_loop(0, 2, chord_step, vel)


def _aimed_jvp(primals: Sequence[Array], tangents: Sequence[Tangent]) -> tuple[Array, Array]:
    way, *given = primals
    by_way, *others = tangents
    vel = _aimed(way, *given)
    moving = _moving(others)
    by_vel, *slopes = jax.jacfwd(_way, (0, *(k + 1 for k in moving)))(vel, *given)
    changes = [-slope * others[k] for k, slope in zip(moving, slopes, strict=True)]
    if not isinstance(by_way, SymbolicZero):
        changes.append(by_way)
    return vel, _solve3(by_vel, sum(changes[1:], changes[0]))


def _moving(tangents: Sequence[Tangent]) -> list[int]:
    """Places of the arguments that change at all."""
    return [k for k, each in enumerate(tangents) if not isinstance(each, SymbolicZero)]


_aimed.defjvp(_aimed_jvp, symbolic_zeros=True)


def _way(
    vel: Array, flight_time: Array, drag: Array, gravity: Array, num_steps: int = _FLIGHT_STEPS
) -> Array:
    """Where a ball is after a flight (3,) [m], from where it began."""
    ball = BallState(pos=jnp.zeros_like(vel), vel=vel)
    return fly(ball, flight_time, drag, gravity, num_steps=num_steps)[0].pos


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
    given = jnp.asarray(flight_time), jnp.asarray(drag), jnp.asarray(gravity)
    return ball.pos[2] + _climb(ball.vel, *given)


def _climbed(vel: Array, flight_time: Array, drag: Array, gravity: Array) -> Array:
    """`apex_with_drag` over where the ball is now."""
    now = BallState(pos=jnp.zeros_like(vel), vel=vel)
    _, path = fly(now, flight_time, drag, gravity, num_steps=_FLIGHT_STEPS)
    height = jnp.concatenate([now.pos[None, 2], path.pos[:-1, 2]])
    vels = jnp.concatenate([vel[None], path.vel[:-1]])
    rising = jnp.maximum(vels[:, 2], 0.0)
    speed = jnp.sqrt(jnp.maximum(jnp.sum(vels**2, axis=1), 1e-12))
    reach = height + 0.5 * rising**2 / (gravity + drag * speed * rising * 2.0 / 3.0)
    last = jnp.maximum(jnp.sum(vels[:, 2] > 0.0) - 1, 0)
    return reach[last]


_climb = jax.custom_jvp(_climbed)


def _climb_jvp(primals: Sequence[Array], tangents: Sequence[Tangent]) -> tuple[Array, Array]:
    moving = _moving(tangents)
    slopes = jax.jacfwd(_climbed, moving)(*primals)
    changes = [jnp.sum(slope * tangents[k]) for k, slope in zip(moving, slopes, strict=True)]
    return _climb(*primals), sum(changes[1:], changes[0])


_climb.defjvp(_climb_jvp, symbolic_zeros=True)
