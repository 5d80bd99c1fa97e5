"""When a target can be met first, by the reach set alone: no way is drawn, nothing is optimised."""

import jax.numpy as jnp
from jax import Array

from planner_jax.plane.reach import Lattice
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from planner_jax.task.intercept.searches import Search

# Spelled out, since what is drawn by them is published.
_SEARCH = Search(ways=1, lattice=Lattice(64, 30, 4, 32, 6.0), girth=1.0)
_PLANNER = SpacetimeIntercept(meet="early")


def earliest_arrival(case: InterceptCase) -> Array:
    """The time () [s] of the first layer of a reach set at which one case's target is met.

    The layers are those of `plane.reach` on its default lattice for the case's time, half a
    second apart where that is 10 s. Infinite where no layer up to that time meets the target; pure.
    """
    found = _PLANNER.prepare(case, _SEARCH)
    first = jnp.argmax(found.layers).astype(case.time.dtype)
    return jnp.where(found.is_reached, (first + 0.5) * found.grid.step, jnp.inf)
