"""Scalar curves over time, made of Bezier pieces of equal duration, for `speed.py`.

A curve of duration T (its horizon) has K pieces. Piece j is sum_i points[j, i] b_i(u), with the
Bernstein polynomials b_i of degree n; u runs from 0 to 1 during the piece [Qu2022, eq. 18]. The
curve lies within the range of its control points `points`, so that a bound on the control points
also bounds the curve. The paper's control points are `points` divided by the duration of a piece.
Eqs 22 and 23 as printed bound these quotients, which is right only for pieces of 1 s.

The functions of this module return constant NumPy matrices in double precision for a horizon of 1.
For a horizon T, speeds scale with 1 / T and accelerations with 1 / T^2.
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
        """Return one curve's value, or its derivative of the given order, at times (...) [s].

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

    Args:
        degree: degree of the piece.
        order: order of the derivative.
        pieces: number of equal pieces of the curve, whose horizon is 1.

    Returns:
        (degree + 1 - order, degree + 1).
    """
    points = np.eye(degree + 1)
    for k in range(order):
        points = (degree - k) * pieces * (points[1:] - points[:-1])
    return points


def bernstein(degree: int, shares: np.ndarray) -> np.ndarray:
    """Return the Bernstein polynomials (S, degree + 1) at S positions: fractions of a piece."""
    u = np.asarray(shares, float)[:, None]
    i = np.arange(degree + 1)
    binomials = np.array([math.comb(degree, k) for k in i])
    return binomials * u**i * (1.0 - u) ** (degree - i)


def energy_of_pieces(degree: int, order: int, pieces: int) -> np.ndarray:
    """Return the matrix Q of the integral of a curve's squared derivative over a horizon of 1.

    The derivative has the given order. The integral is p^T Q p for the control points p of all
    pieces. Q has the shape (pieces (degree + 1),) * 2.
    """
    map_ = hodograph(degree, order, pieces)
    m = degree - order
    i = np.arange(m + 1)
    binomials = np.array([math.comb(m, k) for k in i])
    both = np.array([[math.comb(2 * m, a + b) for b in i] for a in i])
    gram = np.outer(binomials, binomials) / (both * (2 * m + 1) * pieces)
    return np.kron(np.eye(pieces), map_.T @ gram @ map_)


def joints(degree: int, orders: int, pieces: int) -> np.ndarray:
    """Return the matrix of the equations by which neighbouring pieces join smoothly.

    The product with the control points of all pieces is zero if neighbouring pieces agree in their
    derivatives of the orders 0 to `orders` [Qu2022, eq. 21].

    Returns:
        ((pieces - 1) (orders + 1), pieces (degree + 1)).
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
    """Build the matrix of values at points of K pieces from the matrix (W, n + 1) of one piece.

    The matrix of one piece maps its n + 1 control points to the values at W points, from the
    piece's start to its end. A start that is the end of the previous piece gets no second row. K is
    `pieces`.

    Returns:
        (K (W - 1) + 1, K (n + 1)), maps the control points of all pieces.
    """
    rows = np.kron(np.eye(pieces), of_piece)
    return np.delete(rows, np.arange(1, pieces) * len(of_piece), axis=0)


def bounds_of_pieces(lower: Array, upper: Array) -> tuple[Array, Array]:
    """Convert bounds (K, W) on W values of each of K pieces into bounds (K (W - 1) + 1,).

    The last value of a piece is the first value of the next piece: of their two bounds, the
    stricter one applies.
    """

    def flat(bounds: Array, at_joints: Array) -> Array:
        inner = jnp.concatenate([bounds[:, 1:-1], at_joints[:, None]], axis=1)
        return jnp.concatenate([bounds[0, :1], jnp.ravel(inner)])

    low = jnp.concatenate([jnp.maximum(lower[:-1, -1], lower[1:, 0]), lower[-1:, -1]])
    high = jnp.concatenate([jnp.minimum(upper[:-1, -1], upper[1:, 0]), upper[-1:, -1]])
    return flat(lower, low), flat(upper, high)
