"""States along a plan that is being executed, and the waypoint offsets of its remainder.

Re-planners start their searches at the remainder of the previous trajectory, sampled at the
waypoints of the new trajectory.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.arithmetic import Numbers
from planner_jax.optimise.chain import ChainProblem
from planner_jax.trajectory import polynomial
from planner_jax.trajectory.proportional_minco import boundary_rows

_ORDERS = 4  # number of derivatives in a state, from position to jerk


def evaluate_pieces(coeffs: Array, time: Numbers) -> Array:
    """Return position to jerk (N, 4, 3) of N polynomials at one time (N,) [s] in each of them."""
    factors, powers = polynomial.state_basis(coeffs.shape[1])
    basis = time[:, None, None] ** jnp.asarray(powers, time.dtype)[None]
    basis *= jnp.asarray(factors, time.dtype)[None]
    return jnp.sum(basis[..., None] * coeffs[:, None], axis=2)


def sample_states(trajectory: polynomial.PiecewisePolynomial, times: Numbers) -> Array:
    """Return position to jerk (N, 4, 3) of a trajectory at times (N,) [s]."""
    ends = jnp.cumsum(trajectory.durations)
    piece = jnp.sum(times[:, None] >= ends[None, :-1], axis=1)
    return evaluate_pieces(trajectory.coeffs[piece], times - (ends - trajectory.durations)[piece])


def fit_offsets(
    problem: ChainProblem,
    trajectory: polynomial.PiecewisePolynomial,
    begins: Array,
    durations: Array,
    tails: Array,
) -> Array:
    """Return the waypoint offsets (N, M - 1, 3) with which N segments follow a trajectory.

    Args:
        problem: the problem, whose segments have M pieces.
        trajectory: the trajectory to follow.
        begins: (N,) [s], times in `trajectory` at which the segments start.
        durations: (N,) [s], durations of the segments.
        tails: (N, 4, 3), position to jerk at the ends of the segments.
    """
    proportions = problem.maps.proportions
    shares = np.cumsum(proportions) / np.sum(proportions) - proportions / np.sum(proportions)
    knots = begins[:, None] + durations[:, None] * jnp.asarray(shares, begins.dtype)[None]
    states = sample_states(trajectory, knots.ravel()).reshape(*knots.shape, _ORDERS, 3)
    heads = jnp.concatenate([states[:1, 0], tails[:-1]])
    rows = jax.vmap(boundary_rows)(heads, tails, durations / problem.num_pieces)
    along = jnp.concatenate([rows, states[:, 1:, 0]], axis=1)
    matrix = jnp.asarray(problem.maps.offsets, begins.dtype)
    return jnp.sum(matrix[None, :, :, None] * along[:, None], axis=2)
