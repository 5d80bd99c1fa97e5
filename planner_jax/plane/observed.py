"""Noisy observations of a target in the plane: kept as they come, and made ready for a fit.

World frame, SI units, one target. An observation that is not finite, or of weight zero, counts as
absent, so that shapes stay fixed. Inside the fits points are pairs (x, y) of arrays.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from flax import struct
from jax import Array

Pair = tuple[Array, Array]  # x and y of points of the plane, each (...)


@struct.dataclass
class Observations:
    """The last L observations, in no order; entries not made yet are NaN.

    Its arrays are what `select` and the fits take: what was seen one by one is predicted from as
    what was seen at once, to rounding.
    """

    times: Array  # (L,) [s]
    positions: Array  # (L, 2) [m]
    num: Array  # () int32, how many were made in all


def no_observations(room: int, dtype: Any = jnp.float32) -> Observations:
    """Room for the last L observations, none made.

    Raises:
        ValueError: the room is not positive.
    """
    if room < 1:
        raise ValueError(f"room must be >= 1, got {room}")
    return Observations(
        times=jnp.full(room, jnp.nan, dtype),
        positions=jnp.full((room, 2), jnp.nan, dtype),
        num=jnp.zeros((), jnp.int32),
    )


def observe(seen: Observations, time: Any, position: Any) -> Observations:
    """One observation more at a time () [s] of a position (2,) [m]; it takes the oldest's place.

    One that is not finite passes without a trace.
    """
    time = jnp.asarray(time, seen.times.dtype)
    position = jnp.asarray(position, seen.positions.dtype)
    room = seen.times.shape[0]
    finite = jnp.isfinite(time) & jnp.all(jnp.isfinite(position))
    here = finite & (jnp.arange(room) == seen.num % room)
    return Observations(
        times=jnp.where(here, time, seen.times),
        positions=jnp.where(here[:, None], position, seen.positions),
        num=seen.num + finite.astype(seen.num.dtype),
    )


class Centred(NamedTuple):
    """Observations around their weighted means."""

    weight: Array  # (L,), 0 where absent
    after: Array  # (L,) [s], from the middle on
    place: Pair  # each (L,) [m], from the centre
    middle: Array  # () [s]
    centre: Pair  # each () [m]
    total: Array  # () sum of the weights; 1 if all are absent
    num: Array  # () how many are present


def centred(times: Any, positions: Any, weights: Any, least: int) -> Centred:
    """Observations at times (L,) of positions (L, 2), with weights (L,) or None, for a fit.

    Raises:
        ValueError: the shapes do not match, or there is no room for the `least` observations; one
            line.
    """
    times, positions = jnp.asarray(times), jnp.asarray(positions)
    if times.ndim != 1 or positions.shape != (*times.shape, 2):
        raise ValueError(
            f"times must be (L,) and positions (L, 2), got {times.shape} and {positions.shape}"
        )
    if times.shape[0] < least:
        raise ValueError(f"times must be of at least {least} observations, got {times.shape[0]}")
    dtype = jnp.promote_types(jnp.result_type(times, positions), jnp.float32)
    given = jnp.ones(times.shape, dtype) if weights is None else jnp.asarray(weights, dtype)
    if given.shape != times.shape:
        raise ValueError(f"weights must be (L,) as times {times.shape}, got {given.shape}")
    times, positions = times.astype(dtype), positions.astype(dtype)
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


def safe_sqrt(value: Array) -> Array:
    """Roots of numbers (...) >= 0, of slope zero at zero."""
    positive = value > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)
