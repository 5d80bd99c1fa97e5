"""Scalar curves over time, made of Bezier pieces of equal duration, for `speed.py`.

Piece j of K runs from j T / K to (j + 1) T / K and is sum_i points[j, i] b_i(u), with the Bernstein
polynomials b_i of degree n and u from 0 to 1 [Qu2022, eq. 18]. A control point here is the paper's
control point times the duration of its piece, h_j c_j^i. The curve lies within the range of its
control points, so that a bound on the control points also bounds the curve. Eqs 22 and 23 as
printed bound c_j^i, which is right only for pieces of 1 s.

All maps that are linear in the control points are constant NumPy matrices for a horizon of 1, in
double precision. For a horizon T, speeds scale with 1 / T and accelerations with 1 / T^2. Since all
pieces have the same duration, the matrices do not depend on the problem.
"""

import math

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array


@struct.dataclass
class BezierCurve:
    """A scalar curve over time, or a batch of curves with a leading axis on every leaf."""

    points: Array  # (K, n + 1) [m], control points
    horizon: Array  # () T [s], duration of all pieces together

    def at(self, time: Array, order: int = 0) -> Array:
        """Return the value of one curve, or its derivative of an order, at times (...) [s].

        Before time 0 the first piece is extrapolated, after the horizon the last piece.
        """
        pieces, degree = self.points.shape[0], self.points.shape[1] - 1
        place = time / self.horizon * pieces
        piece = jnp.clip(place.astype(jnp.int32), 0, pieces - 1)
        points = self.points[piece]
        for k in range(order):
            step = (degree - k) * pieces / self.horizon
            points = step * (points[..., 1:] - points[..., :-1])
        share = (place - piece)[..., None]
        while points.shape[-1] > 1:  # de Casteljau
            points = points[..., :-1] + share * (points[..., 1:] - points[..., :-1])
        return points[..., 0]


def hodograph(degree: int, order: int, pieces: int) -> np.ndarray:
    """Return the matrix that maps a piece's control points to control points of a derivative.

    The derivative has the given order. The horizon is 1 and has `pieces` pieces ([Qu2022], third
    property of Bezier curves).

    Returns:
        (degree + 1 - order, degree + 1).
    """
    points = np.eye(degree + 1)
    for k in range(order):
        points = (degree - k) * pieces * (points[1:] - points[:-1])
    return points


def bernstein(degree: int, shares: np.ndarray) -> np.ndarray:
    """Return the Bernstein polynomials' values (S, degree + 1) at fractions (S,) of a piece."""
    u = np.asarray(shares, float)[:, None]
    i = np.arange(degree + 1)
    binomials = np.array([math.comb(degree, k) for k in i])
    return binomials * u**i * (1.0 - u) ** (degree - i)


def energy_of_pieces(degree: int, order: int, pieces: int) -> np.ndarray:
    """Return the quadratic form that integrates a curve's squared derivative over a horizon of 1.

    Returns:
        (K (n + 1), K (n + 1)), symmetric; the integral is points^T form points.
    """
    map_ = hodograph(degree, order, pieces)
    m = degree - order
    i = np.arange(m + 1)
    binomials = np.array([math.comb(m, k) for k in i])
    both = np.array([[math.comb(2 * m, a + b) for b in i] for a in i])
    gram = np.outer(binomials, binomials) / (both * (2 * m + 1) * pieces)
    return np.kron(np.eye(pieces), map_.T @ gram @ map_)


def joints(degree: int, orders: int, pieces: int) -> np.ndarray:
    """Return rows that vanish if neighbouring pieces agree up to derivative `orders`.

    The product of the rows with all control points is the left side of [Qu2022, eq. 21].

    Returns:
        ((K - 1) (orders + 1), K (n + 1)).
    """
    size = degree + 1
    rows = np.zeros((pieces - 1, orders + 1, pieces * size))
    for order in range(orders + 1):
        map_ = hodograph(degree, order, pieces) / float(pieces) ** order
        for j in range(pieces - 1):
            rows[j, order, j * size : (j + 1) * size] = map_[-1]
            rows[j, order, (j + 1) * size : (j + 2) * size] -= map_[0]
    return rows.reshape(-1, pieces * size)


def rows_of_pieces(of_piece: np.ndarray, pieces: int) -> np.ndarray:
    """Expand rows (W, n + 1) for one piece's control points into rows for all pieces.

    On a smooth curve the first row of a piece equals the last row of the previous piece. Such first
    rows are left out.

    Returns:
        (K (W - 1) + 1, K (n + 1)).
    """
    rows = np.kron(np.eye(pieces), of_piece)
    return np.delete(rows, np.arange(1, pieces) * len(of_piece), axis=0)


def bounds_of_pieces(lower: Array, upper: Array) -> tuple[Array, Array]:
    """Convert bounds (K, W) on the rows of single pieces into bounds on `rows_of_pieces`.

    Where two pieces meet, the stricter bound of the two pieces applies.
    """

    def flat(bounds: Array, at_joints: Array) -> Array:
        inner = jnp.concatenate([bounds[:, 1:-1], at_joints[:, None]], axis=1)
        return jnp.concatenate([bounds[0, :1], jnp.ravel(inner)])

    low = jnp.concatenate([jnp.maximum(lower[:-1, -1], lower[1:, 0]), lower[-1:, -1]])
    high = jnp.concatenate([jnp.minimum(upper[:-1, -1], upper[1:, 0]), upper[-1:, -1]])
    return flat(lower, low), flat(upper, high)
