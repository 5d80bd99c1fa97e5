"""Polynomials in time, fitted to observations of a target [Qu2022, eqs 9-11].

Each additional degree amplifies the noise of a prediction, and a straight line misses targets that
turn. `planner_jax.sims.prediction.select_path.select` usually predicts better than any polynomial.
"""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from planner_jax.core.errors import ArgumentError
from planner_jax.plane.target import PolynomialPath
from planner_jax.sims.prediction.observed import centre


def fit_polynomial(
    times: ArrayLike, positions: ArrayLike, degree: int, weights: ArrayLike | None = None
) -> PolynomialPath:
    """Fit a polynomial in time to observed positions by least squares [Qu2022, eqs 9 and 10].

    The paper solves the normal equations (eq. 11). Here a QR decomposition by Gram-Schmidt is used
    instead, with times scaled to -1 to 1, since it has smaller rounding errors. If fewer
    observations are present than coefficients, the degree is reduced accordingly.

    Args:
        times: (L,) [s], times of L observations.
        positions: (L, 2) [m], observed positions.
        degree: degree of the polynomial, 1 to 3.
        weights: (L,) >= 0, proportional to the inverse variance of each observation; 1 by default.
            An observation of weight zero, or not finite, is absent.

    Raises:
        ValueError: the degree is not 1, 2 or 3, the arrays hold fewer than degree + 1 observations,
            or the shapes do not match.
    """
    if degree not in (1, 2, 3):
        raise ArgumentError("degree", "1, 2 or 3", degree)
    seen = centre(times, positions, weights, degree + 1)
    span = jnp.max(jnp.abs(seen.after))
    span = jnp.where(span > 0.0, span, 1.0)
    present = seen.weight > 0.0
    root = jnp.where(present, jnp.sqrt(jnp.where(present, seen.weight, 1.0)), 0.0)[:, None]
    columns, values = (
        root * _powers(seen.after / span, degree),
        root * jnp.stack(seen.place, axis=-1),
    )
    rows, right = [], []
    for k in range(degree + 1):  # Gram-Schmidt: make the later columns orthogonal to column k
        total = jnp.sum(columns[:, k] ** 2)
        length = jnp.sqrt(jnp.where(total > 0.0, total, 1.0))
        unit = jnp.where(total > 0.0, columns[:, k] / length, 0.0)[:, None]
        row, of_values = jnp.sum(unit * columns, axis=0), jnp.sum(unit * values, axis=0)
        columns, values = columns - unit * row[None], values - unit * of_values[None]
        rows.append(jnp.where(jnp.arange(degree + 1) < k, 0.0, row))
        right.append(of_values)
    coeffs = _coefficients(jnp.stack(rows), jnp.stack(right), span)
    return PolynomialPath(coeffs=coeffs.at[0].add(jnp.stack(seen.centre)), origin=seen.middle)


def _coefficients(root: Array, values: Array, span: Array) -> Array:
    """Solve R X = Y for the coefficients X, with `root` as the triangular R and `values` as Y.

    R and Y are for scaled times (time / `span`), but X is returned for times in seconds. A
    coefficient is zero where R's diagonal is zero up to rounding, since observations do not
    determine this coefficient.
    """
    found = jnp.zeros_like(values)
    rounding = (32.0 * jnp.finfo(root.dtype).eps) ** 2
    for k in reversed(range(root.shape[0])):
        known = root[k, k] ** 2 > rounding * jnp.sum(root[:, k] ** 2)
        left = values[k] - jnp.sum(root[k, :, None] * found, axis=0)
        found = found.at[k].set(jnp.where(known, left / jnp.where(known, root[k, k], 1.0), 0.0))
    return found / _powers(span, root.shape[0] - 1)[:, None]


def _powers(x: Array, degree: int) -> Array:
    return jnp.stack([x**k for k in range(degree + 1)], axis=-1)
