"""MINCO: the minimum-energy piecewise polynomial through given waypoints (paper 002, eq. 19).

For energy order s the optimum is 2s - 2 times differentiable and of degree 2s - 1 on every
piece. We find it by minimising the energy over the derivatives 1..s-1 at the inner nodes: a
block-tridiagonal positive-definite system, solved in one sweep forward and one back, so time
is linear in the pieces both for the map and, through `jax.grad`, for its reverse.

Wang, Zhou, Xu, Gao, "Geometrically Constrained Trajectory Optimization for Multicopters".
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.trajectory.polynomial import PiecewisePolynomial, derivative_factors

_HIGHEST = lax.Precision.HIGHEST


@functools.cache
def hermite_map(order: int) -> np.ndarray:
    """Unit-time coefficients from end derivatives, (2s, 2s) float64.

    Columns: derivatives 0..s-1 at time 0, then the same at time 1.
    """
    size = 2 * order
    ends = np.zeros((size, size))
    for d in range(order):
        ends[d, d] = math.factorial(d)
        ends[order + d] = derivative_factors(size - 1, d)
    return np.linalg.inv(ends)


@functools.cache
def hermite_energy(order: int) -> np.ndarray:
    """Energy of a unit-time piece as a quadratic form in its end derivatives, (2s, 2s)."""
    size = 2 * order
    factors = derivative_factors(size - 1, order)
    powers = np.arange(size)
    exponents = np.maximum(powers[:, None] + powers[None, :] - 2 * order + 1, 1)
    gram = np.outer(factors, factors) / exponents
    hermite = hermite_map(order)
    return hermite.T @ gram @ hermite


def minco(
    head_state: Array, tail_state: Array, waypoints: Array, durations: Array
) -> PiecewisePolynomial:
    """The trajectory of least integral |p^(s)|^2 with given ends, waypoints and durations.

    Args:
        head_state: (s, 3) position and derivatives up to s - 1 at the start; s = 2, 3 or 4.
        tail_state: (s, 3) the same at the end.
        waypoints: (M - 1, 3) [m], positions between the pieces; may be empty.
        durations: (M,) [s], > 0.

    Returns:
        M pieces of degree 2s - 1.
    """
    order = head_state.shape[0]
    if order not in (2, 3, 4):
        raise ValueError(f"head_state must have 2, 3 or 4 rows, got {order}")
    pieces = durations.shape[0]
    if waypoints.shape[0] != pieces - 1:
        raise ValueError(f"waypoints must be (M - 1, 3) = ({pieces - 1}, 3), got {waypoints.shape}")
    # Row d of a node, times duration^d, is the derivative in the piece's own unit time.
    scale = durations[:, None] ** jnp.arange(order)  # (M, s)
    both = jnp.concatenate([scale, scale], axis=1)
    energy = jnp.asarray(hermite_energy(order), durations.dtype)
    energy = energy * both[:, :, None] * both[:, None, :]
    energy = energy / durations[:, None, None] ** (2 * order - 1)

    inner = _inner_derivatives(head_state, tail_state, waypoints, energy)
    nodes = jnp.concatenate(
        [
            head_state[None],
            jnp.concatenate([waypoints[:, None], inner], axis=1),
            tail_state[None],
        ]
    )
    ends = jnp.concatenate([nodes[:-1], nodes[1:]], axis=1) * both[:, :, None]
    unit = jnp.einsum(
        "kl,mli->mki", jnp.asarray(hermite_map(order), durations.dtype), ends, precision=_HIGHEST
    )
    powers = durations[:, None] ** jnp.arange(2 * order)
    return PiecewisePolynomial(coeffs=unit / powers[:, :, None], durations=durations)


def _inner_derivatives(
    head_state: Array, tail_state: Array, waypoints: Array, energy: Array
) -> Array:
    """Derivatives 1..s-1 at the inner nodes that make the energy least, (M - 1, s - 1, 3).

    Stationarity at node i couples it with its two neighbours: a block-tridiagonal system
    L_i x_{i-1} + D_i x_i + L_{i+1}^T x_{i+1} = r_i, here by block elimination.
    """
    s = head_state.shape[0]
    left, right = energy[:-1], energy[1:]  # the pieces before and after each inner node
    diagonal = left[:, s + 1 :, s + 1 :] + right[:, 1:s, 1:s]
    upper = right[:, 1:s, s + 1 :]  # to the next node's derivatives

    before = jnp.concatenate([head_state[None, 0], waypoints[:-1]])
    after = jnp.concatenate([waypoints[1:], tail_state[None, 0]])
    times = functools.partial(jnp.einsum, "mk,mi->mki", precision=_HIGHEST)
    rhs = -(
        times(left[:, s + 1 :, 0], before)
        + times(left[:, s + 1 :, s] + right[:, 1:s, 0], waypoints)
        + times(right[:, 1:s, s], after)
    )
    if waypoints.shape[0] == 0:
        return rhs
    product = functools.partial(jnp.matmul, precision=_HIGHEST)
    rhs = rhs.at[0].add(-product(left[0, s + 1 :, 1:s], head_state[1:]))
    rhs = rhs.at[-1].add(-product(upper[-1], tail_state[1:]))
    lower = jnp.concatenate([jnp.zeros_like(upper[:1]), jnp.swapaxes(upper[:-1], 1, 2)])

    def eliminate(carry, row):
        ahead, value = carry
        d, low, up, r = row
        pivot = d - product(low, ahead)
        solved = jnp.linalg.solve(pivot, jnp.concatenate([up, r - product(low, value)], axis=1))
        carry = solved[:, : s - 1], solved[:, s - 1 :]
        return carry, carry

    def substitute(x_next, row):
        ahead, value = row
        x = value - product(ahead, x_next)
        return x, x

    zero = jnp.zeros_like(diagonal[0]), jnp.zeros_like(rhs[0])
    _, rows = jax.lax.scan(eliminate, zero, (diagonal, lower, upper, rhs))
    _, inner = jax.lax.scan(substitute, jnp.zeros_like(rhs[0]), rows, reverse=True)
    return inner
