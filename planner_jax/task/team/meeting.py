"""Limits and paths that plans of several robots share: stricter limits, hovering, distances."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.arithmetic import Numbers, numpy_of
from planner_jax.task.team.case import TeamCase
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

# Relative difference of the limits in plans of several robots from the case's limits: between the
# samples at which a planner evaluates limits, a trajectory may exceed them slightly.
_STRICTER = 2e-3
TIMES = 1024  # number of times at which the distance of two robots is compared
_HOVER = 1.0  # [s], duration of the recovery of a robot that catches nothing


def with_stricter_limits(cases: TeamCase) -> TeamCase:
    """Return one case, or a batch, with the limits that plans of several robots keep."""
    limits = cases.shared.limits.scale(1.0 - _STRICTER, cases.shared.gravity)
    height = limits.min_height + _STRICTER * abs(limits.min_height)
    shared = dataclasses.replace(
        cases.shared, limits=dataclasses.replace(limits, min_height=height)
    )
    return dataclasses.replace(cases, shared=shared)


def hover_recovery(start: Numbers, pieces: int) -> PiecewisePolynomial:
    """Return recoveries of robots that hover at positions (B, 3) [m], of so many pieces."""
    xp = numpy_of(start)
    at_start = xp.broadcast_to(start[:, None, None], (len(start), pieces, 1, 3))
    still = xp.zeros((len(start), pieces, 7, 3), start.dtype)
    lasting = xp.full((len(start), pieces), _HOVER / pieces, start.dtype)
    return PiecewisePolynomial(xp.concatenate([at_start, still], axis=2), lasting)


@jax.jit
def sample_positions(whole: PiecewisePolynomial, times: Array) -> Array:
    """Return positions (N, K, B, T, 3) of robots at times (B, T); they stand after their ends."""

    def at(path: PiecewisePolynomial, times: Array) -> Array:
        end = jnp.sum(path.durations)
        return jax.vmap(lambda time: evaluate(path, jnp.minimum(time, end)))(times)

    return jax.vmap(jax.vmap(jax.vmap(at), (0, None)), (0, None))(whole, times)


def least_distances(whole: PiecewisePolynomial) -> Array:
    """Return the least distance [m] of each pair of N robots, (N (N - 1) / 2,); inf if N = 1."""
    num, ends = len(whole.durations), jnp.sum(whole.durations, axis=1)
    if num == 1:
        return jnp.full((1,), jnp.inf, ends.dtype)
    times = jnp.max(ends) * jnp.asarray(np.linspace(0.0, 1.0, TIMES), ends.dtype)
    many = jax.tree.map(lambda leaf: leaf[:, None, None], whole)
    pos = sample_positions(many, times[None])[:, 0, 0]
    first, second = np.array(list(itertools.combinations(range(num), 2))).T
    return jnp.sqrt(jnp.min(jnp.sum((pos[first] - pos[second]) ** 2, axis=2), axis=1) + 1e-12)
