"""Curves of one number over time, of Bezier pieces that all last equally long.

Piece j of K runs from j T / K to (j + 1) T / K and is sum_i points[j, i] b_i(u), with Bernstein's
polynomials b_i of degree n and u from 0 to 1 [Qu2022, eq. 18]. A point here is the paper's
control point times the duration of its piece, h_j c_j^i, so that the curve lies between its points
and a bound on the curve is the same bound on the points; eqs 22 and 23 as printed bound c_j^i,
which is right for pieces of 1 s only.

Everything that is linear in the points is a constant matrix for a horizon of 1: times T, T^2 for
speed and acceleration of another. Pieces of equal length make these matrices independent of any
problem. They are NumPy arrays in double precision.
"""

import math

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array


@struct.dataclass
class BezierCurve:
    """A curve, or a batch of them with a leading axis on every leaf."""

    points: Array  # (K, n + 1) [m], between which the curve lies
    horizon: Array  # () T [s], duration of all pieces together

    def at(self, time: Array, order: int = 0) -> Array:
        """Value, or a derivative by the time of some order, of one curve at times (...) [s].

        Before 0 and past the end the nearest piece is continued.
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
    """From the points of a piece to those of its derivative, (degree + 1 - order, degree + 1).

    For a horizon of 1 that is cut into `pieces` ([Qu2022]'s third property).
    """
    points = np.eye(degree + 1)
    for k in range(order):
        points = (degree - k) * pieces * (points[1:] - points[:-1])
    return points


def bernstein(degree: int, shares: np.ndarray) -> np.ndarray:
    """Bernstein's polynomials at shares (S,) of a piece, (S, degree + 1)."""
    u = np.asarray(shares, float)[:, None]
    i = np.arange(degree + 1)
    binomials = np.array([math.comb(degree, k) for k in i])
    return binomials * u**i * (1.0 - u) ** (degree - i)


def energy_of_pieces(degree: int, order: int, pieces: int) -> np.ndarray:
    """The integral of the squared derivative over a horizon of 1, as a form in all points.

    Returns:
        (K (n + 1), K (n + 1)), symmetric; the integral is points' form points.
    """
    map_ = hodograph(degree, order, pieces)
    m = degree - order
    i = np.arange(m + 1)
    binomials = np.array([math.comb(m, k) for k in i])
    both = np.array([[math.comb(2 * m, a + b) for b in i] for a in i])
    gram = np.outer(binomials, binomials) / (both * (2 * m + 1) * pieces)
    return np.kron(np.eye(pieces), map_.T @ gram @ map_)


def joints(degree: int, orders: int, pieces: int) -> np.ndarray:
    """What is 0 where neighbours agree up to `orders` derivatives [Qu2022, eq. 21].

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
    """Rows (W, n + 1) for the points of one piece as rows for those of all pieces.

    The first row of a piece is the last row of the piece before, on a curve that is smooth
    enough, and is left out: (K (W - 1) + 1, K (n + 1)).
    """
    rows = np.kron(np.eye(pieces), of_piece)
    return np.delete(rows, np.arange(1, pieces) * len(of_piece), axis=0)


def bounds_of_pieces(lower: Array, upper: Array) -> tuple[Array, Array]:
    """Bounds (K, W) for the rows of single pieces as bounds for `rows_of_pieces`.

    Where two pieces join both their bounds hold.
    """

    def flat(bounds: Array, at_joints: Array) -> Array:
        inner = jnp.concatenate([bounds[:, 1:-1], at_joints[:, None]], axis=1)
        return jnp.concatenate([bounds[0, :1], jnp.ravel(inner)])

    low = jnp.concatenate([jnp.maximum(lower[:-1, -1], lower[1:, 0]), lower[-1:, -1]])
    high = jnp.concatenate([jnp.minimum(upper[:-1, -1], upper[1:, 0]), upper[-1:, -1]])
    return flat(lower, low), flat(upper, high)
