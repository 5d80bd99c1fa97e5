"""Tables of a ball's flight: states at times whose spacing grows as the ball slows down.

Quadratic drag K_D slows a ball of initial speed v_0 down like 1 / (1 + K_D v_0 t). Equal steps of
ln(1 + p t), with a pace p [1/s] near K_D v_0, therefore change the velocity by similar factors. The
states are integrated at a fixed number of such times, and a quintic Hermite polynomial interpolates
position, velocity and acceleration. The number of steps is fixed because reverse-mode derivatives
need it; the times depend on the ball. World frame, z up, SI units.
"""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import PyTree

from planner_jax.ball.flight import BallState, ball_acceleration, rk4_step
from planner_jax.core.arithmetic import Numbers, numpy_of, reciprocal
from planner_jax.lanes import with_kernel

State = TypeVar("State")

NODES = 36  # number of states of a table
SUBSTEPS = 3  # number of Runge-Kutta steps between two states
SHORTEST = 0.01  # [s], least duration of a table; a ball on the ground lands at once
_LEAST_GROWTH = 1e-2  # of pace times duration; with less the times are equally spaced
_SMALL = 1e-6  # smaller arguments of quotients such as atan(x) / x count as this number
_ERROR = 1e-4  # [m], greatest error of a table that `is_resolved` permits
_ERROR_UNIT = 3e-4  # error of a table, divided by the fourth power of its steps, times K_D
_LASTING = 3.0  # time constants after which a falling ball has its terminal velocity
# Greatest last steps: in time constants of the drag (then Runge-Kutta is stable), and by lift [rad]
_LONGEST_STEP, _WIDEST_TURN = 4.0, 0.3


@struct.dataclass
class FlightTable:
    """States of a ball at N increasing times from 0 on."""

    pos: Array  # (N, 3) [m]
    vel: Array  # (N, 3) [m/s]
    acc: Array  # (N, 3) [m/s^2]
    times: Array  # (N,) [s]
    growth: Array  # () pace times duration, which determines the times

    def at(self, time: Array) -> BallState:
        """Return position and velocity at one time () [s], by quintic interpolation.

        Before the first and after the last time of the table the ball keeps its velocity.
        """
        inside = lax.clamp(jnp.zeros_like(time), time, self.times[-1])
        intervals = self.times.shape[0] - 1
        share = jnp.log1p(self.growth * inside / self.times[-1]) / jnp.log1p(self.growth)
        index = jnp.clip(jnp.floor(intervals * share), 0, intervals - 1).astype(jnp.int32)
        read = lambda leaf: lax.dynamic_slice_in_dim(leaf, index, 2)  # noqa: E731
        pos, vel, acc, (start, end) = map(read, (self.pos, self.vel, self.acc, self.times))
        h = end - start
        u = (inside - start) * reciprocal(h)
        a, b, c = h * vel[0], 0.5 * h * h * acc[0], 0.5 * h * h * acc[1]
        # Position, slope and curvature that remain at the end of the interval.
        p, s, k = pos[1] - pos[0] - a - b, h * vel[1] - a - 2.0 * b, c - b
        d, e, f = 10.0 * p - 4.0 * s + k, 7.0 * s - 15.0 * p - 2.0 * k, 6.0 * p - 3.0 * s + k
        here = pos[0] + u * (a + u * (b + u * (d + u * (e + u * f))))
        rate = a + u * (2.0 * b + u * (3.0 * d + u * (4.0 * e + u * 5.0 * f)))
        rate = rate * reciprocal(h)
        return BallState(pos=here + rate * (time - inside), vel=rate)

    def highest(self) -> Array:
        """Return the greatest height () [m] of a ball that may rise at first, then falls."""
        up, down = self.vel[:, 2], self.acc[:, 2]
        last = jnp.clip(jnp.sum(up > 0.0) - 1, 0, up.shape[0] - 2)
        fall = jnp.maximum(up[last] - up[last + 1], 1e-6)
        step = self.times[last + 1] - self.times[last]
        time = self.times[last] + step * jnp.clip(up[last] / fall, 0.0, 1.0)
        time = lax.stop_gradient(time)
        slope = jnp.minimum(0.5 * (down[last] + down[last + 1]), -0.1)
        time = lax.stop_gradient(time - self.at(time).vel[2] / slope)
        # One more step of Newton's method has the derivatives of the time of the top.
        slope = jax.jvp(lambda t: self.at(t).vel[2], (time,), (jnp.ones_like(time),))[1]
        time = time - self.at(time).vel[2] / lax.stop_gradient(jnp.minimum(slope, -0.1))
        return self.at(jnp.where(up[0] > 0.0, time, 0.0)).pos[2]


def longest_flight(ball: BallState, drag: Numbers, gravity: Numbers) -> PyTree:
    """Return a time (...) [s] at which the ball is below the ground z = 0, at least `SHORTEST`.

    A rising ball has at least the ratio of speed and vertical speed that it has at first, so that
    it rises no higher than a vertical throw with the drag K_D |v| / v_z. The following fall of a
    height H takes at most 2 H / (f_0 + f_1) or H / f_1, for the rates of fall f_0 and f_1 at its
    ends. For a fast horizontal motion, which slows the fall, 80 % more are added. Without drag the
    result is 1.1 times the exact time. `ball` has leaves (..., 3), the numbers shape (...).
    """
    xp, speed = numpy_of(ball.pos, ball.vel, drag, gravity), _speed(ball)
    rise, fall = xp.maximum(ball.vel[..., 2], 0.0), xp.maximum(-ball.vel[..., 2], 0.0)
    braked = xp.maximum(drag * speed * rise / gravity, _SMALL)
    root = xp.sqrt(braked)
    up = rise / gravity * xp.arctan(root) / root
    height = xp.maximum(ball.pos[..., 2], 0.0)
    height = height + 0.5 * rise * rise / gravity * xp.log1p(braked) / braked
    folds = xp.maximum(2.0 * drag * height, _SMALL)
    kept = xp.exp(-xp.minimum(folds * speed / xp.maximum(fall, 1e-3), 50.0))
    final = fall * fall * kept + 2.0 * gravity * height * -xp.expm1(-folds) / folds
    final = xp.maximum(xp.sqrt(final), 1e-3)
    down = height / xp.minimum(0.5 * (fall + final), final)
    aside = drag * speed * down / (1.0 + drag * speed * up)
    return xp.maximum((up + down) * (1.1 + 0.8 * aside / (1.0 + aside)), SHORTEST)


def is_resolved(
    ball: BallState, drag: Numbers, gravity: Numbers, turn: Numbers | float = 0.0
) -> Numbers:
    """Return whether a table of a ball's flight to the ground is right to 0.1 mm, bool (...).

    The steps of a table are measured in the time constant 1 / sqrt(g K_D) of the drag, and in
    factors of the decreasing speed. The bound on their error is the greatest error of 4,000 random
    flights, with K_D up to 1,000 /m and speeds up to 1,000 m/s. `turn` (...) [1/s] is the rate at
    which lift turns the velocity.
    """
    horizon = longest_flight(ball, drag, gravity)
    xp = numpy_of(horizon)
    pace = pace_of(_speed(ball) ** 2, drag, gravity)
    growth = xp.maximum(pace * horizon, _LEAST_GROWTH)
    share, rate = xp.log1p(growth) / (NODES - 1), xp.sqrt(gravity * drag)
    last = share * (horizon / growth + horizon)
    curved = share * (rate * horizon / growth + xp.minimum(rate * horizon, _LASTING))
    error = _ERROR_UNIT * (curved**4 + share**4)
    is_exact = error <= _ERROR * xp.maximum(drag, _SMALL)
    return is_exact & (rate * last <= _LONGEST_STEP) & (turn * last <= _WIDEST_TURN)


def _speed(ball: BallState) -> Numbers:
    return numpy_of(ball.vel).sqrt((ball.vel * ball.vel).sum(axis=-1))


def pace_of(squared_speed: Numbers, drag: Numbers, gravity: Numbers) -> PyTree:
    """Return a rate (...) [1/s] at which drag and gravity change a velocity at first."""
    return numpy_of(squared_speed, drag, gravity).sqrt(
        drag * (drag * squared_speed + 0.25 * gravity)
    )


def graded_times(pace: Array, duration: Array, num: int) -> tuple[Array, Array]:
    """Return times (num,) [s] from 0 to the duration () [s], and their growth: pace * duration.

    Between two times ln(1 + pace t) grows equally. `pace` () [1/s] is a rate at which the velocity
    changes at time 0. The times are constant fractions of the duration in derivatives.
    """
    growth = lax.stop_gradient(jnp.maximum(pace * duration, _LEAST_GROWTH))
    equal = jnp.asarray(np.arange(num) / (num - 1), growth.dtype)
    shares = jnp.expm1(equal * jnp.log1p(growth)) * reciprocal(growth)
    return duration * lax.stop_gradient(shares), growth


def integrate_at(
    step: Callable[[State, Array], State], state: State, times: Array, substeps: int
) -> State:
    """Return the states at N times (N,) [s], leaves (N, ...), from the state at the first time.

    `step(state, duration)` integrates over a part of an interval; each interval has `substeps`.
    """
    steps = jnp.repeat((times[1:] - times[:-1]) / substeps, substeps)

    def advance(now: PyTree, duration: Array) -> tuple[PyTree, PyTree]:
        after = step(now, duration)
        return after, after

    _, later = lax.scan(advance, state, steps)
    return jax.tree.map(
        lambda a, b: jnp.concatenate([a[None], b[substeps - 1 :: substeps]]), state, later
    )


def tabulate_flight(ball: BallState, horizon: Array, drag: Array, gravity: Array) -> FlightTable:
    """Return the table of a ball's flight with quadratic drag K_D () [1/m] up to `horizon` () [s].

    The table is right to 0.1 mm where `is_resolved` holds. Its times are constants in derivatives.
    """
    pace = pace_of(jnp.sum(ball.vel**2), drag, gravity)
    times, growth = graded_times(pace, lax.stop_gradient(horizon), NODES)
    pos, vel = _nodes(ball.pos, ball.vel, times, drag, gravity)
    return _table_of(pos, vel, times, growth, drag, gravity)


def fly_out(vel: Array, duration: Array, drag: Array, gravity: Array, num: int) -> FlightTable:
    """Return the table, of `num` states, of a flight from the origin in a duration () [s]."""
    times, growth = graded_times(pace_of(jnp.sum(vel**2), drag, gravity), duration, num)
    ball = BallState(jnp.zeros_like(vel), vel)
    nodes = integrate_at(lambda now, h: rk4_step(now, h, drag, gravity), ball, times, 1)
    return _table_of(nodes.pos, nodes.vel, times, growth, drag, gravity)


def _table_of(
    pos: Array, vel: Array, times: Array, growth: Array, drag: Array, gravity: Array
) -> FlightTable:
    acc = jax.vmap(lambda each: ball_acceleration(each, drag, gravity))(vel)
    return FlightTable(pos, vel, acc, times, growth)


def _integrate(pos: Array, vel: Array, times: Array, drag: Array, gravity: Array) -> tuple:
    step = lambda now, h: rk4_step(now, h, drag, gravity)  # noqa: E731
    nodes = integrate_at(step, BallState(pos, vel), times, SUBSTEPS)
    return nodes.pos, nodes.vel


_KERNEL = "planner_jax.ball.flight_kernel:table_kernel"


@functools.cache
def _slopes(moving: tuple[int, ...]) -> Callable:
    return with_kernel(jax.jacfwd(_integrate, argnums=moving), _KERNEL, NODES, SUBSTEPS, moving)


def _nodes_jvp(primals: tuple, tangents: tuple) -> tuple:
    nodes = _nodes(*primals)
    moving = [k for k, each in enumerate(tangents) if not isinstance(each, SymbolicZero)]
    changes = [jnp.zeros_like(leaf) for leaf in nodes]
    if 0 in moving:  # a displacement of the initial position displaces the whole path
        changes[0] = changes[0] + tangents[0][None]
    if further := tuple(k for k in moving if k not in (0, 2)):  # the times are constants
        for k, by in enumerate(_slopes(further)(*primals)):
            for argument, slope in zip(further, by, strict=True):
                by_component = slope.reshape(*nodes[k].shape, -1)
                change = tangents[argument].reshape(1, 1, -1)
                changes[k] = changes[k] + (by_component * change).sum(axis=-1)
    return nodes, tuple(changes)


_nodes = with_kernel(_integrate, _KERNEL, NODES, SUBSTEPS, jvp=_nodes_jvp)
