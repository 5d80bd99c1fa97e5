"""The searches of planners that minimise, for `pj.plan` and `pj.solve`.

A planner's attempts consist of stages, each a search whose settings are one row of a
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

from planner_jax.core.protocol import Score, is_better, is_solved, is_unsolved
from planner_jax.core.rules import is_sound
from planner_jax.lanes import over_lanes
from planner_jax.optimise.multistart import (
    Optimum,
    minimise,
    optimum_at,
    plan_at,
    put_lanes_first,
    put_lanes_last,
)
from planner_jax.optimise.planner import Problem
from planner_jax.optimise.rows import Model, Row, Table
from planner_jax.optimise.settings import Evaluation, LbfgsConfig


@struct.dataclass
class Item:
    """The end of a search of one case from one starting point."""

    optimum: Optimum  # with the violation of the plan
    status: Array  # () int32


def solve_table(problem: Problem, table: Table, cases: PyTree, before: Score) -> PyTree:
    """Return the best plans of B cases over the rows of a table; pure.

    `before` has the numbers (B,) of the plans that earlier attempts found. Where no new plan is
    better, the result has these numbers, and its other arrays are not meaningful.
    """
    search = Search(problem, problem.with_settings(table.finest), table)
    if table.is_plain:
        return search.once(cases, before)
    from planner_jax.optimise.tiles import solve_in_tiles  # first attempts do not need it

    return solve_in_tiles(search, cases, before)


@dataclasses.dataclass(frozen=True)
class Search:
    """The searches of a table's rows, each from one starting point of each lane."""

    problem: Problem
    finest: Problem  # prepares cases, guesses and decodes for all models
    table: Table

    def once(self, cases: PyTree, before: Score) -> PyTree:
        """Search once for each case, by a table of one row, without tiles."""
        row = jax.tree.map(lambda column: column[0], self.table.rows)
        lanes = put_lanes_last(cases)
        index = jnp.broadcast_to(row.first, cases.batch_shape)
        _, plan = self.run(row, lanes, index, None)
        plans = put_lanes_first(plan)
        is_new = find_due(row, before, is_sound(cases)) & (row.is_first | is_better(plans, before))
        choose = lambda new, old: jnp.where(is_new, new, old)  # noqa: E731
        return plans.replace(**vars(jax.tree.map(choose, Score.of(plans), before)))

    def run(
        self, row: Row, cases: PyTree, index: Array, before: Item | None
    ) -> tuple[Item, PyTree]:
        """Search from guesses, or from where earlier searches ended; the lanes are last.

        With `before` as None, the row is the first one of an attempt.
        """
        most = self.table.guesses
        contexts = over(self.finest.prepare)(cases)
        inputs = over(self.finest.network_inputs)(contexts)

        def guess(context: PyTree, index: Array) -> Array:
            points = self.finest.guesses(context, most)
            is_own = jnp.arange(most, dtype=index.dtype)[:, None] == index
            return jnp.sum(jnp.where(is_own, points, 0.0), axis=0)

        old = None if before is None else before.optimum
        points = self._if_starts(row, over(guess), old and old.point, contexts, index)
        run = functools.partial(self._minimise, row)
        loops = [functools.partial(run, model) for model in self.table.models]
        given = points, inputs, contexts, index
        found = loops[0](*given) if len(loops) == 1 else lax.switch(row.model, loops, *given)
        if old is not None:
            spent = jnp.where(row.starts, 0, old.iterations)
            found = dataclasses.replace(found, iterations=spent + found.iterations)
            found = jax.tree.map(lambda new, old: jnp.where(row.is_last, old, new), found, old)
        plan = over(functools.partial(plan_at, self.finest))(found, contexts)
        evaluation = found.evaluation._replace(violation=plan.violation)
        found = dataclasses.replace(found, evaluation=evaluation)
        return Item(found, plan.status), plan

    def _if_starts(self, row: Row, function: Callable, otherwise: PyTree, *args: PyTree) -> PyTree:
        """Return a function's result if a row is the first one of an attempt, else an array."""
        if self.table.is_plain:
            return function(*args)
        return lax.cond(row.starts, function, lambda *_: otherwise, *args)

    def _minimise(
        self,
        row: Row,
        model: Model,
        starts: Array,
        inputs: Array,
        contexts: PyTree,
        index: Array,
    ) -> Optimum:
        """Minimise from points (n, lanes) of the finest model."""
        problem = self.problem.with_settings(model.settings).with_weights(row.weights)
        solver = model.solver
        size, free = len(starts), None if model.free is None else jnp.array(model.free)
        if free is not None:
            starts = starts[free]

        def select(start: Array, inputs: Array, context: PyTree, index: Array) -> Array:
            return jnp.where(index == 0, problem.first_start(start, inputs, context), start)

        starts = self._if_starts(row, over(select), starts, starts, inputs, contexts, index)
        held = None if problem.held is None else row.frozen & problem.held

        def objective(point: Array, given: tuple[Array, PyTree]) -> Evaluation:
            start, context = given
            if held is not None:
                point = jnp.where(held, start, point)
            return Evaluation(*problem.objective(point, context))

        given = starts, contexts
        if isinstance(solver, LbfgsConfig) and solver.max_steps > 0:
            config = jax.tree.unflatten(jax.tree.structure(solver), row.solver)
            if self.table.is_plain and starts.shape[-1] == 1:
                alone = lambda x, given: minimise(lambda x: objective(x, given), x, config)  # noqa: E731
                found = over(alone)(starts, given)
            else:
                from planner_jax.optimise.tiles import minimise_tile  # single cases do not need it

                found = minimise_tile(
                    objective, starts, given, config, solver.max_steps, self.table
                )
        elif isinstance(solver, LbfgsConfig):
            stay = lambda x, given: optimum_at(x, objective(x, given), solver)  # noqa: E731
            found = over(stay)(starts, given)
        else:
            from planner_jax.optimise.newton_lanes import minimise_lanes  # few searches need it

            curved = lambda x, given: problem.curvature_at(x, given[1])  # noqa: E731
            found = minimise_lanes(objective, starts, given, solver, curved)
        if free is None:
            return found
        point = jnp.zeros((size, *found.point.shape[1:]), found.point.dtype)
        return dataclasses.replace(found, point=point.at[free].set(found.point))


def over(function: Callable) -> Callable:
    """Map a function of one lane over the lanes, by `over_lanes` if there are several."""

    def call(*args: PyTree) -> PyTree:
        if jax.tree.leaves(args)[0].shape[-1] > 1:
            return over_lanes(function)(*args)
        alone = function(*jax.tree.map(lambda leaf: leaf[..., 0], args))
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[..., None], alone)

    return call


def find_due(row: Row, score: Score, is_usable: Array) -> Array:
    """Return which cases need the attempt of a row, (B,) bool; padding of a batch needs none."""
    again = is_unsolved(score.status) & (score.violation <= row.within)
    again = (again | is_solved(score.status) & row.improves) & is_usable
    return again | row.is_first & is_unsolved(score.status)
