"""The loop over the attempts (searches) of a planner inside a compiled program, for `pj.solve`."""

import functools
import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_batching import custom_vmap
from jaxtyping import PyTree

from planner_jax.core.planner import Drive, Planner
from planner_jax.core.protocol import BaseAttempt, is_solved, is_unsolved, select
from planner_jax.planning.programs import score_of, solve_cases


def plan_mapped(drive: Drive, planner: Planner, cases: PyTree) -> PyTree:
    """Return plans by `drive`; `vmap` makes one batch of its lanes, where solved ones take no time.

    If each lane has a planner of its own, `drive` is mapped over the lanes instead.
    """

    @custom_vmap
    def plan_together(planner: PyTree, cases: PyTree) -> PyTree:
        return drive(planner, cases)[0]

    @plan_together.def_vmap
    def _(size: int, is_mapped: Sequence[PyTree], planner: PyTree, cases: PyTree) -> tuple:
        if any(jax.tree.leaves(is_mapped[0])):
            axes = jax.tree.map(lambda each: 0 if each else None, tuple(is_mapped))
            plans = jax.vmap(drive, axes, axis_size=size)(planner, cases)[0]
        else:
            spread = lambda x, own: x if own else jnp.broadcast_to(x, (size, *jnp.shape(x)))  # noqa: E731
            cases = jax.tree.map(spread, cases, is_mapped[1])
            inner = tuple(cases.batch_shape)[1:]  # the axis of a batch below `vmap`
            flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[1 + len(inner) :]), cases)
            plans = plan_together(planner, flat)
            plans = jax.tree.map(lambda x: x.reshape(size, *inner, *x.shape[1:]), plans)
        return plans, jax.tree.map(lambda _: True, plans)

    return plan_together(planner, cases)


def plan_purely(planner: Planner, attempts: Sequence[BaseAttempt], cases: PyTree) -> PyTree:
    """Return plans as jax arrays; while any case is unsolved, searches are made for all cases."""
    plans: PyTree = None
    pairs = [(attempt, planner.load(attempt, cases)[1]) for attempt in attempts]
    if attempts[0].continues:
        return _plan_in_groups(planner, pairs, cases)
    # Consecutive attempts (searches) with pytrees of equal structure share one compiled loop.
    for _, same in itertools.groupby(pairs, lambda pair: jax.tree.structure(pair[1])):
        group, loaded = zip(*same, strict=True)
        solve_by = functools.partial(_solve_by, planner, cases, loaded)
        is_start = plans is None
        if is_start:
            shapes = jax.eval_shape(solve_by, 0)
            plans = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        within = [np.inf if each.within is None else each.within for each in group]
        greatest = jnp.asarray(within, plans.violation.dtype)
        improves = jnp.asarray([each.improves for each in group])

        def try_next(
            k: Array,
            plans: PyTree,
            solve_by=solve_by,
            greatest=greatest,
            improves=improves,
            is_start=is_start,
        ) -> PyTree:
            is_first = is_start & (k == 0)
            due = is_unsolved(plans.status) & (plans.violation <= greatest[k])
            due |= is_solved(plans.status) & improves[k]

            def solve_again(plans: PyTree) -> PyTree:
                later = solve_by(k)
                better = select(later, plans, due)
                return jax.tree.map(lambda a, b: jnp.where(is_first, a, b), later, better)

            return lax.cond(is_first | jnp.any(due), solve_again, lambda plans: plans, plans)

        plans = lax.fori_loop(0, len(group), try_next, plans)
    return plans


def _plan_in_groups(
    planner: Planner, pairs: Sequence[tuple[BaseAttempt, PyTree]], cases: PyTree
) -> PyTree:
    (first, loaded), *others = pairs
    plans = solve_cases(planner, cases, loaded, score_of(first, cases, None))
    for attempt, loaded in others:

        def improve(plans: PyTree, attempt=attempt, loaded=loaded) -> PyTree:
            before = score_of(attempt, cases, plans)
            return select(solve_cases(planner, cases, loaded, before), plans)

        plans = lax.cond(jnp.any(attempt.is_due(plans)), improve, lambda plans: plans, plans)
    return plans


def _solve_by(planner: Planner, cases: PyTree, loaded: Sequence[PyTree], k: Array | int) -> PyTree:
    if len(loaded) == 1:
        return solve_cases(planner, cases, loaded[0])
    return solve_cases(planner, cases, jax.tree.map(lambda *leaves: jnp.stack(leaves)[k], *loaded))
