"""Hits of spinning balls: flights with drag, lift and wind, and friction of ball and racket.

`planner_jax.ball.spin` has the model of the flight and of the impact. At the impact, the ball
bounces on the plane of the racket.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.ball import spin as spinning
from planner_jax.ball.aim import aim_with_drag, solve3
from planner_jax.ball.flight import BallState
from planner_jax.ball.flight_table import (
    NODES,
    SHORTEST,
    SUBSTEPS,
    FlightTable,
    longest_flight,
)
from planner_jax.ball.recording import BALLS, Ball
from planner_jax.ball.spin import SpinningBall
from planner_jax.core.arithmetic import at_least, numpy_of
from planner_jax.core.checks import numbers_of, require_kind
from planner_jax.core.choices import require
from planner_jax.robot.quadrotor import tangent_basis

_RETURN_NODES = 16  # number of states of the flight after the impact
_STEPS, _LONGEST = 12, 0.5  # of Newton's method: number, and length relative to the solution
# Distance from the target, relative to the flight's, at which the method ends, in single and double
# precision.
_REACHED = 1e-5, 1e-10


def with_spin(
    case: PyTree, spin: PyTree, radius: PyTree, ball: Ball | None, wind: PyTree
) -> PyTree:
    """Return the case with a ball of a radius [m] and a `spin` (3,) or (..., 3) [rad/s]."""
    ball = BALLS["table tennis"] if ball is None else ball
    require_kind("ball", ball, Ball)
    batch = case.batch_shape
    turn = numbers_of("spin", spin, batch, (3,)).astype(float)
    is_slow = abs(turn) < 1e4
    if isinstance(turn, np.ndarray):
        require(bool(is_slow.all()), "spin", "within 10,000 rad/s", spin)
    else:
        turn = jnp.where(is_slow, turn, jnp.nan)  # leads to the status BAD_INPUT
    radius = numbers_of("ball_radius", radius, batch, ()).astype(float)[..., None]

    def full(x: PyTree, *shape: int) -> Array:
        whole = numpy_of(x).broadcast_to(x, (*batch, *shape))
        return jnp.asarray(whole, case.drag.dtype)

    wind = numbers_of("wind", wind, batch, (3,))
    numbers = 0.0, case.restitution, ball.friction[0], ball.grip, ball.reach[0]
    around = spinning.Surroundings(case.gravity, full(wind, 3), *map(full, numbers))
    return case.replace(lift=full(turn * radius / ball.reach[0], 3), around=around)


def _around(case: PyTree) -> spinning.Surroundings:
    """Return the surroundings of the ball, with the gravity and the restitution of the case."""
    return case.around.replace(gravity=case.gravity, restitution=case.restitution)


def predict_spin(case: PyTree) -> FlightTable:
    """Return the path of the incoming ball until it has landed.

    Lift and wind may keep a ball in the air for longer than `longest_flight`. A first table of
    three times this duration determines when the ball lands.
    """
    ball, air = SpinningBall(case.ball.pos, case.ball.vel, case.drag, case.lift), _around(case)
    table = lambda end: spinning.tabulate_spin(ball, end, air, NODES, SUBSTEPS)  # noqa: E731
    longest = 3.0 * longest_flight(case.ball, case.drag, case.gravity)
    first = table(lax.stop_gradient(longest))
    above = jnp.cumprod((first.pos[1:, 2] > 0.0).astype(jnp.int32))
    after = jnp.minimum(jnp.sum(above) + 1, NODES - 1)
    return table(lax.stop_gradient(jnp.maximum(first.times[after], SHORTEST)))


def meet_spin(
    case: PyTree, ball: BallState, flight_time: Array, speeds: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the racket's normal and velocity, the ball's velocity after the impact, and its apex.

    The ball is at the target after `flight_time` [s]; `speeds` (2,) are the racket's speeds across
    its normal. Newton's method finds the change of the ball's velocity along the normal. The last
    value, () bool, is whether the method has converged, so that the ball reaches the target.
    """
    air, away = _around(case), case.target - ball.pos
    near = _REACHED[away.dtype == jnp.float64] * jnp.sqrt(at_least(jnp.sum(away * away), 1e-6))

    def strike(push: Array) -> tuple[Array, Array, SpinningBall]:
        size = jnp.sqrt(at_least(jnp.sum(push * push), 1e-6))
        normal = push / size
        axes = jnp.stack([*tangent_basis(normal), normal])
        speed = jnp.sum(ball.vel * normal) + size / (1.0 + case.restitution)
        racket = jnp.append(speeds, speed) @ axes
        coming = SpinningBall(ball.pos, axes @ (ball.vel - racket), case.drag, axes @ case.lift)
        leaving = spinning.spin_bounce(coming, air)
        vel, lift = racket + leaving.vel @ axes, leaving.lift @ axes
        return normal, racket, SpinningBall(ball.pos, vel, case.drag, lift)

    def flight(leaving: SpinningBall) -> FlightTable:
        return spinning.tabulate_spin(leaving, flight_time, air, _RETURN_NODES, 1)

    def miss(push: Array) -> Array:
        return flight(strike(push)[2]).pos[-1] - case.target

    def solve(miss: PyTree, push: Array) -> Array:
        def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            count, x, away = state
            change = solve3(jax.jacfwd(miss)(x), away)
            lengths = (jnp.sqrt(at_least(jnp.sum(each * each), 1e-6)) for each in (x, change))
            x = x - change * jnp.minimum(1.0, _LONGEST * next(lengths) / next(lengths))
            return count + 1, x, miss(x)

        def is_open(state: tuple[Array, Array, Array]) -> Array:
            return (state[0] < _STEPS) & (jnp.sum(state[2] ** 2) > near**2)

        return lax.while_loop(is_open, step, (jnp.zeros((), jnp.int32), push, miss(push)))[1]

    after = aim_with_drag(ball.pos, case.target, flight_time, case.drag, case.gravity)
    push = lax.custom_root(
        miss, after - ball.vel, solve, lambda slope, y: solve3(jax.jacfwd(slope)(y), y)
    )
    normal, racket, top = strike(push)
    path = flight(top)
    is_reached = jnp.sum((path.pos[-1] - case.target) ** 2) <= (100.0 * near) ** 2
    return normal, racket, top.vel, path.highest(), is_reached
