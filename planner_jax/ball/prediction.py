"""Where the ball will be: an integrated state table, smoothed by cubic convolution.

[Yu2023bat, Section III-C] (eqs 8-10): the flight is integrated once into a table of states,
and Keys' kernel (a = -1/2) [Keys1981] reads it at any time with a continuous gradient.
"""

import functools
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jax.custom_derivatives import SymbolicZero

from planner_jax.ball.flight import BallState, require_ball, rk4_step
from planner_jax.core.arithmetic import reciprocal
from planner_jax.core.checks import require_kind, require_number, require_scalar
from planner_jax.core.choices import require_size
from planner_jax.core.rules import NOT_NEGATIVE, POSITIVE, Field, Table
from planner_jax.lanes import with_kernel

LEAST_NODES = 5  # of a table


@struct.dataclass
class PathTable:
    """States of a target at equal time steps. Node k is at time (k - 1) * resolution."""

    rules: ClassVar[Table] = (Field("resolution", None, POSITIVE),)

    pos: Array  # (N, 3) [m]
    vel: Array  # (N, 3) [m/s]
    resolution: Array  # () [s], > 0

    def at(self, time: Array) -> BallState:
        """State of the target at one time () [s], as `target_at`: a `TargetPath`."""
        return target_at(self, time)


def predict_path(
    ball: BallState, horizon: Array, drag: Array, gravity: Array, *, num_nodes: int
) -> PathTable:
    """The table of a ball in flight with quadratic drag, one Runge-Kutta step a node.

    Args:
        ball: the ball at time 0.
        horizon: () [s], the table answers times from 0 to here.
        drag: () K_D [1/m].
        gravity: () [m/s^2], magnitude.
        num_nodes: N >= 5. One node lies before time 0 and one past the horizon, because the
            kernel reads two nodes on each side.

    Raises:
        ValueError: an argument has another shape or, unless it is a jax array, is out of its range.
        TypeError: an argument is of another kind.
    """
    require_size("num_nodes", num_nodes, LEAST_NODES)
    require_ball(ball)
    require_number("horizon", horizon, POSITIVE)
    require_number("drag", drag, NOT_NEGATIVE)
    require_number("gravity", gravity)
    resolution = horizon / (num_nodes - 3)
    pos, vel = _integrated(num_nodes)(ball.pos, ball.vel, resolution, drag, gravity)
    return PathTable(pos=pos, vel=vel, resolution=resolution)


@functools.cache
def _integrated(num_nodes: int) -> Callable:
    """Positions and velocities (N, 3) at the nodes, with a kernel for many lanes.

    They are differentiated forward, along with the flight, whatever JAX asks for: there are few
    numbers to differentiate by, and nothing has to be kept for a way back.
    """

    def integrated(
        pos: Array, vel: Array, resolution: Array, drag: Array, gravity: Array
    ) -> tuple[Array, Array]:
        ball = BallState(pos, vel)
        before = rk4_step(ball, -resolution, drag, gravity)

        def advance(state: BallState, _: None) -> tuple[BallState, BallState]:
            after = rk4_step(state, resolution, drag, gravity)
            return after, after

        _, later = jax.lax.scan(advance, ball, None, length=num_nodes - 2)
        nodes = jax.tree.map(
            lambda a, b, c: jnp.concatenate([a[None], b[None], c]), before, ball, later
        )
        return nodes.pos, nodes.vel

    path = "planner_jax.ball.prediction_kernel:table_kernel"

    @functools.cache
    def slopes(moving: tuple[int, ...]) -> Callable:
        """Derivatives of positions, then of velocities, by some arguments."""
        derivatives = jax.jacfwd(integrated, argnums=moving)
        return with_kernel(derivatives, path, num_nodes, moving)

    def moved(primals: tuple, tangents: tuple) -> tuple:
        nodes = integrated_in_lanes(*primals)
        moving = tuple(k for k, t in enumerate(tangents) if not isinstance(t, SymbolicZero))
        further = tuple(k for k in moving if k > 0)
        found = [jnp.zeros_like(leaf) for leaf in nodes]
        if 0 in moving:  # the whole path moves with its first point
            found[0] = found[0] + tangents[0]
        if further:
            for k, by in enumerate(slopes(further)(*primals)):
                for place, slope in zip(further, by, strict=True):
                    along = slope * tangents[place]
                    of_vector = tangents[place].ndim > 0
                    found[k] = found[k] + (jnp.sum(along, axis=-1) if of_vector else along)
        return nodes, tuple(found)

    integrated_in_lanes = with_kernel(integrated, path, num_nodes, jvp=moved)
    return integrated_in_lanes


def horizon_of(table: PathTable) -> Array:
    """Last time [s] that the table answers; the first is 0."""
    return table.resolution * (table.pos.shape[0] - 3)


def convolution_weights(u: Array) -> Array:
    """Keys' weights of the four nodes around a point [Yu2023bat, eqs 8 and 10b].

    Args:
        u: () fraction of the way from the second to the third node, 0 to 1.

    Returns:
        (4,), which sum to one.
    """
    far = lambda x: ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0  # noqa: E731
    near = lambda x: (1.5 * x - 2.5) * x * x + 1.0  # noqa: E731
    return jnp.stack([far(1.0 + u), near(u), near(1.0 - u), far(2.0 - u)])


def target_at(table: PathTable, time: Array) -> BallState:
    """State of the target at one time, with a gradient in time that is continuous.

    Inside the table both position and velocity are cubic convolutions [Yu2023bat, eq. 9].
    Outside [0, horizon] the target goes on from the end of the table at the velocity it has
    there: defined and differentiable.

    Args:
        table: N nodes.
        time: () [s].
    """
    require_kind("table", table, PathTable)
    require_scalar("time", time)
    inside = jax.lax.clamp(jnp.zeros_like(time), time, horizon_of(table))
    position = inside * reciprocal(table.resolution)
    index = jnp.clip(jnp.floor(position), 0, table.pos.shape[0] - 4)
    weights = convolution_weights(position - index)
    first = index.astype(jnp.int32)

    def read(nodes: Array) -> Array:
        window = jax.lax.dynamic_slice_in_dim(nodes, first, 4)
        return jnp.sum(weights[:, None] * window, axis=0)

    vel = read(table.vel)
    return BallState(pos=read(table.pos) + vel * (time - inside), vel=vel)
