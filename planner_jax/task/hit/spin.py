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
from planner_jax.ball.flight import BallState, drag_free_fall_time
from planner_jax.ball.prediction import PathTable
from planner_jax.ball.recording import BALLS, Ball
from planner_jax.ball.spin import SpinningBall
from planner_jax.core.arithmetic import at_least
from planner_jax.core.checks import numbers_of, require_kind
from planner_jax.core.choices import require
from planner_jax.robot.quadrotor import tangent_basis


def with_spin(
    case: PyTree, spin: PyTree, radius: PyTree, ball: Ball | None, wind: PyTree
) -> PyTree:
    """Return the case with a ball of a radius [m] and a `spin` (3,) or (..., 3) [rad/s]."""
    ball = BALLS["table tennis"] if ball is None else ball
    require_kind("ball", ball, Ball)
    turn = numbers_of("spin", spin, case.batch_shape, (3,)).astype(float)
    require(bool((np.abs(turn) < 1e4).all()), "spin", "within 10,000 rad/s", spin)

    def full(x: PyTree, *shape: int) -> Array:
        return jnp.asarray(np.broadcast_to(x, (*case.batch_shape, *shape)), case.drag.dtype)

    numbers = 0.0, case.restitution, ball.friction[0], ball.grip, ball.reach[0]
    around = spinning.Surroundings(case.gravity, full(wind, 3), *map(full, numbers))
    return case.replace(lift=full(turn * radius / ball.reach[0], 3), around=around)


def _around(case: PyTree) -> spinning.Surroundings:
    """Return the surroundings of the ball, with the gravity and the restitution of the case."""
    return case.around.replace(gravity=case.gravity, restitution=case.restitution)


def predict_spin(case: PyTree, num_nodes: int) -> PathTable:
    """Return the path of the incoming ball until some time after it lands."""
    ball, air = SpinningBall(case.ball.pos, case.ball.vel, case.drag, case.lift), _around(case)
    numbers = jnp.arange(num_nodes, dtype=case.drag.dtype)

    def table(step: Array) -> PathTable:
        start, times = spinning.spin_step(ball, -step, air), step * numbers
        path = spinning.spin_flight(start, times, air, bounces=0, steps=num_nodes - 1)
        return PathTable(*path, step)

    fall, _ = drag_free_fall_time(case.ball, jnp.zeros_like(case.drag), case.gravity)
    step = 3.0 * jnp.maximum(fall, 0.01) / num_nodes  # lift may keep a ball in the air for longer
    above = jnp.cumprod((table(step).pos[:, 2] > 0.0).astype(step.dtype))
    return table(lax.stop_gradient(step * jnp.sum(above) / (num_nodes - 3)))


def meet_spin(
    case: PyTree, ball: BallState, flight_time: Array, speeds: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the racket's normal and velocity, the ball's velocity after the impact, and its apex.

    The ball is at the target after `flight_time` [s]; `speeds` (2,) are the racket's speeds across
    its normal. Newton's method finds the change of the ball's velocity along the normal.
    """
    air = _around(case)

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

    def miss(push: Array) -> Array:
        leaving, times = strike(push)[2], flight_time[None]
        return spinning.spin_flight(leaving, times, air, bounces=0, steps=12)[0][0] - case.target

    def solve(miss: PyTree, push: Array) -> Array:
        step = lambda _, x: x - solve3(jax.jacfwd(miss)(x), miss(x))  # noqa: E731
        return lax.fori_loop(0, 5, step, push)

    after = aim_with_drag(ball.pos, case.target, flight_time, case.drag, case.gravity)
    push = lax.custom_root(
        miss, after - ball.vel, solve, lambda slope, y: solve3(jax.jacfwd(slope)(y), y)
    )
    normal, racket, top = strike(push)
    after = top.vel
    for share in (0.4, 0.7, 1.0, 1.0):  # of the remaining time to the apex
        time = at_least(top.vel[2], 0.0) / at_least(-spinning.spin_acceleration(top, air)[2], 0.1)
        top = spinning.spin_step(top, share * time, air)
    return normal, racket, after, top.pos[2]
