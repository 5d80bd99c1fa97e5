"""MINCO with durations in fixed proportion: constant matrices in normalised time.

MINCO is the piecewise polynomial of least integral |p^(s)|^2 through given waypoints ([Yu2023bat,
eq. 19]; Wang, Zhou, Xu, Gao, "Geometrically Constrained Trajectory Optimization for
Multicopters"): 2s - 2 times differentiable, of degree 2s - 1 on every piece.

When the M pieces last r_i h seconds with constant r_i of mean one, so that h = T / M, the map
from boundary rows and waypoints to coefficients, and to samples of position, velocity,
acceleration and jerk, is one constant matrix in time over h. Boundary rows are
(p, v h, a h^2, j h^3) at both ends.

The waypoints are expressed as whitened offsets y from the minimum-energy interpolation of
the boundary, q = -E_qq^-1 E_qb b + W y with W = R^-T / |R^-T| and E_qq = R R^T, so y = 0 is
the smoothest guess for any boundary, and the energy is a boundary part plus a multiple of
|y|^2.

The velocities at the waypoints may be variables as well: offsets z, whitened in the same way, from
those of least energy for boundary and waypoints. z = 0 leaves the trajectory as it is without
them, and the energy of z is another multiple of |z|^2, the same one. Such a trajectory is
2s - 3 times differentiable.

A `Chain` is N minimum-snap segments of M pieces each. The state at the end of a segment, position
to jerk, is where the next one starts. Absent segments are computed like the others, so that one
compiled shape serves any number of them, and count nothing.
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
from planner_jax.trajectory.polynomial import (
    Motion,
    PiecewisePolynomial,
    derivative_factors,
    energy_form,
)


@dataclasses.dataclass(frozen=True, eq=False)
class ProportionalMinco:
    """Constant float64 maps for M pieces of energy order s."""

    order: int
    proportions: np.ndarray  # (M,) durations over h, mean one
    coefficients: np.ndarray  # (M, 2s, C), of powers of time over h, from C = 2s + O columns [b; y]
    waypoints: np.ndarray  # (O, C), waypoints from [b; y], and behind them velocities times h
    offsets: np.ndarray  # (O, C), y from [b; waypoints]
    boundary_energy: np.ndarray  # (2s, 2s), least energy for given boundary rows
    offset_energy: float  # energy a unit of |y|^2

    @property
    def num_pieces(self) -> int:
        """M."""
        return len(self.proportions)

    def sample_matrix(self, nodes: int, derivative: int) -> np.ndarray:
        """Samples at `nodes` + 1 points a piece, ends shared: (M nodes + 1, C).

        Multiply by [b; y] and divide by h^derivative.
        """
        degree = 2 * self.order - 1
        factors = derivative_factors(degree, derivative)
        powers = np.maximum(np.arange(degree + 1) - derivative, 0)
        times = self.proportions[:, None] * np.arange(nodes + 1) / nodes
        basis = factors * times[..., None] ** powers  # (M, nodes + 1, 2s)
        samples = basis @ self.coefficients  # (M, nodes + 1, columns)
        inner = samples[:, :-1].reshape(-1, samples.shape[-1])
        return np.concatenate([inner, samples[-1:, -1]])


def equal_pieces(num_pieces: int) -> tuple[float, ...]:
    """Proportions of pieces that all last equally long."""
    return (1.0,) * num_pieces


@functools.cache
def _hermite_map(order: int) -> np.ndarray:
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
def _hermite_energy(order: int) -> np.ndarray:
    """Energy of a unit-time piece as a quadratic form in its end derivatives, (2s, 2s)."""
    hermite = _hermite_map(order)
    return hermite.T @ energy_form(2 * order - 1, order)[0] @ hermite


def _energy(coefficients: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Energy of the pieces together as a quadratic form in their columns, (C, C).

    From the squares of what each piece has of it, because the form in the nodes' derivatives
    loses the small energies of smooth motion far from the origin to rounding.

    Args:
        coefficients: (M, 2s, C) of the powers of each piece's unit time.
        shares: (M,) durations of the pieces.
    """
    s = coefficients.shape[1] // 2
    root = np.linalg.cholesky(energy_form(2 * s - 1, s)[0][s:, s:]).T
    parts = root @ coefficients[:, s:] / np.sqrt(shares[:, None, None] ** (2 * s - 1))
    return np.einsum("mkb,mkc->bc", parts, parts)


def _least_energy(energy: np.ndarray, num: int) -> np.ndarray:
    """The energy as a form in the first of its unknowns, the others as they are best for these."""
    kept, free = np.s_[:num], np.s_[num:]
    best = np.linalg.solve(energy[free, free], energy[free, kept])
    return energy[kept, kept] - energy[kept, free] @ best


@functools.cache
def proportional_minco(
    order: int, proportions: tuple[float, ...], velocities: bool = False
) -> ProportionalMinco:
    """Build the constant maps (cached).

    Args:
        order: s, the derivative whose square is integrated: 2, 3 or 4.
        proportions: durations of the M >= 1 pieces relative to each other, all > 0.
        velocities: whether those at the waypoints are variables too: O = 2 (M - 1) offsets instead
            of M - 1.
    """
    if not proportions or min(proportions) <= 0.0:
        raise ArgumentError("proportions", "some numbers > 0", proportions)
    s, m = order, len(proportions)
    shares = np.array(proportions) * m / np.sum(proportions)
    # Derivative d of a node in the unit time of piece i is r_i^d of that in time over h.
    units = np.tile(shares[:, None] ** np.arange(s), 2)
    piece_energy = _hermite_energy(s)
    total = np.zeros(((m + 1) * s, (m + 1) * s))
    for i in range(m):
        span = slice(i * s, (i + 2) * s)
        scaled = piece_energy * units[i][:, None] * units[i]
        total[span, span] += scaled / shares[i] ** (2 * s - 1)
    head, tail = np.arange(s), np.arange(m * s, (m + 1) * s)
    positions = np.arange(1, m) * s
    kinds = [positions, positions + 1] if velocities else [positions]
    given = np.concatenate([head, tail, *kinds])
    free = np.setdiff1d(np.arange((m + 1) * s), given)
    nodal = np.zeros(((m + 1) * s, given.size))
    nodal[given] = np.eye(given.size)
    nodal[free] = -np.linalg.solve(total[np.ix_(free, free)], total[np.ix_(free, given)])
    energy = nodal.T @ total @ nodal

    b, q = np.s_[: 2 * s], np.s_[2 * s :]
    from_offsets, norm = np.eye(given.size), 1.0
    for k in range(len(kinds) if m > 1 else 0):
        # From what is best for all before this kind, with what follows as is best for both.
        begin, end = (2 * s + j * (m - 1) for j in (k, k + 1))
        before, own = np.s_[:begin], np.s_[begin:end]
        rest = _least_energy(energy, end)
        whitening = np.linalg.inv(np.linalg.cholesky(rest[own, own])).T
        if k == 0:
            norm = np.linalg.norm(whitening, 2)
        smooth = -np.linalg.solve(rest[own, own], rest[own, before])
        from_offsets[own, before] = smooth @ from_offsets[before, before]
        from_offsets[own, own] = whitening / norm
    to_offsets = np.linalg.inv(from_offsets)
    nodes = nodal @ from_offsets
    pieces = np.stack([nodes[i * s : (i + 2) * s] for i in range(m)])
    coefficients = _hermite_map(s) @ (units[:, :, None] * pieces)  # of each piece's unit time
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
    """Boundary in time over h, (2s, 3): derivative d times h^d."""
    scale = jnp.stack([piece_duration**k for k in range(head_state.shape[0])])[:, None]
    return jnp.concatenate([head_state * scale, tail_state * scale])


def sample_motion(
    maps: ProportionalMinco, nodes: int, columns: Array, piece_duration: Array, orders: int = 4
) -> Motion:
    """Position, velocity, acceleration and jerk at `nodes` intervals a piece.

    Args:
        maps: constant maps of M pieces.
        nodes: intervals a piece; N = M nodes + 1 samples, ends shared.
        columns: (C, 3) boundary rows and whitened offsets y.
        piece_duration: () h = T / M [s].
        orders: 5 for the snap as well.
    """
    matrices = np.stack([maps.sample_matrix(nodes, d) for d in range(orders)])
    return _motion(jnp.asarray(matrices, columns.dtype), columns, piece_duration)


def by_pieces(
    function: Callable[[Motion, Array], PyTree],
    maps: ProportionalMinco,
    nodes: int,
    columns: Array,
    piece_duration: Array,
) -> PyTree:
    """What a function finds in the motion of each piece, one after another.

    Many samples of all pieces at once would take a lot of memory.

    Args:
        function: of the motion at `nodes` + 1 samples of a piece, and of its duration [s].
        maps: as for `sample_motion`, and so are the others.
        nodes: intervals a piece.
        columns: (C, 3).
        piece_duration: () [s].

    Returns:
        What the function gives back, with a leading axis of M.
    """
    each = np.stack([maps.sample_matrix(nodes, d) for d in range(4)])
    places = np.arange(maps.num_pieces)[:, None] * nodes + np.arange(nodes + 1)
    matrices = jnp.asarray(each[:, places].swapaxes(0, 1), columns.dtype)  # (M, 4, nodes + 1, C)
    shares = jnp.asarray(maps.proportions, columns.dtype)

    def of_piece(piece: tuple[Array, Array]) -> PyTree:
        matrix, share = piece
        return function(_motion(matrix, columns, piece_duration), share * piece_duration)

    return lax.map(of_piece, (matrices, shares))


def _motion(matrices: Array, columns: Array, piece_duration: Array) -> Motion:
    """The samples of matrices (orders, N, C)."""
    # One product for everything: on a CPU each product, division and sum of its own costs more
    # than its arithmetic. The matrix comes first, so that a batch adds columns.
    orders = matrices.shape[0]
    unit = jnp.matmul(
        matrices.reshape(-1, matrices.shape[-1]), columns, precision=lax.Precision.HIGHEST
    ).reshape(orders, -1, 3)
    rate = reciprocal(piece_duration)
    rates = [jnp.ones_like(rate), rate, rate * rate, rate * rate * rate]
    rates = jnp.stack([*rates, rates[2] * rates[2]][:orders])
    pos, vel, acc, jerk, *snap = unit * rates[:, None, None]
    parts: dict[str, Array] = {"snap": snap[0]} if snap else {}
    return Motion(height=pos[:, 2], vel=vel, acc=acc, jerk=jerk, pos=pos, **parts)


def trajectory_energy(maps: ProportionalMinco, rows: Array, offsets: Array, piece_duration: Array):
    """Integral of |p^(s)|^2 over the trajectory, ().

    Args:
        maps: constant maps of M pieces.
        rows: (2s, 3) boundary rows.
        offsets: (O, 3) whitened offsets y.
        piece_duration: () h = T / M [s].
    """
    boundary = boundary_energy(maps, rows, piece_duration)
    return boundary + offset_energy(maps, offsets, piece_duration)


def boundary_energy(maps: ProportionalMinco, rows: Array, piece_duration: Array) -> Array:
    """The part of `trajectory_energy` that the boundary makes, the least there is for it, ()."""
    return _boundary_form(maps, rows) * reciprocal(piece_duration) ** (2 * maps.order - 1)


def offset_energy(maps: ProportionalMinco, offsets: Array, piece_duration: Array) -> Array:
    """The part of `trajectory_energy` that the offsets make, ()."""
    rate = reciprocal(piece_duration)
    return maps.offset_energy * jnp.sum(offsets**2) * rate ** (2 * maps.order - 1)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _boundary_form(maps: ProportionalMinco, rows: Array) -> Array:
    """Energy of boundary rows (2s, 3) in time over h, ()."""
    return jnp.sum(rows * _by_rows(maps, rows))


@_boundary_form.defjvp
def _boundary_form_jvp(
    maps: ProportionalMinco, primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Array, Array]:
    # The matrix is symmetric: one product serves value and slope.
    product = _by_rows(maps, primals[0])
    return jnp.sum(primals[0] * product), 2.0 * jnp.sum(product * tangents[0])


def _by_rows(maps: ProportionalMinco, rows: Array) -> Array:
    """The energy's matrix times the rows; sums, because a small product costs more to call."""
    gram = jnp.asarray(maps.boundary_energy, rows.dtype)
    return jnp.sum(gram[..., None] * rows, axis=1)


def proportional_trajectory(
    maps: ProportionalMinco, rows: Array, offsets: Array, piece_duration: Array
) -> PiecewisePolynomial:
    """The trajectory in real time; arguments as in `trajectory_energy`."""
    unit = jnp.einsum(
        "mkc,ci->mki",
        jnp.asarray(maps.coefficients, rows.dtype),
        jnp.concatenate([rows, offsets]),
        precision=lax.Precision.HIGHEST,
    )
    powers = piece_duration ** jnp.arange(2 * maps.order)
    return PiecewisePolynomial(
        coeffs=unit / powers[None, :, None],
        durations=piece_duration * jnp.asarray(maps.proportions, rows.dtype),
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
