"""What a solver knows of an objective at a point, and which of two points it keeps."""

from collections.abc import Callable

import jax.numpy as jnp
from flax import struct
from jax import Array


@struct.dataclass
class Evaluation:
    """An objective at one point."""

    cost: Array  # (), what is minimised
    violation: Array  # (), largest relative excess over a limit; <= 0 is feasible


Objective = Callable[[Array], Evaluation]


def better(a: Evaluation, b: Evaluation) -> Array:
    """Whether a beats b: feasible before infeasible, then cost, or violation if neither is."""
    both = (a.violation <= 0.0) & (b.violation <= 0.0)
    by_cost = a.cost < b.cost
    by_violation = jnp.maximum(a.violation, 0.0) < jnp.maximum(b.violation, 0.0)
    return jnp.where(both, by_cost, by_violation) | ~jnp.isfinite(b.cost)
