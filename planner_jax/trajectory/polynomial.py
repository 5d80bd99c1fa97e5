"""Piecewise polynomials in time: the one form in which every planner returns a trajectory."""

import functools
import math
from collections.abc import Iterable

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.arithmetic import numpy_of
from planner_jax.core.checks import require_kind, require_scalar
from planner_jax.core.choices import require_size


@struct.dataclass
class PiecewisePolynomial:
    """The trajectory p(t) = sum_k coeffs[i, k] (t - t_i)^k on piece i [Yu2023catch, eq. 13].

    Piece i starts at the time t_i.

    Attributes:
        coeffs: (M, D + 1, 3) coefficients of M pieces of degree D, in ascending powers of the time
            since the piece's start t_i.
        durations: (M,) [s], durations of the pieces, > 0.
    """

    coeffs: Array
    durations: Array


@struct.dataclass
class Motion:
    """Position and derivatives of a trajectory at N times, at which its limits are checked."""

    height: Array  # (N,) [m]
    vel: Array  # (N, 3) [m/s]
    acc: Array  # (N, 3) [m/s^2]
    jerk: Array  # (N, 3) [m/s^3]
    pos: PyTree = None  # (N, 3) [m]
    snap: PyTree = None  # (N, 3) [m/s^4], if requested


def derivative_factors(degree: int, order: int) -> np.ndarray:
    """Return the factors (degree + 1,) k!/(k - order)! of the `order`-th derivative of t^k."""
    powers = np.arange(degree + 1)
    factors = np.ones(degree + 1)
    for i in range(order):
        factors = factors * np.maximum(powers - i, 0)
    return factors


def evaluate(trajectory: PiecewisePolynomial, time: Array, order: int = 0) -> Array:
    """Evaluate the position or one of its derivatives at one time.

    Args:
        trajectory: M pieces.
        time: () [s] since the start; before the start and past the end the outer pieces continue.
        order: 0 position, 1 velocity, 2 acceleration, 3 jerk, 4 snap.

    Returns:
        (3,) [m/s^order].
    """
    require_kind("trajectory", trajectory, PiecewisePolynomial)
    require_size("order", order, 0)
    time = jnp.asarray(require_scalar("time", time))
    coeffs, durations = trajectory.coeffs, trajectory.durations
    starts = jnp.concatenate([jnp.zeros_like(durations[:1]), jnp.cumsum(durations)[:-1]])
    piece = jnp.clip(jnp.sum(time >= starts) - 1, 0, durations.shape[0] - 1)
    local = time - starts[piece]
    degree = coeffs.shape[1] - 1
    scaled = coeffs[piece] * jnp.asarray(derivative_factors(degree, order), coeffs.dtype)[:, None]
    value = jnp.zeros_like(scaled[0])
    for k in range(degree, order - 1, -1):
        value = value * local + scaled[k]
    return value


def total_duration(trajectory: PiecewisePolynomial) -> Array:
    """Return the duration [s] of all pieces together."""
    return jnp.sum(trajectory.durations, axis=-1)


def energy_form(degree: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the quadratic form of the integral of a polynomial's squared `order`-th derivative.

    The arguments of the form are the polynomial's coefficients in ascending powers of time.

    Returns:
        The matrix (degree + 1, degree + 1) of the form for the duration 1 s, and for each entry the
        power of the duration by which it must be multiplied.
    """
    factors, powers = derivative_factors(degree, order), np.arange(degree + 1)
    exponents = np.maximum(powers[:, None] + powers[None, :] - 2 * order + 1, 1)
    return np.outer(factors, factors) / exponents, exponents


def snap_energy(trajectory: PiecewisePolynomial, order: int = 4) -> Array:
    """Return the integral () of a trajectory's squared `order`-th derivative, in closed form."""
    coeffs, durations = trajectory.coeffs, trajectory.durations
    form, exponents = energy_form(coeffs.shape[1] - 1, order)
    powers = durations[:, None, None] ** jnp.asarray(exponents, durations.dtype)[None]
    gram = jnp.asarray(form, coeffs.dtype)[None] * powers
    return jnp.einsum("mki,mkl,mli->", coeffs, gram, coeffs, precision=lax.Precision.HIGHEST)


def sample_pieces(trajectory: PiecewisePolynomial, nodes: int) -> Motion:
    """Sample the motion at `nodes` + 1 times of every piece, ends included, piece after piece."""
    pos, *others = (each.reshape(-1, 3) for each in sample_orders(trajectory, nodes, range(5)))
    vel, acc, jerk, snap = others
    return Motion(height=pos[:, 2], vel=vel, acc=acc, jerk=jerk, pos=pos, snap=snap)


def sample_orders(
    trajectory: PiecewisePolynomial, nodes: int, orders: Iterable[int]
) -> tuple[Array, ...]:
    """Sample derivatives (P, nodes + 1, 3) of some orders at equal times of P pieces."""
    coeffs, degree = trajectory.coeffs, trajectory.coeffs.shape[1] - 1
    fractions = jnp.asarray(np.arange(nodes + 1) / nodes, coeffs.dtype)
    times = trajectory.durations[:, None] * fractions[None]

    def sample(order: int) -> Array:
        factors = derivative_factors(degree, order)
        value = jnp.zeros(times.shape + (3,), coeffs.dtype)
        for k in range(degree, order - 1, -1):
            value = value * times[..., None] + factors[k] * coeffs[:, None, k]
        return value

    return tuple(map(sample, orders))


def join(first: PiecewisePolynomial, then: PiecewisePolynomial) -> PiecewisePolynomial:
    """Join two trajectories, or two batches of trajectories, one after the other in time."""
    size = max(first.coeffs.shape[-2], then.coeffs.shape[-2])

    xp = numpy_of(first.coeffs, then.coeffs)  # JAX would compile programs for each batch size

    def pad(coeffs: Array) -> PyTree:
        missing = size - coeffs.shape[-2]
        return xp.pad(coeffs, [(0, 0)] * (coeffs.ndim - 2) + [(0, missing), (0, 0)])

    coeffs = xp.concatenate([pad(first.coeffs), pad(then.coeffs)], axis=-3)
    durations = xp.concatenate([first.durations, then.durations], axis=-1)
    return PiecewisePolynomial(coeffs=coeffs, durations=durations)


def states_at(trajectory: PiecewisePolynomial, times: np.ndarray) -> np.ndarray:
    """Evaluate position, velocity, acceleration and jerk by NumPy, at one time per trajectory.

    Args:
        trajectory: one trajectory, or a batch of B, with a leading axis on every leaf.
        times: (B,) or () [s] since the start.

    Returns:
        (B, 4, 3) or (4, 3).
    """
    coeffs, durations = np.asarray(trajectory.coeffs), np.asarray(trajectory.durations)
    ends = durations.cumsum(axis=-1)
    if times.ndim:
        lanes = np.arange(times.size)
        piece = (times[:, None] >= ends[:, :-1]).sum(axis=1)
        coeffs, starts = coeffs[lanes, piece], (ends - durations)[lanes, piece]
    else:
        piece = ends[:-1].searchsorted(times, side="right")
        coeffs, starts = coeffs[piece], ends[piece] - durations[piece]
    factors, powers = state_basis(coeffs.shape[-2])
    return (factors * (times - starts)[..., None, None] ** powers) @ coeffs


@functools.cache
def state_basis(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return f and e, (4, size): sum_k f[d, k] t^e[d, k] c_k is derivative d of sum_k c_k t^k."""
    factors = np.stack([derivative_factors(size - 1, order) for order in range(4)])
    return factors, np.maximum(np.arange(size) - np.arange(4)[:, None], 0)


@functools.cache
def shift_basis(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return f and e, (size, size), for coefficients c_j of a polynomial whose origin moves to t.

    The i-th new coefficient is sum_j f[i, j] t^e[i, j] c_j.
    """
    indices = np.arange(size)
    factors = np.array([[math.comb(j, i) for j in indices] for i in indices])
    return factors, np.maximum(indices - indices[:, None], 0)
