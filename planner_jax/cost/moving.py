"""Keep-outs that move, such as other robots on their planned trajectories, along a trajectory."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.ball.target import TargetPath, state_at
from planner_jax.cost.along import Along
from planner_jax.cost.penalty import smooth_hinge
from planner_jax.cost.quadrotor import QuadrotorCase

_STANDING = 512  # number of times at which a robot that stands still is compared with a keep-out


@struct.dataclass
class MovingKeepOut:
    """A sphere, with its centre on a path in time, that the quadrotor must not enter."""

    path: TargetPath  # of the centre
    radius: Array  # () [m], > 0
    begin: Array  # () [s], time of the path at which the quadrotor's trajectory starts
    until: Array  # () [s], time of the path after which the centre does not move

    def excess_at(self, times: Array, pos: Array) -> Array:
        """Return the depth (K,) of K positions (K, 3) in the sphere at times, over its radius."""
        centre = jax.vmap(functools.partial(state_at, self.path))(self.begin + times).pos
        away = jnp.sqrt(jnp.sum((pos - centre) ** 2, axis=1) + 1e-12)
        return 1.0 - away / self.radius

    def later(self, time: Array) -> "MovingKeepOut":
        """Return the keep-out for a trajectory that starts `time` () [s] later."""
        return dataclasses.replace(self, begin=self.begin + time)


def split_moving(case: QuadrotorCase) -> tuple[QuadrotorCase, PyTree]:
    """Return a case without moving keep-outs, and `integrate` for these, or None without any."""
    extras: PyTree = case.extras
    moving = tuple(each for each in extras if isinstance(each, MovingKeepOut))
    still = tuple(each for each in extras if not isinstance(each, MovingKeepOut))
    integral = functools.partial(integrate, moving) if moving else None
    return dataclasses.replace(case, extras=still), integral


def integrate(
    keep_outs: tuple[MovingKeepOut, ...],
    along: Along,
    columns: Array,
    durations: Array,
    stands: bool,
    parameters: PyTree,
) -> tuple[Array, Array]:
    """Return N segments' penalties for entering keep-outs, and greatest depths (N,) over a radius.

    The segments have `columns` (N, C, 3), scaled end states and waypoint offsets, and the mean
    `durations` (N,) [s] of a piece. `along` and the `parameters` of its integral have quadrature
    and hinge. If `stands`, the quadrotor stands still after the last segment, until no centre
    moves. The depths have no derivative.
    """
    constant = functools.partial(jnp.asarray, dtype=columns.dtype)
    _, factor, width = along.split(parameters)
    hinge = lambda x: smooth_hinge(x + factor * along.margins[-1], width)  # noqa: E731
    matrix = constant(along.maps.sample_matrix(along.nodes, 0))
    pos = jnp.einsum("kc,nci->nki", matrix, columns, precision=lax.Precision.HIGHEST)
    ends = jnp.cumsum(durations * along.maps.num_pieces)
    begins = ends - durations * along.maps.num_pieces
    times = begins[:, None] + durations[:, None] * constant(along.times())[None]
    last = jnp.broadcast_to(pos[-1, -1], (_STANDING, 3))
    penalties, worst = jnp.zeros_like(durations), jnp.full_like(durations, -1.0)
    for each in keep_outs:
        excess = jax.vmap(each.excess_at)(times, pos)
        weighed = hinge(excess) * constant(along.weights())[None]
        penalties = penalties + durations * jnp.sum(weighed, axis=1)
        worst = jnp.maximum(worst, jnp.max(excess, axis=1))
        if stands:
            span = jnp.maximum(each.until - each.begin - ends[-1], 0.0)
            later = ends[-1] + span * constant(np.arange(1, _STANDING + 1) / _STANDING)
            excess = each.excess_at(later, last)
            penalties = penalties.at[-1].add(span * jnp.mean(hinge(excess)))
            worst = worst.at[-1].max(jnp.max(excess))
    return penalties, lax.stop_gradient(worst)
