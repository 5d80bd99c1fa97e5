"""The initial velocity with which a ball reaches a target in a specified time, and its apex.

The planner of hits computes the ball's return with this module. Drag is K_D () [1/m], quadratic in
the speed; gravity is a magnitude () [m/s^2]; positions are (3,) [m]. A custom rule differentiates
the velocity by all arguments in forward mode, which stores no integration steps.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from planner_jax.ball.flight import BallState, gravity_vector
from planner_jax.ball.flight_table import fly_out
from planner_jax.core.arithmetic import reciprocal

_FLIGHT_NODES = 17  # number of states of an integrated flight
# Number of states in the first two Newton steps of `_aim`. With fewer, Newton's method diverges for
# strong drag.
_COARSE_NODES = 9

_MOST_FOLDS = 4.0  # greatest natural logarithm of a speed's decrease in the first guess

Tangent = Array | SymbolicZero


def aim_drag_free(pos: Array, target: Array, flight_time: Array, gravity: Array) -> Array:
    """Return a drag-free ball's velocity (3,) [m/s] from `pos` to `target` in `flight_time` [s]."""
    return (target - pos) * reciprocal(flight_time) - 0.5 * gravity_vector(gravity) * flight_time


def aim_with_drag(
    pos: Array, target: Array, flight_time: Array, drag: Array, gravity: Array
) -> Array:
    """Return the initial velocity (3,) [m/s] with which a ball with quadratic drag meets a target.

    The ball starts at `pos` (3,) [m], and is at `target` after `flight_time` > 0 [s]; the drag is
    K_D [1/m]. Two Newton steps from a first guess integrate the flight coarsely; two more
    integrate it finely and reuse the last Jacobian. Derivatives are implicit.
    """
    return _aim(target - pos, jnp.asarray(flight_time), jnp.asarray(drag), jnp.asarray(gravity))


@jax.custom_jvp
def _aim(displacement: Array, flight_time: Array, drag: Array, gravity: Array) -> Array:
    def newton_step(_: Array, near: tuple[Array, Array]) -> tuple[Array, Array]:
        def landing(vel: Array) -> tuple[Array, Array]:
            end = _displacement(vel, flight_time, drag, gravity, _COARSE_NODES)
            return end, end

        vel, _ = near
        slope, end = jax.jacfwd(landing, has_aux=True)(vel)
        return vel - solve3(slope, end - displacement), slope

    start = aim_drag_free(jnp.zeros_like(displacement), displacement, flight_time, gravity)
    # A ball with drag and initial speed v flies ln(1 + K_D v T) / K_D far, if it is not deflected.
    folds = jnp.clip(drag * flight_time * jnp.sqrt(jnp.sum(start * start)), 1e-6, _MOST_FOLDS)
    start = start * jnp.expm1(folds) * reciprocal(folds)
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
    vel: Array, flight_time: Array, drag: Array, gravity: Array, nodes: int = _FLIGHT_NODES
) -> Array:
    return fly_out(vel, flight_time, drag, gravity, nodes).pos[-1]


def solve3(matrix: Array, rhs: Array) -> Array:
    """Solve a 3 x 3 linear system by Cramer's rule, so that a batch needs no LAPACK calls."""
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    bc, ca, ab = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
    return jnp.stack([jnp.sum(bc * rhs), jnp.sum(ca * rhs), jnp.sum(ab * rhs)]) / jnp.sum(a * bc)


def apex_with_drag(ball: BallState, flight_time: Array, drag: Array, gravity: Array) -> Array:
    """Return the greatest height [m] of a ball with quadratic drag within `flight_time` [s].

    A falling ball is highest at time 0.
    """
    return ball.pos[2] + fly_out(ball.vel, flight_time, drag, gravity, _FLIGHT_NODES).highest()
