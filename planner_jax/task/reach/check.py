"""Checks of an arm's motion for collisions, at states that are a small distance apart."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_clearance import clearances
from planner_jax.task.reach.case import ReachCase
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

_CHUNK = 16  # number of states that are checked together


def floors_of(ends: Array, margin: float) -> Array:
    """Return the distance (R,) [m] that each pair keeps, by its distance (R,) at the ends.

    It is half of the distance at the ends, but at most the `margin`.
    """
    return jnp.clip(0.5 * ends, 0.0, margin)


def least_excess(
    case: ReachCase,
    floors: Array,
    path: PiecewisePolynomial,
    resolution: Array | float,
) -> Array:
    """Return the least excess [m] of a pair's distance over its required distance.

    It is -inf if a joint exceeds its limits of angle. Each chunk of states covers the motion,
    and the check ends after the first chunk with a collision. The offsets of successive chunks
    follow the golden ratio, so that the first chunks leave no wide gaps.
    """
    rates = path.coeffs[:, 1]
    last = rates[-1:] + 2.0 * path.durations[-1] * path.coeffs[-1:, 2]
    speed = jnp.concatenate([rates, last]) * levers(case.arm)[None]
    speed = jnp.sqrt(jnp.sum(speed**2, axis=1))
    # Bounds of the distances from the start to the ends of the pieces.
    passed = jnp.cumsum(path.durations * jnp.maximum(speed[1:], speed[:-1]))
    passed, ends = (jnp.append(0.0, each) for each in (passed, jnp.cumsum(path.durations)))
    chunks = jnp.maximum(jnp.ceil(passed[-1] / (resolution * _CHUNK)), 1.0)
    num, lane = chunks.astype(jnp.int32), jnp.arange(_CHUNK, dtype=chunks.dtype)
    # The step between offsets has no common divisor with their number.
    steps = (0.618 * chunks).astype(jnp.int32) + jnp.arange(1, 9, dtype=jnp.int32)
    step = steps[jnp.argmax(jnp.gcd(steps, num) == 1)]

    def check(state: tuple[Array, Array]) -> tuple[Array, Array]:
        done, least = state
        offset = (done * step % num).astype(chunks.dtype)
        share = (lane * chunks + offset + 0.5) / (chunks * _CHUNK)
        times = jnp.interp(share * passed[-1], passed, ends)
        angles = jax.vmap(lambda time: evaluate(path, time))(times)
        near = jnp.min(clearances(case.arm, case.scene, angles) - floors[:, None])
        beyond = jnp.any(
            (angles < case.arm.lower[None] - 1e-4) | (angles > case.arm.upper[None] + 1e-4)
        )
        return done + 1, jnp.minimum(least, jnp.where(beyond, -jnp.inf, near))

    def is_open(state: tuple[Array, Array]) -> Array:
        return (state[0] < num) & (state[1] >= 0.0)

    first = (jnp.zeros_like(num), jnp.full_like(floors[0], jnp.inf))
    return lax.while_loop(is_open, check, first)[1]


def finite_bounds(case: ReachCase, lever: Array) -> tuple[Array, Array]:
    """Return bounds of random joint angles, times levers: at most one turn around the start."""
    lower = jnp.maximum(case.arm.lower, case.angles - 2.0 * jnp.pi)
    upper = jnp.minimum(case.arm.upper, case.angles + 2.0 * jnp.pi)
    return lower * lever, upper * lever


def levers(arm: Arm) -> Array:
    """Return bounds (n,) [m] of the distances of the arm's parts from each joint's axis."""
    steps = jnp.sqrt(jnp.sum(arm.origin**2, axis=1))
    link = np.asarray(arm.capsule_link)
    outer = jnp.sqrt(jnp.max(jnp.sum(arm.capsule_ends**2, axis=2), axis=1)) + arm.capsule_radius
    edges = jnp.sqrt(jnp.sum(arm.shield_centre**2)) + jnp.sqrt(jnp.sum(arm.shield_half**2))
    bounds, beyond = [], edges
    for k in reversed(range(arm.num)):
        own = np.flatnonzero(link == k)
        beyond = jnp.max(jnp.append(outer[own], beyond))
        bounds.append(beyond)
        beyond = beyond + steps[k]
    return jnp.stack(bounds[::-1])
