"""Noisy observations of a target in the plane, centred at their means for a fit.

World frame, SI units, one target. An observation that is not finite, or has weight zero, counts as
absent, so that array shapes do not depend on the number of observations. In this package, points
of the plane are pairs (x, y) of arrays, also where formulas treat them as complex numbers x + i y.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from planner_jax.core.errors import ArgumentError

Pair = tuple[Array, Array]  # x and y of points of the plane, each (...)


class Centred(NamedTuple):
    """L observations of a target, minus the weighted means of their times and positions."""

    weight: Array  # (L,), 0 where the observation is absent
    after: Array  # (L,) [s], time of each observation minus the mean time
    place: Pair  # each (L,) [m], position minus the mean position
    middle: Array  # () [s], weighted mean time
    centre: Pair  # each () [m], weighted mean position
    total: Array  # (), sum of the weights; 1 if all observations are absent
    num: Array  # (), number of present observations


def centre(
    times: ArrayLike, positions: ArrayLike, weights: ArrayLike | None, least: int
) -> Centred:
    """Subtract the weighted means from times (L,) and positions (L, 2) of L observations.

    Raises:
        ValueError: the shapes do not match, or the arrays hold fewer than `least` observations.
    """
    # NumPy converts the types, since JAX 0.10 remembers the first precision of a NumPy array.
    dtype = jnp.promote_types(jnp.result_type(times, positions), jnp.float32)
    times, positions = jnp.asarray(times, dtype), jnp.asarray(positions, dtype)
    if times.ndim != 1 or positions.shape != (*times.shape, 2):
        raise ArgumentError(
            "times", "(L,) and positions (L, 2)", shown=f"{times.shape} and {positions.shape}"
        )
    if times.shape[0] < least:
        raise ArgumentError("times", f"of at least {least} observations", times.shape[0])
    given = jnp.ones(times.shape, dtype) if weights is None else jnp.asarray(weights, dtype)
    if given.shape != times.shape:
        raise ArgumentError("weights", f"(L,) as times {times.shape}", given.shape)
    present = jnp.isfinite(times) & jnp.all(jnp.isfinite(positions), axis=-1) & (given > 0.0)
    weight = jnp.where(present, given, 0.0)
    total = jnp.where(jnp.any(present), jnp.sum(weight), 1.0)
    after, x, y = (jnp.where(present, each, 0.0) for each in (times, *positions.T))
    middle, centre_x, centre_y = (jnp.sum(weight * each) / total for each in (after, x, y))
    return Centred(
        weight=weight,
        after=jnp.where(present, after - middle, 0.0),
        place=(jnp.where(present, x - centre_x, 0.0), jnp.where(present, y - centre_y, 0.0)),
        middle=middle,
        centre=(centre_x, centre_y),
        total=total,
        num=jnp.sum(present).astype(dtype),
    )
