"""The fields of plans of planners that do not iterate."""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.checks import shape_of
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import status_of


def outcome(cost: Array, violation: Array, *, stationary: Array | bool = True) -> dict[str, PyTree]:
    """Return the fields that every `Plan` has, for a planner that does not iterate.

    Args:
        cost: (), the planner's own objective.
        violation: (), largest relative excess over a limit that the planner checks.
        stationary: () bool, whether a further search would not change the plan.
    """
    shape = shape_of("cost", cost)
    for name, value in (("violation", violation), ("stationary", stationary)):
        if shape_of(name, value) not in ((), shape):
            raise ArgumentError(name, f"the shape of cost, {shape}", np.shape(value), verb="have")
    cost, violation, stationary = map(jnp.asarray, (cost, violation, stationary))
    return {
        "cost": cost,
        "violation": violation,
        "iterations": jnp.zeros(shape, jnp.int32),
        "status": status_of(cost, violation, stationary),
    }
