"""Newton's method for many problems at once; problems with most to gain continue longest."""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.lanes import over_lanes
from planner_jax.optimise import newton
from planner_jax.optimise.multistart import Optimum, optimum_of
from planner_jax.optimise.settings import Curvature, Evaluation, NewtonConfig


def minimise_lanes(
    objective: Callable[[Array, PyTree], Evaluation],
    starts: Array,
    contexts: PyTree,
    config: NewtonConfig,
    curved: Callable[[Array, PyTree], Curvature] | None = None,
) -> Optimum:
    """Minimise B problems of n variables by Newton's method, each with its own start.

    `starts` is (n, B). A context is the pytree of a problem's data. In all arrays of `contexts` and
    of the result, the last axis counts problems. `objective` and `curved` take a point (n,) and the
    context of one problem. `curved` returns the derivatives for Newton's method; if it is None,
    they are computed from `objective` by automatic differentiation.
    """

    def step(config: NewtonConfig, state: PyTree, context: PyTree) -> PyTree:
        own = lambda x: objective(x, context)  # noqa: E731
        by_point = (lambda x: curved(x, context)) if curved else newton.by_products(own)  # pyright: ignore[reportOptionalCall]
        return newton.step(own, by_point, state, config)

    advance = over_lanes(functools.partial(step, config))
    state = lax.while_loop(
        lambda s: jnp.any(newton.is_unfinished(s.numbers, config)),
        lambda s: advance(s, contexts),
        over_lanes(lambda start: newton.init(start, config))(starts),
    )
    if config.stragglers is not None:
        share, steps, groups = config.stragglers
        longer, num = newton.with_stragglers(config), math.ceil(share * starts.shape[-1])

        advance_longer = over_lanes(functools.partial(step, longer))

        def next_group(progress: tuple[Array, PyTree]) -> tuple[Array, PyTree]:
            number, state = progress
            lanes = newton.most_to_gain(state.numbers, longer, num)
            some, own = jax.tree.map(lambda leaf: leaf[..., lanes], (state, contexts))
            later = lax.fori_loop(0, steps, lambda _, s: advance_longer(s, own), some)
            place = lambda old, new: old.at[..., lanes].set(new)  # noqa: E731
            return number + 1, jax.tree.map(place, state, later)

        def is_open(progress: tuple[Array, PyTree]) -> Array:
            number, state = progress
            return (number < groups) & jnp.any(newton.is_unfinished(state.numbers, longer))

        _, state = lax.while_loop(is_open, next_group, (jnp.zeros((), jnp.int32), state))
    return optimum_of(state, config)
