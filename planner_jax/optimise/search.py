"""The searches of planners that minimise, for `pj.plan` and `pj.solve`.

A planner's rounds (attempts) consist of stages, each a search whose settings are one row of a
table. A table of a single row, as first attempts have, is one search for each case; for other
tables see `tiles`. The lanes (cases) are last in the arrays of this module.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.compiled import traced_platform
from planner_jax.core.protocol import Score, is_better, is_solved, is_unsolved
from planner_jax.core.rules import has_rules, is_sound
from planner_jax.lanes import kernels, over_lanes
from planner_jax.optimise.multistart import (
    Optimum,
    minimise,
    optimum_at,
    plan_at,
    put_lanes_first,
    put_lanes_last,
)
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.rows import Model, Number, Row, Table
from planner_jax.optimise.settings import Evaluation, LbfgsConfig


@struct.dataclass
class Item:
    """The end of a search of one case from one starting point."""

    optimum: Optimum  # with the violation of the plan
    status: Array  # () int32


def solve_table(planner: OptimisedPlanner, table: Table, cases: PyTree, before: Score) -> PyTree:
    """Return the best plans of B cases over the rows of a table; pure.

    `before` has the numbers of the plans (B,) that earlier attempts found, of which a new plan must
    be better. Where none is, cost, violation and status are those of `before`, and all other arrays
    of the plan are zero.
    """
    search = Search(planner, planner.with_settings(table.finest), table, table.rows)
    if table.is_plain:
        return search.once(cases, before)
    from planner_jax.optimise.tiles import solve_in_tiles  # first attempts do not need it

    return solve_in_tiles(search, cases, before)


@dataclasses.dataclass(frozen=True)
class Search:
    """The searches of a table's rows, each from one starting point of each lane."""

    planner: OptimisedPlanner
    finest: OptimisedPlanner  # prepares cases, guesses and decodes for all models
    table: Table
    rows: Row  # leaves (R,)

    def once(self, cases: PyTree, before: Score) -> PyTree:
        """Search once for each case, by a table of one row, without tiles."""
        row = jax.tree.map(lambda column: column[0], self.rows)
        lanes = put_lanes_last(cases)
        index = jnp.broadcast_to(row.first, cases.batch_shape)
        _, plan = self.run(row, lanes, index, None)
        plans = put_lanes_first(plan)
        is_usable = is_sound(cases) if has_rules(cases) else True
        is_new = find_due(row, before, is_usable) & (row.is_first | is_better(plans, before))
        choose = lambda new, old: jnp.where(is_new, new, old)  # noqa: E731
        return plans.replace(**vars(jax.tree.map(choose, Score.of(plans), before)))

    def run(
        self, row: Row, cases: PyTree, index: Array, before: Item | None
    ) -> tuple[Item, PyTree]:
        """Search from guesses, or from where earlier searches ended; the lanes are last.

        With `before` as None, the row is the first one of a round.
        """
        most = self.table.guesses
        contexts = over(self.finest.prepare)(cases)
        inputs = over(self.finest.network_inputs)(contexts)

        def guess(context: PyTree, index: Array) -> Array:
            points = self.finest.guesses(context, most)
            is_own = jnp.arange(most, dtype=index.dtype)[:, None] == index
            return jnp.sum(jnp.where(is_own, points, 0.0), axis=0)

        old = None if before is None else before.optimum
        stay = lambda *_: old.point if old else index  # noqa: E731
        is_start = None if before is None else row.starts
        points = _if_starts(is_start, over(guess), stay, contexts, index)
        run = functools.partial(_minimise, self.planner, self.table, row, before is None)
        loops = [functools.partial(run, model) for model in self.table.models]
        given = points, inputs, contexts, index
        found = loops[0](*given) if len(loops) == 1 else lax.switch(row.model, loops, *given)
        if old is not None:
            spent = jnp.where(row.starts, 0, old.iterations)
            found = dataclasses.replace(found, iterations=spent + found.iterations)
            found = jax.tree.map(lambda new, old: jnp.where(row.is_last, old, new), found, old)
        plan = over(functools.partial(plan_at, self.finest))(found, contexts)
        evaluation = dataclasses.replace(found.evaluation, violation=plan.violation)
        found = dataclasses.replace(found, evaluation=evaluation)
        return Item(found, plan.status), plan


def over(function: Callable) -> Callable:
    """Map a function of one lane over the lanes, by `over_lanes` if there are several."""

    def call(*args: PyTree) -> PyTree:
        if jax.tree.leaves(args)[0].shape[-1] > 1:
            return over_lanes(function)(*args)
        alone = function(*jax.tree.map(lambda leaf: leaf[..., 0], args))
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[..., None], alone)

    return call


def find_due(row: Row, score: Score, is_usable: Array | bool) -> Array:
    """Return which cases need the round of a row, (B,) bool; padding of a batch needs none."""
    again = is_unsolved(score.status) & (score.violation <= row.within)
    again = (again | is_solved(score.status) & row.improves) & is_usable
    return again | row.is_first & is_unsolved(score.status)


def _if_starts(starts: Number | None, then: Callable, otherwise: Callable, *args: PyTree) -> Array:
    """Return one of two functions' results by whether a row is the first of a round; None: yes."""
    return then(*args) if starts is None else lax.cond(starts, then, otherwise, *args)


def is_on_gpu() -> bool:
    """Return whether the program that is being traced runs on a GPU."""
    platform = traced_platform()
    return kernels.has_gpu() if platform is None else platform != "cpu"


def _minimise(
    own: OptimisedPlanner,
    table: Table,
    row: Row,
    is_plain: bool,
    model: Model,
    starts: Array,
    inputs: Array,
    contexts: PyTree,
    index: Array,
) -> Optimum:
    """Minimise from points (n, lanes) of the finest model."""
    weights = {name: row.weights[name] for name in model.varying}
    planner, solver = own.with_settings(model.settings).with_weights(weights), model.solver
    size, free = len(starts), None if model.free is None else jnp.array(model.free)
    if free is not None:
        starts = starts[free]

    def select(start: Array, inputs: Array, context: PyTree, index: Array) -> Array:
        return jnp.where(index == 0, planner.first_start(start, inputs, context), start)

    keep = lambda starts, *_: starts  # noqa: E731
    is_start = None if is_plain else row.starts
    starts = _if_starts(is_start, over(select), keep, starts, inputs, contexts, index)
    held = None if planner.held is None else row.frozen & planner.held

    def objective(point: Array, given: tuple[Array, PyTree]) -> Evaluation:
        start, context = given
        if held is not None:
            point = jnp.where(held, start, point)
        return planner.objective(point, context)

    given = starts, contexts
    if isinstance(solver, LbfgsConfig) and solver.max_steps > 0:
        config = jax.tree.unflatten(jax.tree.structure(solver), row.solver)
        if table.is_plain and starts.shape[-1] == 1:
            alone = lambda x, given: minimise(lambda x: objective(x, given), x, config)  # noqa: E731
            found = over(alone)(starts, given)
        else:
            from planner_jax.optimise.tiles import minimise_tile  # single cases do not need it

            found = minimise_tile(objective, starts, given, config, solver.max_steps, table)
    elif isinstance(solver, LbfgsConfig):
        stay = lambda x, given: optimum_at(x, objective(x, given), solver)  # noqa: E731
        found = over(stay)(starts, given)
    else:
        from planner_jax.optimise.newton_lanes import minimise_lanes  # few searches need it

        curved = lambda x, given: planner.curvature_at(x, given[1])  # noqa: E731
        found = minimise_lanes(objective, starts, given, solver, curved)
    if free is None:
        return found
    point = jnp.zeros((size, *found.point.shape[1:]), found.point.dtype)
    return dataclasses.replace(found, point=point.at[free].set(found.point))
