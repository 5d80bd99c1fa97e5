"""MINCO splines with piece durations in fixed proportion, computed by constant matrices.

MINCO is the piecewise polynomial p(t) of least energy, the integral of |p^(s)|^2 with the s-th
derivative p^(s), through waypoints [Wang2022], [Yu2023bat, eq. 19], [Yu2023catch, eq. 17]. It has
degree 2s - 1 on every piece and is 2s - 2 times differentiable.

Piece i of M lasts r_i h seconds. The proportions r_i are constant with mean one, so that h = T / M
for the duration T. With times in units of h, one constant matrix maps the boundary rows b and the
waypoints q to the coefficients, and to samples of position, velocity, acceleration and jerk. The
boundary rows are (p, v h, a h^2, j h^3) at both ends: scaled position to jerk.

The energy is a quadratic form with blocks E_qq and E_qb. The waypoints are expressed by whitened
offsets y from the waypoints of least energy for given b: q = -E_qq^-1 E_qb b + W y, with
W = R^-T / |R^-T| and E_qq = R R^T. Hence y = 0 is the smoothest trajectory for any b, and the
energy is a part that depends on b plus a multiple of |y|^2.

The velocities at the waypoints may be variables, too: whitened offsets z from the velocities of
least energy for given b and q. Their energy is the same multiple of |z|^2. A trajectory with z != 0
is 2s - 3 times differentiable.

A `Chain` is N minimum-snap segments of M pieces each. Each segment starts with the state, position
to jerk, at which the segment before it ends. Absent segments are computed and ignored, so that one
compiled program serves any number.
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jaxtyping import Bool, Float, PyTree

from planner_jax.core.arithmetic import reciprocal
from planner_jax.core.errors import ArgumentError
from planner_jax.trajectory import polynomial


@dataclasses.dataclass(frozen=True, eq=False)
class ProportionalMinco:
    """Constant float64 matrices of splines of M pieces with least integral |p^(s)|^2.

    The matrices multiply C = 2s + O rows [b; y]. The boundary rows b are the derivatives d = 0 to
    s - 1 of the position at both ends, times h^d for the mean duration h [s] of a piece. The O
    offsets y of the waypoints from the smoothest spline are in linear coordinates in which the
    energy grows by a multiple of |y|^2.
    """

    order: int  # s
    proportions: np.ndarray  # (M,) durations of the pieces divided by h; their mean is one
    coefficients: np.ndarray  # (M, 2s, C), maps [b; y] to coefficients of powers of t / h
    waypoints: np.ndarray  # (O, C), maps [b; y] to the waypoints, then their velocities times h
    offsets: np.ndarray  # (O, C), maps [b; waypoints] to y
    boundary_energy: np.ndarray  # (2s, 2s), quadratic form of the least energy for boundary rows
    offset_energy: float  # factor on |y|^2 in the energy

    @property
    def num_pieces(self) -> int:
        """The number M of polynomial pieces of a spline."""
        return len(self.proportions)

    def sample_matrix(self, nodes: int, derivative: int) -> np.ndarray:
        """Return the matrix (M nodes + 1, C) from end states and waypoint offsets to samples.

        Each of M pieces has `nodes` + 1 samples of a derivative (0 is the position); neighbours
        share one sample. The samples are derivatives by time in units of h, the mean duration of a
        piece: for a derivative by seconds divide them by h^derivative.
        """
        degree = 2 * self.order - 1
        factors = polynomial.derivative_factors(degree, derivative)
        powers = np.maximum(np.arange(degree + 1) - derivative, 0)
        times = self.proportions[:, None] * np.arange(nodes + 1) / nodes
        basis = factors * times[..., None] ** powers  # (M, nodes + 1, 2s)
        samples = basis @ self.coefficients  # (M, nodes + 1, columns)
        return np.concatenate([samples[:, :-1].reshape(-1, samples.shape[-1]), samples[-1:, -1]])


@functools.cache
def hermite_map(order: int) -> np.ndarray:
    """Return the map (2s, 2s) from derivatives at both ends of a piece of 1 s to its coefficients.

    The derivatives have the orders 0 to s - 1, at the start and then at the end, with s = `order`.
    """
    size = 2 * order
    ends = np.zeros((size, size))
    for d in range(order):
        ends[d, d] = math.factorial(d)
        ends[order + d] = polynomial.derivative_factors(size - 1, d)
    return np.linalg.inv(ends)


def _energy(coefficients: np.ndarray, shares: np.ndarray) -> np.ndarray:
    s = coefficients.shape[1] // 2
    root = np.linalg.cholesky(polynomial.energy_form(2 * s - 1, s)[0][s:, s:]).T
    parts = root @ coefficients[:, s:] / np.sqrt(shares[:, None, None] ** (2 * s - 1))
    return np.einsum("mkb,mkc->bc", parts, parts)


def _least_energy(energy: np.ndarray, num: int) -> np.ndarray:
    first, free = np.s_[:num], np.s_[num:]
    best = np.linalg.solve(energy[free, free], energy[free, first])
    return energy[first, first] - energy[first, free] @ best


@functools.cache
def proportional_minco(
    order: int, proportions: tuple[float, ...], velocities: bool = False
) -> ProportionalMinco:
    """Build the constant matrices for given proportions; the results are cached.

    Args:
        order: s, the derivative whose square is integrated: 2, 3 or 4.
        proportions: durations of the M >= 1 pieces relative to each other, all > 0.
        velocities: whether the velocities at the waypoints are variables, too. There are then
            O = 2 (M - 1) offsets instead of M - 1.
    """
    if not proportions or min(proportions) <= 0.0:
        raise ArgumentError("proportions", "some numbers > 0", proportions)
    s, m = order, len(proportions)
    shares = np.array(proportions) * m / np.sum(proportions)
    units = np.tile(shares[:, None] ** np.arange(s), 2)
    hermite = hermite_map(s)
    # Energy of a piece of duration 1, as a quadratic form in the derivatives at its ends.
    piece_energy = hermite.T @ polynomial.energy_form(2 * s - 1, s)[0] @ hermite
    total = np.zeros(((m + 1) * s, (m + 1) * s))
    for i in range(m):
        span = slice(i * s, (i + 2) * s)
        scaled = piece_energy * units[i][:, None] * units[i]
        total[span, span] += scaled / shares[i] ** (2 * s - 1)
    head, tail = np.arange(s), np.arange(m * s, (m + 1) * s)
    positions = np.arange(1, m) * s
    kinds = [positions, positions + 1] if velocities else [positions]
    known = np.concatenate([head, tail, *kinds])
    free = np.setdiff1d(np.arange((m + 1) * s), known)
    nodal = np.zeros(((m + 1) * s, known.size))
    nodal[known] = np.eye(known.size)
    nodal[free] = -np.linalg.solve(total[np.ix_(free, free)], total[np.ix_(free, known)])
    energy = nodal.T @ total @ nodal

    b, q = np.s_[: 2 * s], np.s_[2 * s :]
    from_offsets, norm = np.eye(known.size), 1.0
    for k in range(len(kinds) if m > 1 else 0):
        # Offsets of waypoints (k = 0) or of velocities there (k = 1) are deviations from the values
        # of least energy, given the end states and, for k = 1, the waypoints.
        begin, end = (2 * s + j * (m - 1) for j in (k, k + 1))
        before, own = np.s_[:begin], np.s_[begin:end]
        reduced = _least_energy(energy, end)
        whitening = np.linalg.inv(np.linalg.cholesky(reduced[own, own])).T
        if k == 0:
            norm = np.linalg.norm(whitening, 2)
        smooth = -np.linalg.solve(reduced[own, own], reduced[own, before])
        from_offsets[own, before] = smooth @ from_offsets[before, before]
        from_offsets[own, own] = whitening / norm
    to_offsets = np.linalg.inv(from_offsets)
    nodes = nodal @ from_offsets
    pieces = np.stack([nodes[i * s : (i + 2) * s] for i in range(m)])
    coefficients = hermite @ (units[:, :, None] * pieces)  # for pieces of duration 1
    powers = shares[:, None] ** np.arange(2 * s)
    return ProportionalMinco(
        order=s,
        proportions=shares,
        coefficients=coefficients / powers[:, :, None],
        waypoints=from_offsets[q],
        offsets=to_offsets[q],
        boundary_energy=_energy(coefficients[..., b], shares),
        offset_energy=float(norm) ** -2,
    )


def boundary_rows(head_state: Array, tail_state: Array, piece_duration: Array) -> Array:
    """Return the states (s, 3) at a spline's start and end as rows (2s, 3) in units of a piece.

    Row d of each state, the d-th derivative of the position, is multiplied by h^d, with the mean
    duration h [s] of a piece. The rows are derivatives by time in units of h.
    """
    scale = jnp.stack([piece_duration**k for k in range(head_state.shape[0])])[:, None]
    return jnp.concatenate([head_state * scale, tail_state * scale])


def sample_motion(
    maps: ProportionalMinco, nodes: int, columns: Array, piece_duration: Array, orders: int = 4
) -> polynomial.Motion:
    """Sample position to jerk at the ends of `nodes` equal intervals of each piece of a spline.

    Args:
        maps: constant matrices of splines of M pieces; s is their field `order`.
        nodes: intervals of each piece. Neighbouring pieces share one of N = M nodes + 1 samples.
        columns: (C, 3), derivatives d < s of the position at both ends times h^d, then the offsets
            of the waypoints from the smoothest spline, in the coordinates of `maps.offsets`.
        piece_duration: () h [s], mean duration of a piece.
        orders: 4, or 5 to sample the snap as well.
    """
    matrices = np.stack([maps.sample_matrix(nodes, d) for d in range(orders)])
    return _motion(jnp.asarray(matrices, columns.dtype), columns, piece_duration)


def by_pieces(
    function: Callable[[polynomial.Motion, Array], PyTree],
    maps: ProportionalMinco,
    nodes: int,
    columns: Array,
    piece_duration: Array,
) -> PyTree:
    """Apply a function to the motion of each piece, one piece after another to save memory.

    The function takes the motion at `nodes` + 1 samples of a piece, and the piece's duration [s].
    The results of the M pieces are stacked on a leading axis. `piece_duration` h () [s] is the mean
    of the pieces. `columns` (C, 3) are derivatives d < s of the position at both ends times h^d,
    then the waypoints' offsets from the smoothest spline, in the coordinates of `maps.offsets`.
    """
    each = np.stack([maps.sample_matrix(nodes, d) for d in range(4)])
    indices = np.arange(maps.num_pieces)[:, None] * nodes + np.arange(nodes + 1)
    matrices = jnp.asarray(each[:, indices].swapaxes(0, 1), columns.dtype)  # (M, 4, nodes + 1, C)
    shares = jnp.asarray(maps.proportions, columns.dtype)

    def of_piece(piece: tuple[Array, Array]) -> PyTree:
        matrix, share = piece
        return function(_motion(matrix, columns, piece_duration), share * piece_duration)

    return lax.map(of_piece, (matrices, shares))


def _motion(matrices: Array, columns: Array, piece_duration: Array) -> polynomial.Motion:
    orders = matrices.shape[0]
    unit = jnp.matmul(
        matrices.reshape(-1, matrices.shape[-1]), columns, precision=lax.Precision.HIGHEST
    ).reshape(orders, -1, 3)
    rate = reciprocal(piece_duration)
    rates = [jnp.ones_like(rate), rate, rate * rate, rate * rate * rate]
    rates = jnp.stack([*rates, rates[2] * rates[2]][:orders])
    pos, vel, acc, jerk, *snap = unit * rates[:, None, None]
    parts: dict[str, Array] = {"snap": snap[0]} if snap else {}
    return polynomial.Motion(height=pos[:, 2], vel=vel, acc=acc, jerk=jerk, pos=pos, **parts)


def trajectory_energy(maps: ProportionalMinco, rows: Array, offsets: Array, piece_duration: Array):
    """Return the integral () of |p^(s)|^2 of a spline p(t) of M pieces, with s = `maps.order`.

    `rows` (2s, 3) are derivatives d < s of the position at both ends times h^d, where h [s] is the
    mean duration `piece_duration` of a piece. `offsets` (O, 3) are the waypoints' offsets from the
    smoothest spline, in the coordinates of `maps.offsets`.
    """
    boundary = boundary_energy(maps, rows, piece_duration)
    return boundary + offset_energy(maps, offsets, piece_duration)


def boundary_energy(maps: ProportionalMinco, rows: Array, piece_duration: Array) -> Array:
    """Return the least integral () of |p^(s)|^2 of splines p(t) between two states.

    `rows` (2s, 3) are derivatives d < s of the position at both ends times h^d, where h [s] is the
    mean duration `piece_duration` of a piece, and s = `maps.order`.
    """
    return _boundary_form(maps, rows) * reciprocal(piece_duration) ** (2 * maps.order - 1)


def offset_energy(maps: ProportionalMinco, offsets: Array, piece_duration: Array) -> Array:
    """Return the increase () of the integral of |p^(s)|^2 by offsets (O, 3) of the waypoints.

    The offsets are from the smoothest spline, whose integral is least; s = `maps.order`.
    """
    rate = reciprocal(piece_duration)
    return maps.offset_energy * jnp.sum(offsets**2) * rate ** (2 * maps.order - 1)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _boundary_form(maps: ProportionalMinco, rows: Array) -> Array:
    return jnp.sum(rows * _by_rows(maps, rows))


@_boundary_form.defjvp
def _boundary_form_jvp(
    maps: ProportionalMinco, primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Array, Array]:
    # The value is sum(rows * (E rows)) with a symmetric matrix E, so its gradient is 2 E rows:
    # value and derivative share the product E rows.
    product = _by_rows(maps, primals[0])
    return jnp.sum(primals[0] * product), 2.0 * jnp.sum(product * tangents[0])


def _by_rows(maps: ProportionalMinco, rows: Array) -> Array:
    return jnp.sum(jnp.asarray(maps.boundary_energy, rows.dtype)[..., None] * rows[None], axis=1)


def proportional_trajectory(
    maps: ProportionalMinco, rows: Array, offsets: Array, piece_duration: Array
) -> polynomial.PiecewisePolynomial:
    """Return the trajectory through end states and waypoints, as a piecewise polynomial.

    `rows` (2s, 3) are derivatives d < s of the position at both ends times h^d, where h [s] is the
    mean duration `piece_duration` of a piece. `offsets` (O, 3) are the waypoints' offsets from the
    smoothest spline, in the coordinates of `maps.offsets`.
    """
    unit = jnp.einsum(
        "mkc,ci->mki",
        jnp.asarray(maps.coefficients, rows.dtype),
        jnp.concatenate([rows, offsets]),
        precision=lax.Precision.HIGHEST,
    )
    powers = piece_duration ** jnp.arange(2 * maps.order, dtype=jnp.result_type(piece_duration))
    return polynomial.PiecewisePolynomial(
        coeffs=unit / powers[None, :, None],
        durations=piece_duration * jnp.asarray(maps.proportions, rows.dtype),
    )


@struct.dataclass
class Chain:
    """N consecutive segments of a trajectory, each a spline between two states via waypoints."""

    rows: Float[Array, "N rows 3"]  # d-th derivatives at both ends * piece_duration^d
    offsets: Float[Array, "N offsets 3"]  # of waypoints, as defined by `ProportionalMinco.offsets`
    piece_durations: Float[Array, " N"]  # [s], mean duration of each segment's pieces

    @property
    def columns(self) -> Float[Array, "N columns 3"]:
        """The arrays `rows` and `offsets`, joined: end states, then waypoints of each segment."""
        return jnp.concatenate([self.rows, self.offsets], axis=1)


def chain_rows(
    head_state: Float[Array, "4 3"],
    tail_states: Float[Array, "N 4 3"],
    piece_durations: Float[Array, " N"],
) -> Float[Array, "N 8 3"]:
    """Return position to jerk at both ends of N segments, times piece_duration^(0, 1, 2, 3)."""
    heads = jnp.concatenate([head_state[None], tail_states[:-1]])
    return jax.vmap(boundary_rows)(heads, tail_states, piece_durations)


def chain_trajectory(
    maps: ProportionalMinco, chain: Chain, active: Bool[Array, " N"]
) -> polynomial.PiecewisePolynomial:
    """Join N segments of M pieces each; the pieces of inactive segments have a duration of 0 s."""
    build = functools.partial(proportional_trajectory, maps)
    pieces = jax.vmap(build)(chain.rows, chain.offsets, chain.piece_durations)
    return join_segments(pieces, chain, active)


def join_segments(
    pieces: polynomial.PiecewisePolynomial, chain: Chain, active: Bool[Array, " N"]
) -> polynomial.PiecewisePolynomial:
    """Join trajectories of the N segments of a chain, given on a leading axis of `pieces`."""
    # Positions at the start of the chain, and at the ends of its segments.
    ends = jnp.concatenate([chain.rows[:1, 0], chain.rows[:, chain.rows.shape[1] // 2]])
    last = ends[jnp.sum(active)]
    still = jnp.zeros_like(pieces.coeffs).at[:, :, 0].set(last)
    coeffs = jnp.where(active[:, None, None, None], pieces.coeffs, still)
    durations = jnp.where(active[:, None], pieces.durations, 0.0)
    return polynomial.PiecewisePolynomial(
        coeffs=coeffs.reshape(-1, *coeffs.shape[2:]), durations=durations.ravel()
    )
