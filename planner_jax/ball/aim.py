"""The initial velocity with which a ball reaches a target in a specified time, and its apex.

The planner of hits computes the ball's return with this module. Drag is K_D () [1/m], quadratic in
the speed; gravity is a magnitude () [m/s^2]; positions are (3,) [m]. Custom rules differentiate the
velocity and the apex by all arguments in forward mode, which stores no integration steps.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from planner_jax.ball.flight import BallState, fly, gravity_vector
from planner_jax.core.arithmetic import reciprocal

# Number of Runge-Kutta steps that integrate a flight; the position error is 0.2 mm after 2 s.
_FLIGHT_STEPS = 10
# Number of Runge-Kutta steps that integrate a flight in the first two Newton steps of `_aim`. With
# fewer steps, Newton's method diverges for strong drag.
_COARSE_STEPS = 8

Tangent = Array | SymbolicZero


def aim_drag_free(pos: Array, target: Array, flight_time: Array, gravity: Array) -> Array:
    """Return a drag-free ball's velocity (3,) [m/s] from `pos` to `target` in `flight_time` [s]."""
    return (target - pos) * reciprocal(flight_time) - 0.5 * gravity_vector(gravity) * flight_time


def aim_with_drag(
    pos: Array, target: Array, flight_time: Array, drag: Array, gravity: Array
) -> Array:
    """Return the initial velocity (3,) [m/s] with which a ball with quadratic drag meets a target.

    The ball starts at `pos` (3,) [m], and is at `target` after `flight_time` > 0 [s]; the drag is
    K_D [1/m]. Two Newton steps from the drag-free velocity integrate the flight coarsely; two more
    integrate it finely and reuse the last Jacobian. Derivatives are implicit.
    """
    return _aim(target - pos, jnp.asarray(flight_time), jnp.asarray(drag), jnp.asarray(gravity))


@jax.custom_jvp
def _aim(displacement: Array, flight_time: Array, drag: Array, gravity: Array) -> Array:
    def newton_step(_: Array, near: tuple[Array, Array]) -> tuple[Array, Array]:
        def landing(vel: Array) -> tuple[Array, Array]:
            end = _displacement(vel, flight_time, drag, gravity, _COARSE_STEPS)
            return end, end

        vel, _ = near
        slope, end = jax.jacfwd(landing, has_aux=True)(vel)
        return vel - solve3(slope, end - displacement), slope

    start = aim_drag_free(jnp.zeros_like(displacement), displacement, flight_time, gravity)
    vel, slope = lax.fori_loop(0, 2, newton_step, (start, jnp.eye(3, dtype=start.dtype)))

    def chord_step(_: Array, vel: Array) -> Array:
        return vel - solve3(slope, _displacement(vel, flight_time, drag, gravity) - displacement)

    return lax.fori_loop(0, 2, chord_step, vel)


def _aim_jvp(primals: Sequence[Array], tangents: Sequence[Tangent]) -> tuple[Array, Array]:
    displacement, *numbers = primals
    by_displacement, *others = tangents
    vel = _aim(displacement, *numbers)
    moving = _changing(others)
    by_vel, *slopes = jax.jacfwd(_displacement, (0, *(k + 1 for k in moving)))(vel, *numbers)
    changes = [-slope * others[k] for k, slope in zip(moving, slopes, strict=True)]
    if not isinstance(by_displacement, SymbolicZero):
        changes.append(by_displacement)
    return vel, solve3(by_vel, sum(changes[1:], changes[0]))


def _changing(tangents: Sequence[Tangent]) -> list[int]:
    return [k for k, each in enumerate(tangents) if not isinstance(each, SymbolicZero)]


_aim.defjvp(_aim_jvp, symbolic_zeros=True)


def _displacement(
    vel: Array, flight_time: Array, drag: Array, gravity: Array, num_steps: int = _FLIGHT_STEPS
) -> Array:
    ball = BallState(pos=jnp.zeros_like(vel), vel=vel)
    return fly(ball, flight_time, drag, gravity, num_steps=num_steps)[0].pos


def solve3(matrix: Array, rhs: Array) -> Array:
    """Solve a 3 x 3 linear system by Cramer's rule, so that a batch needs no LAPACK calls."""
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    bc, ca, ab = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
    return jnp.stack([jnp.sum(bc * rhs), jnp.sum(ca * rhs), jnp.sum(ab * rhs)]) / jnp.sum(a * bc)


def apex_with_drag(ball: BallState, flight_time: Array, drag: Array, gravity: Array) -> Array:
    """Return the greatest height [m] of a ball with quadratic drag within `flight_time` [s].

    The flight is integrated in steps. From the last step whose initial vertical velocity v_z is
    positive, the remaining climb is approximated by v_z^2 / (2 (g + 2/3 K_D |v| v_z)) with the drag
    coefficient K_D. A falling ball is highest at time 0.
    """
    numbers = jnp.asarray(flight_time), jnp.asarray(drag), jnp.asarray(gravity)
    return ball.pos[2] + _climb(ball.vel, *numbers)


def _compute_climb(vel: Array, flight_time: Array, drag: Array, gravity: Array) -> Array:
    now = BallState(pos=jnp.zeros_like(vel), vel=vel)
    _, path = fly(now, flight_time, drag, gravity, num_steps=_FLIGHT_STEPS)
    height = jnp.concatenate([now.pos[None, 2], path.pos[:-1, 2]])
    vels = jnp.concatenate([vel[None], path.vel[:-1]])
    rising = jnp.maximum(vels[:, 2], 0.0)
    speed = jnp.sqrt(jnp.maximum(jnp.sum(vels**2, axis=1), 1e-12))
    reach = height + 0.5 * rising**2 / (gravity + drag * speed * rising * 2.0 / 3.0)
    return reach[jnp.maximum(jnp.sum(vels[:, 2] > 0.0) - 1, 0)]


_climb = jax.custom_jvp(_compute_climb)


def _climb_jvp(primals: Sequence[Array], tangents: Sequence[Tangent]) -> tuple[Array, Array]:
    moving = _changing(tangents)
    slopes = jax.jacfwd(_compute_climb, moving)(*primals)
    changes = [jnp.sum(slope * tangents[k]) for k, slope in zip(moving, slopes, strict=True)]
    return _climb(*primals), sum(changes[1:], changes[0])


_climb.defjvp(_climb_jvp, symbolic_zeros=True)
