"""MINCO splines whose piece durations are free, in a time that grows linearly with the pieces.

A spline is the piecewise polynomial p(t) of least energy, the integral of |p^(s)|^2, through
waypoints [Wang2022]. Splines of `proportional_minco` take less time to compute, but the proportions
of their durations are constant.

The unknowns are the derivatives of the orders 1 to s - 1 at the inner waypoints. The energy is a
quadratic form of them, whose matrix is symmetric, positive definite and block-tridiagonal. Two
scans over its blocks solve the linear system. Derivatives of the solution solve the same system
with another right side, so that they need as little memory and time.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array, lax

from planner_jax.ball.estimation import solve_definite
from planner_jax.core.choices import require, require_one_of
from planner_jax.trajectory.polynomial import PiecewisePolynomial, energy_form
from planner_jax.trajectory.proportional_minco import hermite_map

_ORDERS = (2, 3, 4)
_HIGHEST = lax.Precision.HIGHEST


def durations_of(tau: Array, kind: str = "exp") -> Array:
    """Return positive durations T (M,) [s] for unbounded variables tau (M,); T = 1 at tau = 0.

    Both maps increase from 0 to infinity and are twice continuously differentiable.

    Args:
        tau: (M,) or any other shape.
        kind: "exp" for T = e^tau [Yu2023catch, eq. 21]; "rational" for the map of [Wang2022]:
            T = 1 + tau + tau^2 / 2 for tau > 0, otherwise T = 1 / (1 - tau + tau^2 / 2).

    Raises:
        ArgumentError: `kind` is another word.
    """
    require_one_of(("exp", "rational"), "kind", kind)
    tau = jnp.asarray(tau)
    if kind == "exp":
        return jnp.exp(tau)
    above, below = jnp.maximum(tau, 0.0), jnp.minimum(tau, 0.0)
    return (1.0 + above + 0.5 * above**2) / (1.0 - below + 0.5 * below**2)


def minco(head: Array, tail: Array, waypoints: Array, durations: Array) -> PiecewisePolynomial:
    """Return the spline of least energy through waypoints, for given durations of its M pieces.

    The energy is the integral of the squared s-th derivative by time [Yu2023catch, eq. 17],
    [Yu2023bat, eq. 19]. The spline is 2s - 2 times differentiable by time. JAX differentiates it by
    all arguments, any number of times. The time and the memory for it are proportional to M.

    Args:
        head: (s, D), position [m] and its derivatives of the orders 1 to s - 1 at the start, for
            s = 2, 3 or 4 (least acceleration, jerk or snap) in D dimensions.
        tail: (s, D), position and derivatives at the end.
        waypoints: (M - 1, D) [m], positions at which one piece ends and the next piece starts.
        durations: (M,) [s], > 0. In float32 the greatest should be at most ten times the least.

    Returns:
        M pieces of degree 2s - 1, with coefficients (M, 2s, D).

    Raises:
        ArgumentError: `head` does not have 2, 3 or 4 rows.
    """
    import chex  # only where a function is traced, as its import takes a tenth of a second

    head, tail, waypoints, durations = map(jnp.asarray, (head, tail, waypoints, durations))
    chex.assert_rank([head, durations], [2, 1])
    (s, dim), pieces = head.shape, durations.shape[0]
    require(s in _ORDERS, "head", "of 2, 3 or 4 rows", shown=f"the shape {head.shape}")
    chex.assert_shape([tail, waypoints], [(s, dim), (pieces - 1, dim)])
    # The spline does not depend on the unit of time, so that the unit needs no derivative.
    unit = lax.stop_gradient(jnp.mean(durations))
    shares, exponents = durations / unit, jnp.arange(2 * s, dtype=durations.dtype)
    rates, powers = unit**exponents, shares[:, None] ** exponents[None]
    scale = jnp.tile(powers[:, :s], (1, 2))[..., None]  # (M, 2s, 1)
    # Energy of the pieces, as a form (M, 2s, 2s) in the derivatives at both ends.
    hermite = hermite_map(s)
    form = (hermite.T @ energy_form(2 * s - 1, s)[0] @ hermite).astype(shares.dtype)
    energy = jnp.asarray(form)[None] * (scale * scale.swapaxes(1, 2) / powers[:, -1:, None])

    def ends_of(nodes: Array, moves: Array) -> Array:
        """Return derivatives (M, 2s, D) at both ends of pieces, with positions from starts."""
        return jnp.concatenate([jnp.zeros_like(moves), nodes[:-1], moves, nodes[1:]], axis=1)

    def slope_of(nodes: Array, moves: Array) -> Array:
        by_ends = _multiply(energy, ends_of(nodes, moves))
        return by_ends[:-1, s + 1 :] + by_ends[1:, 1:s]

    start, end = (state * rates[:s, None] for state in (head, tail))
    starts = jnp.concatenate([head[:1], waypoints])
    moves = jnp.concatenate([starts[1:], tail[:1]]) - starts
    known = jnp.zeros((pieces + 1, s - 1, dim), moves.dtype)
    known = known.at[0].set(start[1:]).at[-1].set(end[1:])
    inner = _solve_chain(
        lambda x: slope_of(jnp.pad(x, ((1, 1), (0, 0), (0, 0))), jnp.zeros_like(moves[:, None])),
        energy[:-1, s + 1 :, s + 1 :] + energy[1:, 1:s, 1:s],
        energy[1:-1, 1:s, s + 1 :],
        -slope_of(known, moves[:, None]),
    )
    columns = ends_of(known.at[1:-1].set(inner), moves[:, None]) * scale
    columns = jnp.einsum("kd,mdi->mki", hermite.astype(columns.dtype), columns, precision=_HIGHEST)
    coeffs = (columns / (powers * rates[None])[..., None]).at[:, 0].set(starts)
    return PiecewisePolynomial(coeffs=coeffs, durations=durations)


def _multiply(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=_HIGHEST)


def _solve_chain(product: Callable, diagonal: Array, upper: Array, right: Array) -> Array:
    """Solve a symmetric, positive definite, block-tridiagonal system, with derivatives.

    Args:
        product: multiplies the matrix by a vector (n, m, D).
        diagonal: (n, m, m), blocks on the diagonal.
        upper: (n - 1, m, m), blocks to the right of the diagonal; their transposes are below it.
        right: (n, m, D), right sides.

    Returns:
        (n, m, D).
    """
    # Block elimination: pivots P_i = A_i - C_(i-1)^T F_(i-1) with F_i = P_i^-1 C_i.
    ahead = jnp.concatenate([upper, jnp.zeros_like(diagonal[:1])])[: len(diagonal)]
    ahead, blocks = lax.stop_gradient((ahead, diagonal))

    def eliminate(taken: Array, row: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        block, then = row
        one = jnp.eye(block.shape[0], dtype=block.dtype)
        solved = solve_definite(block - taken, jnp.concatenate([then, one], axis=1))
        factor, inverse = jnp.split(solved, 2, axis=1)
        return _multiply(then.T, factor), (factor, inverse)

    nothing = jnp.zeros(diagonal.shape[1:], diagonal.dtype)
    _, (factors, inverses) = lax.scan(eliminate, nothing, (blocks, ahead))

    def solve(_, right: Array) -> Array:
        def descend(taken: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
            factor, b = row
            return _multiply(factor.T, b - taken), b - taken

        def ascend(later: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
            factor, b = row
            x = b - _multiply(factor, later)
            return x, x

        zero = jnp.zeros(right.shape[1:], right.dtype)
        _, reduced = lax.scan(descend, zero, (factors, right))
        return lax.scan(ascend, zero, (factors, _multiply(inverses, reduced)), reverse=True)[1]

    return lax.custom_linear_solve(product, right, solve, symmetric=True)
