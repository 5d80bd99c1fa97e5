"""Clamped uniform B-splines of any degree: smooth curves that the baseline `insat` optimises.

A curve q of degree k with m control points p_i, at a fraction s of its duration from 0 to 1, is

    q(s) = sum_i  p_i N_{i,k}(s),    i = 0 .. m - 1    [Natarajan2024, eq. 3].

The basis functions N follow from the recursion of Cox and de Boor (eq. 2). With knots s_0 ..
s_{m+k},

    N_{i,0}(s) = 1 where s_i <= s < s_{i+1}, else 0,
    N_{i,k}(s) = (s - s_i) / (s_{i+k} - s_i) N_{i,k-1}(s)
                 + (s_{i+k+1} - s) / (s_{i+k+1} - s_{i+1}) N_{i+1,k-1}(s),

with 0 / 0 = 0. The paper prints eq. 2 with s_{i+k-1} and s_{i+k} in place of s_{i+k} and
s_{i+k+1}. The printed indices are right if k is the order, which is the degree + 1, but the paper's
text calls k the degree. Eq. 3 is printed with m + 1 terms for m control points. The paper does not
list the knots. Clamped means that the first and the last knot have multiplicity k + 1, so that the
curve starts and ends at its first and last control point. Uniform means that the m - k spans
between distinct knots have equal lengths.

A curve and its derivatives lie in the convex hulls of their own control points. A bound on the
control points that `hodograph` computes therefore bounds the derivative everywhere. All maps that
are linear in the control points are constant NumPy matrices in double precision.
"""

import math

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.trajectory.polynomial import PiecewisePolynomial


def basis(degree: int, num: int, shares: ArrayLike) -> np.ndarray:
    """Return the matrix (..., num) that maps `num` control points to points on the curve.

    Args:
        degree: degree of the curve, >= 0.
        num: number of control points, more than the degree.
        shares: (...), where the points are, as fractions of the curve's duration from 0 to 1.

    Raises:
        ArgumentError: there are too few control points, or a position is outside 0 to 1.
    """
    shares = np.asarray(shares, float)
    if not ((shares >= 0.0) & (shares <= 1.0)).all():
        outside = np.ravel(shares)[np.argmax(np.abs(np.ravel(shares) - 0.5))]
        raise ArgumentError("shares", "from 0 to 1", outside)
    return _basis(degree, num, shares * _spans(degree, num))


def hodograph(degree: int, order: int, num: int) -> np.ndarray:
    """Return the matrix (num - order, num) from control points to a derivative's control points.

    A derivative of a B-spline is a B-spline over the same knot spans. The matrix gives the
    derivative by the fraction s of the duration; divide by duration^order for a derivative by time.
    For degree k, control points p_i and knots s_i, control point i of the first derivative is
    k (p_{i+1} - p_i) / (s_{i+k+1} - s_{i+1}).

    Args:
        degree: degree of the curve.
        order: order of the derivative, 0 to `degree`.
        num: number of control points, more than the degree.

    Raises:
        ArgumentError: there are not more control points than the degree.
    """
    spans = _spans(degree, num)
    points = np.eye(num)
    for k in range(degree, degree - order, -1):
        knots = _knots(k, spans)[1:-1]
        widths = (knots[k:] - knots[:-k]) / spans
        points = k * np.diff(points, axis=0) / widths[:, None]
    return points


def b_spline(degree: int, points: ArrayLike, duration: ArrayLike) -> PiecewisePolynomial:
    """Return a B-spline as a piecewise polynomial, with one piece per knot span.

    Args:
        degree: k, degree of the curve.
        points: (m, D), m > k control points of D coordinates; the curve starts at the first and
            ends at the last.
        duration: () [s], > 0, duration of the curve.

    Returns:
        m - k pieces of equal duration, with coefficients (m - k, k + 1, D).

    Raises:
        ArgumentError: there are not more control points than the degree.
    """
    points = jnp.asarray(points)
    num = points.shape[0]
    spans = _spans(degree, num)
    taylor = [
        _basis(degree - k, num - k, np.arange(spans))
        @ hodograph(degree, k, num)
        / math.factorial(k)
        for k in range(degree + 1)
    ]
    of_points = jnp.asarray(np.stack(taylor, axis=1), points.dtype)
    coeffs = jnp.einsum("ikm,md->ikd", of_points, points, precision=lax.Precision.HIGHEST)
    duration = jnp.asarray(duration, points.dtype)
    return PiecewisePolynomial(
        coeffs=coeffs / duration ** np.arange(degree + 1)[:, None],
        durations=jnp.full(spans, duration / spans),
    )


def _spans(degree: int, num: int) -> int:
    require(num > degree, "control points", f"more than the degree {degree}", num)
    return num - degree


def _knots(degree: int, spans: int) -> np.ndarray:
    return np.clip(np.arange(spans + 2 * degree + 1) - degree, 0, spans)


def _basis(degree: int, num: int, place: np.ndarray) -> np.ndarray:
    spans = num - degree
    knots = _knots(degree, spans)
    span = np.minimum(np.floor(place), spans - 1)  # the last span includes its end
    is_in = np.arange(spans) == span[..., None]
    values = np.zeros((*place.shape, spans + 2 * degree))
    values[..., degree : degree + spans] = is_in
    for k in range(1, degree + 1):
        rises = (place[..., None] - knots[: -k - 1]) / np.maximum(knots[k:-1] - knots[: -k - 1], 1)
        falls = (knots[k + 1 :] - place[..., None]) / np.maximum(knots[k + 1 :] - knots[1:-k], 1)
        values = rises * values[..., :-1] + falls * values[..., 1:]
    return values
