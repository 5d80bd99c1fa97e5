"""Sampling of plans at equally spaced times, for the method `sample` of every robot's plans."""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.core.checks import require_number
from planner_jax.core.errors import ArgumentError
from planner_jax.core.rules import POSITIVE

_MOST = 10**8  # greatest number of setpoints that one call may compute
# (number of plans, number of times) in one compiled call, for a single plan and for a batch.
_ONE, _BATCH = (1, 1024), (64, 64)
TreeT = TypeVar("TreeT")


def sample_at_rate(
    rate: float,
    ends: ArrayLike,
    leaves: TreeT,
    setpoint_at: Callable[[TreeT, Array], dict[str, Array]],
) -> dict[str, np.ndarray]:
    """Sample a plan, or a batch of plans, at equally spaced times from start to end.

    Args:
        rate: [Hz], number of samples in a second.
        ends: () [s], end of the plan, or (B,) for a batch of B plans.
        leaves: pytree of the arrays that describe the plans, with their batch shape.
        setpoint_at: pure function (leaves of a plan, time () [s]) -> quantities by name.

    Returns:
        "time" (K,) [s], K times, and quantities (K, ...) or (B, K, ...), NaN after a plan's end.

    Raises:
        TypeError: the rate is not a number.
        ValueError: the rate is not positive, or there would be more than 1e8 setpoints.
    """
    require_number("rate", rate, POSITIVE)
    ends, leaves = np.asarray(ends), jax.tree.map(np.asarray, leaves)
    if is_one := ends.ndim == 0:
        ends, leaves = ends[None], jax.tree.map(lambda leaf: leaf[None], leaves)
    last = np.nanmax(ends, initial=0.0)
    if last * rate * ends.size > _MOST:
        most = _MOST / (last * ends.size)
        rule = f"at most {most:.3g} for {ends.size} plans of up to {last:.3g} s"
        raise ArgumentError("rate", rule, rate)
    times = np.arange(int(last * rate * (1.0 + 1e-6)) + 1) / rate
    setpoints = _in_tiles(leaves, times.astype(ends.dtype), setpoint_at, _ONE if is_one else _BATCH)
    past = ~(times <= ends[:, None] * (1.0 + 1e-6))
    for leaf in setpoints.values():
        leaf[past] = np.nan
    return {"time": times} | {n: leaf[0] if is_one else leaf for n, leaf in setpoints.items()}


def _in_tiles(
    leaves: object, times: np.ndarray, setpoint_at: Callable, tile: tuple[int, int]
) -> dict[str, np.ndarray]:
    num, found = jax.tree.leaves(leaves)[0].shape[0], {}
    for i in range(0, num, tile[0]):
        plans = np.minimum(np.arange(i, i + tile[0]), num - 1)
        some = jax.tree.map(lambda leaf: leaf[plans], leaves)  # noqa: B023
        for k in range(0, times.size, tile[1]):
            at = times[np.minimum(np.arange(k, k + tile[1]), times.size - 1)]
            for name, part in _sample(some, at, setpoint_at).items():
                if name not in found:
                    found[name] = np.empty((num, times.size, *part.shape[2:]), part.dtype)
                place = found[name][i : i + tile[0], k : k + tile[1]]
                place[:] = np.asarray(part)[: place.shape[0], : place.shape[1]]
    return found


@functools.partial(jax.jit, static_argnames="setpoint_at")
def _sample(leaves: object, times: Array, setpoint_at: Callable) -> dict[str, Array]:
    """Evaluate `setpoint_at` for B plans with leaves (B, ...) at K times: arrays (B, K, ...)."""
    return jax.vmap(jax.vmap(setpoint_at, in_axes=(None, 0)), in_axes=(0, None))(leaves, times)
