"""Polynomials through observations of a target, at once and one by one (paper 003, eqs 9-11).

Each additional degree multiplies the noise of a prediction, and a straight line misses targets
that turn: `planner_jax.plane.prediction.select` usually does better than any of them.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.plane.observed import centred
from planner_jax.plane.target import PolynomialPath


def fit_polynomial(times: Any, positions: Any, degree: int, weights: Any = None) -> PolynomialPath:
    """The polynomial of least squares through observations (paper 003, eqs 9 and 10).

    Orthogonal columns in normalised time stand for the normal equations of eq. 11, whose H is
    printed as the sum T'T, and would there be squared once too often. With fewer observations
    than coefficients the degree is as high as they allow.

    Args:
        times: (L,) [s].
        positions: (L, 2) [m].
        degree: n, 1 to 3.
        weights: (L,) >= 0, proportional to the inverse variance of each observation; 1 if not
            given. One of weight zero, or not finite, is absent.

    Raises:
        ValueError: the degree is another one, there is no room for degree + 1 observations, or
            the shapes do not match; one line.
    """
    _check_degree(degree)
    seen = centred(times, positions, weights, degree + 1)
    span = jnp.max(jnp.abs(seen.after))
    span = jnp.where(span > 0.0, span, 1.0)
    present = seen.weight > 0.0
    root = jnp.where(present, jnp.sqrt(jnp.where(present, seen.weight, 1.0)), 0.0)[:, None]
    columns, values = (
        root * _powers(seen.after / span, degree),
        root * jnp.stack(seen.place, axis=-1),
    )
    rows, right = [], []
    for k in range(degree + 1):  # Gram-Schmidt, each column off all that follow
        total = jnp.sum(columns[:, k] ** 2)
        length = jnp.sqrt(jnp.where(total > 0.0, total, 1.0))
        unit = jnp.where(total > 0.0, columns[:, k] / length, 0.0)[:, None]
        row, of_values = jnp.sum(unit * columns, axis=0), jnp.sum(unit * values, axis=0)
        columns, values = columns - unit * row, values - unit * of_values
        rows.append(jnp.where(jnp.arange(degree + 1) < k, 0.0, row))
        right.append(of_values)
    coeffs = _coefficients(jnp.stack(rows), jnp.stack(right), span)
    return PolynomialPath(coeffs=coeffs.at[0].add(jnp.stack(seen.centre)), origin=seen.middle)


@struct.dataclass
class PolynomialState:
    """The polynomial of least squares through all observations so far.

    A triangle R and a right side Q'p of the weighted observations in normalised time, so that
    R'R is the H of paper 003, eq. 11, which is never formed. It equals the fit at once to
    rounding, and takes as little room for a thousand observations as for one.
    """

    root: Array  # (n + 1, n + 1) R
    values: Array  # (n + 1, 2) [m] Q'p
    origin: Array  # () [s]
    span: Array  # () [s]


def begin_polynomial(
    degree: int, origin: Any = 0.0, span: Any = 1.0, dtype: Any = jnp.float32
) -> PolynomialState:
    """A polynomial before the first observation.

    Args:
        degree: n, 1 to 3.
        origin: () [s], about the middle of the observations to come.
        span: () [s] > 0, about half their length.
        dtype: of every leaf.

    Raises:
        ValueError: the degree is another one.
    """
    _check_degree(degree)
    return PolynomialState(
        root=jnp.zeros((degree + 1, degree + 1), dtype),
        values=jnp.zeros((degree + 1, 2), dtype),
        origin=jnp.asarray(origin, dtype),
        span=jnp.asarray(span, dtype),
    )


def observe_polynomial(
    state: PolynomialState, time: Any, position: Any, weight: Any = 1.0
) -> PolynomialState:
    """One observation more, at a time () [s], of a position (2,) [m] and of a weight () >= 0.

    Rotations bring it into the triangle. One that is not finite passes without a trace.
    """
    dtype = state.root.dtype
    time, position, weight = (jnp.asarray(each, dtype) for each in (time, position, weight))
    usable = jnp.isfinite(time) & jnp.all(jnp.isfinite(position)) & (weight > 0.0)
    root = jnp.where(usable, jnp.sqrt(jnp.where(usable, weight, 1.0)), 0.0)
    num = state.root.shape[0]
    passed = (jnp.where(usable, time, state.origin) - state.origin) / state.span
    new = root * jnp.concatenate([_powers(passed, num - 1), jnp.where(usable, position, 0.0)])
    rows = []
    for k, row in enumerate(jnp.concatenate([state.root, state.values], axis=1)):
        total = row[k] ** 2 + new[k] ** 2
        length = jnp.sqrt(jnp.where(total > 0.0, total, 1.0))
        cos = jnp.where(total > 0.0, row[k] / length, 1.0)
        sin = jnp.where(total > 0.0, new[k] / length, 0.0)
        rows.append(cos * row + sin * new)
        new = cos * new - sin * row
    joined = jnp.stack(rows)
    return dataclasses.replace(state, root=joined[:, :num], values=joined[:, num:])


def polynomial_of(state: PolynomialState) -> PolynomialPath:
    """The path so far; of a lower degree where the observations are too few for its own."""
    return PolynomialPath(
        coeffs=_coefficients(state.root, state.values, state.span), origin=state.origin
    )


def _coefficients(root: Array, values: Array, span: Array) -> Array:
    """The X (n + 1, 2) [m/s^k] of  R X = Y, out of normalised time.

    Zero where R (n + 1, n + 1) has no more than rounding on its diagonal.
    """
    found = jnp.zeros_like(values)
    rounding = (32.0 * jnp.finfo(root.dtype).eps) ** 2
    for k in reversed(range(root.shape[0])):
        known = root[k, k] ** 2 > rounding * jnp.sum(root[:, k] ** 2)
        left = values[k] - jnp.sum(root[k, :, None] * found, axis=0)
        found = found.at[k].set(jnp.where(known, left / jnp.where(known, root[k, k], 1.0), 0.0))
    return found / _powers(span, root.shape[0] - 1)[:, None]


def _powers(x: Array, degree: int) -> Array:
    """Powers (..., degree + 1) of numbers (...)."""
    return jnp.stack([x**k for k in range(degree + 1)], axis=-1)


def _check_degree(degree: int) -> None:
    """Raises `ValueError` unless it is one of the fits'."""
    if degree not in (1, 2, 3):
        raise ValueError(f"degree must be 1, 2 or 3, got {degree}")
