"""Prediction of a ball's flight: a table of integrated states, interpolated between its nodes.

The flight is integrated once into a table [Yu2023bat, Section III-C, eqs 8 to 10]. Cubic
convolution [Keys1981], with the kernel's parameter a = -1/2, interpolates the table at any time.
The interpolated position has a continuous time derivative.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState, require_ball, rk4_step
from planner_jax.ball.flight_table import integrate_at
from planner_jax.core.arithmetic import reciprocal
from planner_jax.core.checks import require_kind, require_number, require_scalar
from planner_jax.core.choices import require_size
from planner_jax.core.origin import split_far, to_world
from planner_jax.core.rules import NOT_NEGATIVE, POSITIVE, Field, Table

LEAST_NODES = 5  # least number of nodes of a table


@struct.dataclass
class PathTable:
    """Positions and velocities of a target at N nodes; node k is at time (k - 1) * resolution."""

    rules: ClassVar[Table] = (Field("resolution", None, POSITIVE),)
    positions: ClassVar[dict] = {"pos": ()}

    pos: Array  # (N, 3) [m], or (N, 2) in the plane
    vel: Array  # (N, 3) or (N, 2) [m/s]
    resolution: Array  # () [s], > 0
    count: Array | None = None  # () number of nodes without padding, as a float; None: all nodes

    def at(self, time: Array) -> BallState:
        """Return position [m] and velocity [m/s] at one time () [s], by cubic convolution."""
        return target_at(self, time)


def predict_path(
    ball: BallState, horizon: Array, drag: Array, gravity: Array, *, num_nodes: int
) -> PathTable:
    """Integrate the flight of a ball with quadratic drag into a table of states.

    There is one Runge-Kutta step of order 4 between neighbouring nodes. If the ball's position is
    in float64 NumPy arrays and over 1 km from the origin, so are the positions of the table.

    Args:
        ball: the ball at time 0.
        horizon: () [s], last time of the prediction.
        drag: () K_D [1/m].
        gravity: () [m/s^2], magnitude.
        num_nodes: number of nodes, >= 5. One is before time 0 and one after the horizon, because
            the interpolation at a time uses two nodes before and two nodes after that time.

    Raises:
        ValueError: an argument has a wrong shape or, unless it is a JAX array, is out of range.
        TypeError: an argument has a wrong type.
    """
    require_size("num_nodes", num_nodes, LEAST_NODES)
    require_ball(ball)
    require_number("horizon", horizon, POSITIVE)
    require_number("drag", drag, NOT_NEGATIVE)
    require_number("gravity", gravity)
    resolution = horizon / (num_nodes - 3)
    start, away = split_far(ball.pos)
    now = BallState(start, ball.vel)

    def step(state: BallState, duration: Array) -> BallState:
        return rk4_step(state, duration, drag, gravity)

    times = resolution * jnp.asarray(np.arange(num_nodes - 1), jnp.result_type(resolution))
    later = integrate_at(step, now, times, 1)
    nodes = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), step(now, -resolution), later)
    return PathTable(pos=to_world(nodes.pos, away), vel=nodes.vel, resolution=resolution)


def horizon_of(table: PathTable) -> Array:
    """Return the last time [s] at which a table of a path can be interpolated; the first is 0."""
    return table.resolution * (_count_nodes(table) - 3)


def _count_nodes(table: PathTable) -> Array | int:
    return table.pos.shape[0] if table.count is None else table.count


def convolution_weights(u: Array) -> Array:
    """Return the weights (4,) of cubic convolution [Keys1981; Yu2023bat, eqs 8 and 10b].

    The weights multiply values at four neighbouring nodes. The point of interpolation lies between
    the second and third node, at the fraction `u` () of the interval.
    """
    far = lambda x: ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0  # noqa: E731
    near = lambda x: (1.5 * x - 2.5) * x * x + 1.0  # noqa: E731
    return jnp.stack([far(1.0 + u), near(u), near(1.0 - u), far(2.0 - u)])


def target_at(table: PathTable, time: Array) -> BallState:
    """Return position and velocity of the target at one time () [s], by cubic convolution.

    The interpolation [Yu2023bat, eq. 9] has a continuous time derivative. Before time 0 and after
    the last time of the table, the target keeps its velocity at that time.
    """
    require_kind("table", table, PathTable)
    time = jnp.asarray(require_scalar("time", time), jnp.result_type(table.resolution))
    inside = jax.lax.clamp(jnp.zeros_like(time), time, horizon_of(table))
    position = inside * reciprocal(table.resolution)
    index = jnp.clip(jnp.floor(position), 0, _count_nodes(table) - 4)
    weights = convolution_weights(position - index)
    first = index.astype(jnp.int32)

    def read(nodes: Array) -> Array:
        return jnp.sum(weights[:, None] * jax.lax.dynamic_slice_in_dim(nodes, first, 4), axis=0)

    vel = read(table.vel)
    return BallState(pos=read(table.pos) + vel * (time - inside), vel=vel)
