"""Trajectories through several catches: one minimum-snap segment of M pieces to each catch.

The state at a catch, position to jerk, ends one segment and begins the next. Segments of
targets that are not there are computed like the others, so that one compiled shape serves any
number of targets, and count nothing.
"""

import functools

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import state_at
from planner_jax.task.catch.case import CatchCase
from planner_jax.trajectory.polynomial import Motion, PiecewisePolynomial
from planner_jax.trajectory.proportional_minco import (
    ProportionalMinco,
    boundary_rows,
    proportional_trajectory,
    sample_motion,
    trajectory_energy,
)

_RESTING = 1e-3  # [m/s]: a target that is much slower has no way back


@struct.dataclass
class CatchContext:
    """One case with its targets in the order of catching."""

    case: CatchCase
    targets: object  # the path pytree, leaves (N, ...)
    active: Array  # (N,) bool, False for the places of absent targets
    horizon: Array  # (N,) [s]
    times: Array  # (N,) [s], first guess


def ordered_context(case: CatchCase) -> CatchContext:
    """Targets, presence and horizons in the order of catching."""
    return CatchContext(
        case=case,
        targets=jax.tree.map(lambda leaf: leaf[case.order], case.targets),
        active=case.present[case.order],
        horizon=case.horizon[case.order],
        times=case.times,
    )


def targets_at(targets, times: Array) -> BallState:
    """Where each of N targets is at its own time (N,), leaves (N, 3)."""
    return jax.vmap(state_at)(targets, times)


def facing_cosine(axis: Array, vel: Array) -> tuple[Array, Array]:
    """Cosine (N,) between net axes (N, 3) and the targets' way back, and which have a way.

    Args:
        axis: (N, 3) unit vectors.
        vel: (N, 3) [m/s], of the targets.
    """
    speed_squared = jnp.sum(vel**2, axis=1)
    moving = speed_squared > 1e-12
    speed = jnp.sqrt(jnp.where(moving, speed_squared, 1.0))
    return -jnp.sum(axis * vel, axis=1) / speed, moving


def nearest_upright(vel: Array, lean: Array) -> Array:
    """The net's axes (N, 3) nearest to upright that lean so far from the targets' way back.

    Targets that rise are taken to fly level, and of those at rest the axis is upright.

    Args:
        vel: (N, 3) [m/s], of the targets.
        lean: () [rad], from 0 to a quarter turn.
    """
    back = jnp.concatenate([-vel[:, :2], jnp.maximum(-vel[:, 2:], 0.0) + _RESTING], axis=1)
    back /= jnp.sqrt(jnp.maximum(jnp.sum(back**2, axis=1, keepdims=True), 1e-6))
    level = jnp.sqrt(jnp.maximum(jnp.sum(back[:, :2] ** 2, axis=1, keepdims=True), 1e-6))
    cosine, sine, rise = jnp.cos(lean), jnp.sin(lean), back[:, 2:]
    # The way back, turned by the lean towards upright.
    turned = jnp.concatenate(
        [(cosine - sine * rise / level) * back[:, :2], cosine * rise + sine * level], axis=1
    )
    return jnp.where(rise >= cosine, jnp.array([0.0, 0.0, 1.0], vel.dtype), turned)


@struct.dataclass
class Chain:
    """Boundary rows, offsets and mean piece durations of N segments."""

    rows: Array  # (N, 2s, 3)
    offsets: Array  # (N, M - 1, 3) whitened
    piece_durations: Array  # (N,) [s]

    @property
    def columns(self) -> Array:
        """Rows and offsets together, (N, 2s + M - 1, 3)."""
        return jnp.concatenate([self.rows, self.offsets], axis=1)


def chain_rows(head_state: Array, tail_states: Array, piece_durations: Array) -> Array:
    """Boundary rows of every segment, (N, 2s, 3).

    Args:
        head_state: (4, 3) of the whole trajectory.
        tail_states: (N, 4, 3), at the catches.
        piece_durations: (N,) [s], mean of the pieces of a segment.
    """
    heads = jnp.concatenate([head_state[None], tail_states[:-1]])
    return jax.vmap(boundary_rows)(heads, tail_states, piece_durations)


def chain_motion(maps: ProportionalMinco, nodes: int, chain: Chain, orders: int = 4) -> Motion:
    """Samples of every segment, with the snap at 5 orders; leaves with a leading axis N."""
    sample = functools.partial(sample_motion, maps, nodes, orders=orders)
    return jax.vmap(sample)(chain.columns, chain.piece_durations)


def chain_energy(maps: ProportionalMinco, chain: Chain) -> Array:
    """Integral of |snap|^2 over every segment, (N,)."""
    energy = lambda *segment: trajectory_energy(maps, *segment)  # noqa: E731
    return jax.vmap(energy)(chain.rows, chain.offsets, chain.piece_durations)


def chain_trajectory(maps: ProportionalMinco, chain: Chain, active: Array) -> PiecewisePolynomial:
    """The trajectory in N * M pieces; those of absent targets stand still for no time."""
    build = lambda *segment: proportional_trajectory(maps, *segment)  # noqa: E731
    pieces = jax.vmap(build)(chain.rows, chain.offsets, chain.piece_durations)
    ends = chain.rows[:, maps.order, :]  # positions at the catches
    last = ends[jnp.maximum(jnp.sum(active) - 1, 0)]
    still = jnp.zeros_like(pieces.coeffs).at[:, :, 0].set(last)
    coeffs = jnp.where(active[:, None, None, None], pieces.coeffs, still)
    durations = jnp.where(active[:, None], pieces.durations, 0.0)
    return PiecewisePolynomial(
        coeffs=coeffs.reshape(-1, *coeffs.shape[2:]), durations=durations.ravel()
    )
