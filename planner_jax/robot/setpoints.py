"""Plans at equally spaced times, whatever robot they are of."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax import Array

from planner_jax.core.checks import require_number
from planner_jax.core.errors import ArgumentError

_MOST = 10**8  # setpoints of a batch


def sampled_at_rate(
    rate: float,
    ends: Any,
    leaves: Any,
    sample: Callable[[Any, np.ndarray], Mapping[str, Array]],
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A plan, or a batch of them, at a rate [Hz] from its beginning up to its end.

    Args:
        rate: [Hz].
        ends: () or (B,) [s], when each plan ends.
        leaves: a pytree of what else there is of the plans, with their batch shape.
        sample: of these leaves, (B, ...) with B = 1 for one plan, and times (K,) [s] the setpoints
            by name, (B, K, ...).

    Returns:
        times: (K,) [s].
        setpoints: by name, (K, ...) of one plan, (B, K, ...) of a batch; NaN past each plan's end.

    Raises:
        TypeError: the rate is no number.
        ValueError: the rate is not positive, or there would be more than 1e8 setpoints.
    """
    require_number("rate", rate, "finite and > 0", lambda x: x > 0.0)
    leaves, ends = jax.tree.map(np.asarray, (leaves, ends))
    is_one = ends.ndim == 0
    if is_one:
        leaves, ends = jax.tree.map(lambda leaf: leaf[None], (leaves, ends))
    last = np.nanmax(ends, initial=0.0)
    if last * rate * ends.size > _MOST:
        most = _MOST / (last * ends.size)
        rule = f"at most {most:.3g} for {ends.size} plans of up to {last:.3g} s"
        raise ArgumentError("rate", rule, rate)
    times = np.arange(int(last * rate * (1.0 + 1e-6)) + 1) / rate
    setpoints = jax.tree.map(np.array, dict(sample(leaves, times.astype(ends.dtype))))
    past = ~(times <= ends[:, None] * (1.0 + 1e-6))
    for leaf in setpoints.values():
        leaf[past] = np.nan
    if is_one:
        setpoints = {name: leaf[0] for name, leaf in setpoints.items()}
    return times, setpoints
