"""Trajectories of N minimum-snap segments of M pieces each.

The state at the end of a segment, position to jerk, is where the next one starts. Segments that are
not there are computed like the others, so that one compiled shape serves any number of them, and
count nothing.
"""

import functools

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jaxtyping import Bool, Float

from planner_jax.trajectory.polynomial import Motion, PiecewisePolynomial
from planner_jax.trajectory.proportional_minco import (
    ProportionalMinco,
    boundary_rows,
    proportional_trajectory,
    sample_motion,
    trajectory_energy,
)


@struct.dataclass
class Chain:
    """Boundary rows, offsets and mean piece durations of N segments."""

    rows: Float[Array, "N rows 3"]
    offsets: Float[Array, "N offsets 3"]  # whitened
    piece_durations: Float[Array, " N"]  # [s]

    @property
    def columns(self) -> Float[Array, "N columns 3"]:
        """Rows and offsets together."""
        return jnp.concatenate([self.rows, self.offsets], axis=1)


def chain_rows(
    head_state: Float[Array, "4 3"],
    tail_states: Float[Array, "N 4 3"],
    piece_durations: Float[Array, " N"],
) -> Float[Array, "N 8 3"]:
    """Return the boundary rows of every segment.

    Args:
        head_state: of the whole trajectory.
        tail_states: at the end of each segment.
        piece_durations: [s], mean of the pieces of a segment.
    """
    heads = jnp.concatenate([head_state[None], tail_states[:-1]])
    return jax.vmap(boundary_rows)(heads, tail_states, piece_durations)


def chain_motion(maps: ProportionalMinco, nodes: int, chain: Chain, orders: int = 4) -> Motion:
    """Return samples of every segment, with the snap at 5 orders; leaves with a leading axis N."""
    sample = functools.partial(sample_motion, maps, nodes, orders=orders)
    return jax.vmap(sample)(chain.columns, chain.piece_durations)


def chain_energy(maps: ProportionalMinco, chain: Chain) -> Float[Array, " N"]:
    """Return the integral of |snap|^2 over every segment."""
    energy = functools.partial(trajectory_energy, maps)
    return jax.vmap(energy)(chain.rows, chain.offsets, chain.piece_durations)


def chain_trajectory(
    maps: ProportionalMinco, chain: Chain, active: Bool[Array, " N"]
) -> PiecewisePolynomial:
    """Return the trajectory of N * M pieces; pieces of absent segments stand still for no time."""
    build = functools.partial(proportional_trajectory, maps)
    pieces = jax.vmap(build)(chain.rows, chain.offsets, chain.piece_durations)
    ends = chain.rows[:, maps.order, :]  # positions at the ends of the segments
    last = ends[jnp.maximum(jnp.sum(active) - 1, 0)]
    still = jnp.zeros_like(pieces.coeffs).at[:, :, 0].set(last)
    coeffs = jnp.where(active[:, None, None, None], pieces.coeffs, still)
    durations = jnp.where(active[:, None], pieces.durations, 0.0)
    return PiecewisePolynomial(
        coeffs=coeffs.reshape(-1, *coeffs.shape[2:]), durations=durations.ravel()
    )
