"""Plans at equally spaced times, whatever robot they are of."""

from collections.abc import Callable, Mapping

import jax
import numpy as np
from jax import Array


def sampled_at_rate(
    rate: float,
    ends: np.ndarray,
    sample: Callable[[np.ndarray], Mapping[str, Array]],
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A plan, or a batch of them, at a rate [Hz] from its beginning up to its end.

    Args:
        rate: [Hz].
        ends: () or (B,) [s], when each plan ends.
        sample: of times (K,) [s] the setpoints of all plans by name, leaves (B, K, ...) with B = 1
            for one plan.

    Returns:
        times: (K,) [s].
        setpoints: by name, (K, ...) of one plan, (B, K, ...) of a batch; NaN past each plan's end.

    Raises:
        ValueError: the rate is not positive.
    """
    if not rate > 0.0:
        raise ValueError(f"rate must be > 0, got {rate}")
    last = np.nanmax(ends, initial=0.0)
    times = np.arange(int(last * rate * (1.0 + 1e-6)) + 1) / rate
    setpoints = jax.tree.map(np.array, dict(sample(times)))
    past = ~(times <= np.reshape(ends, (-1, 1)) * (1.0 + 1e-6))
    for leaf in setpoints.values():
        leaf[past] = np.nan
    if np.ndim(ends) == 0:
        setpoints = {name: leaf[0] for name, leaf in setpoints.items()}
    return times, setpoints
