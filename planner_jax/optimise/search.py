"""One loop over all searches of a planner that minimises, for `pj.plan` and `pj.solve`.

A planner's rounds (attempts) consist of stages, each a search with its own settings. Here the
settings are rows of a table, over which a compiled program iterates. The program contains the
preparation of a case, the starting points, the final check and each search loop once, so that it
compiles much faster than one program for each stage.

A search of one case from one starting point is an item. The items that a row needs are gathered in
tiles of lanes, so that solved cases take no time.
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
from planner_jax.lanes.packing import Packing
from planner_jax.optimise import lbfgs
from planner_jax.optimise.multistart import (
    Optimum,
    minimise_lanes,
    optimum_at,
    plan_at,
    put_lanes_first,
    put_lanes_last,
    start_at,
)
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.rows import Model, Row, Table
from planner_jax.optimise.settings import Evaluation, LbfgsConfig

# Greatest number of lanes that run together; a tile lasts until its slowest lane ends.
_CPU_TILE, _GPU_TILE = 256, 8192
_BLOCK = 128  # the lanes of a tile on a GPU are a multiple of this number, as its kernels need


@struct.dataclass
class _Item:
    """The end of a search of one case from one starting point."""

    optimum: Optimum  # with the violation of the plan
    status: Array  # () int32


def solve_table(planner: OptimisedPlanner, table: Table, cases: PyTree, before: Score) -> PyTree:
    """Return the best plans of B cases over the rows of a table; pure.

    `before` has the numbers of the plans (B,) that earlier attempts found, of which a new plan must
    be better. Where none is, cost, violation and status are those of `before`, and all other arrays
    of the plan are zero.
    """
    finest = planner.with_settings(table.finest)
    rows = table.rows
    return _Program(planner, finest, table, rows)(cases, before)


@dataclasses.dataclass(frozen=True)
class _Program:
    """The loop over the rows of a table."""

    planner: OptimisedPlanner
    finest: OptimisedPlanner  # prepares cases, guesses and decodes for all models
    table: Table
    rows: Row  # leaves (R,)

    def __call__(self, cases: PyTree, before: Score) -> PyTree:
        num, starts = cases.batch_shape[0], self.table.starts
        lane = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), cases)
        item, plan = jax.eval_shape(self._plan_guess, lane)
        packings = of_cases, of_items, of_plans = tuple(map(Packing, (lane, item, plan)))
        packed = of_cases.pack(put_lanes_last(cases))
        is_usable = is_sound(cases) if has_rules(cases) else jnp.ones(num, bool)

        def take_row(state: tuple, row: Row) -> tuple[tuple, None]:
            found, due = state
            score = found[1]
            again = is_unsolved(score.status) & (score.violation <= row.within)
            again = (again | is_solved(score.status) & row.improves) & is_usable
            is_first = row.is_first & is_unsolved(score.status)  # false for the padding of a batch
            due = jnp.where(row.starts, again | is_first, due)
            run = functools.partial(self._run, row, packings, packed, due, starts)
            return (lax.cond(jnp.any(due), run, lambda x: x, found), due), None

        state = (of_plans.zeros(num), before, of_items.zeros(num * starts)), jnp.ones(num, bool)
        (found, _), _ = lax.scan(take_row, state, self.rows)
        plans = put_lanes_first(of_plans.unpack(found[0]))
        score = found[1]
        return plans.replace(cost=score.cost, violation=score.violation, status=score.status)

    def _plan_guess(self, case: PyTree) -> tuple[_Item, PyTree]:
        """Return the first guess of a case as a search of 0 iterations, and its plan.

        All other searches, and their plans, have arrays of the same shapes and types.
        """
        context = self.finest.prepare(case)
        optimum = start_at(self.finest.guesses(context, 1)[0])
        plan = plan_at(self.finest, optimum, context)
        return _Item(optimum, plan.status), plan

    def _run(
        self,
        row: Row,
        packings: tuple[Packing, ...],
        cases: list[Array],
        due: Array,
        starts: int,
        found: tuple,
    ) -> tuple:
        """Make the searches of a row for the cases that are due, in tiles."""
        of_cases, of_items, of_plans = packings
        num = due.size
        tile = _count_lanes(num, starts)
        is_due = (due[:, None] & (jnp.arange(starts, dtype=jnp.int32) < row.width)[None]).ravel()
        total = jnp.sum(is_due, dtype=jnp.int32)
        order = jnp.argsort(~is_due, stable=True).astype(jnp.int32)
        order = jnp.concatenate([order, jnp.broadcast_to(order[0], tile)])

        def run_tile(state: tuple) -> tuple:
            done, (best, score, items) = state
            index = lax.dynamic_slice_in_dim(order, done, tile)
            is_own = done + jnp.arange(tile, dtype=jnp.int32) < total
            index = jnp.where(is_own, index, order[0])  # lanes without an item repeat the first
            owner = lax.div(index, jnp.int32(starts))
            start = index - starts * owner
            before = of_items.unpack(_take(items, index))
            own = of_cases.unpack(_take(cases, owner))
            item, plan = self._search(row, own, row.first + start, before)
            is_new = is_own & row.writes
            is_new &= row.is_first | is_better(plan, _take(score, owner))
            target = jnp.where(is_new, owner, num)
            later = Score(plan.cost, plan.violation, plan.status)
            best = _put(best, target, of_plans.pack(plan))
            score = _put(score, target, later)
            items = _put(items, jnp.where(is_own, index, num * starts), of_items.pack(item))
            return done + tile, (best, score, items)

        state = lax.while_loop(lambda s: s[0] < total, run_tile, (jnp.zeros_like(total), found))
        best, score, items = state[1]
        if starts > 1:
            sort = lambda items: _take(items, _order_starts(row, of_items.unpack(items), num))  # noqa: E731
            items = lax.cond(row.keep < row.width, sort, lambda items: items, items)
        return best, score, items

    def _search(self, row: Row, cases: PyTree, index: Array, before: _Item) -> tuple[_Item, PyTree]:
        """Search from guesses, or from where earlier searches ended; the lanes are last."""
        most = self.table.guesses
        contexts = over_lanes(self.finest.prepare)(cases)
        inputs = over_lanes(self.finest.network_inputs)(contexts)

        def guess(context: PyTree, index: Array) -> Array:
            points = self.finest.guesses(context, most)
            is_own = jnp.arange(most, dtype=index.dtype)[:, None] == index
            return jnp.sum(jnp.where(is_own, points, 0.0), axis=0)

        stay = lambda *_: before.optimum.point  # noqa: E731
        points = lax.cond(row.starts, over_lanes(guess), stay, contexts, index)
        models = self.table.models
        loops = [functools.partial(_minimise, self.planner, model, row) for model in models]
        given = points, inputs, contexts, index
        found = loops[0](*given) if len(loops) == 1 else lax.switch(row.model, loops, *given)
        old = before.optimum
        spent = jnp.where(row.starts, 0, old.iterations)
        found = dataclasses.replace(found, iterations=spent + found.iterations)
        found = jax.tree.map(lambda new, old: jnp.where(row.is_last, old, new), found, old)
        plan = over_lanes(functools.partial(plan_at, self.finest))(found, contexts)
        found = found.replace(evaluation=found.evaluation.replace(violation=plan.violation))
        return _Item(found, plan.status), plan


def _count_lanes(num: int, starts: int) -> int:
    """Return how many lanes run together if each of `num` cases has up to `starts` searches."""
    if _is_on_gpu():
        most = max(num, min(num * starts, _GPU_TILE))
        return -(-most // _BLOCK) * _BLOCK
    return min(num, _CPU_TILE)


def _is_on_gpu() -> bool:
    platform = traced_platform()
    return kernels.has_gpu() if platform is None else platform != "cpu"


def _minimise(
    own: OptimisedPlanner,
    model: Model,
    row: Row,
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
    starts = lax.cond(row.starts, over_lanes(select), keep, starts, inputs, contexts, index)
    held = None if planner.held is None else row.frozen & planner.held

    def objective(point: Array, given: tuple[Array, PyTree]) -> Evaluation:
        start, context = given
        if held is not None:
            point = jnp.where(held, start, point)
        return planner.objective(point, context)

    given = starts, contexts
    if isinstance(solver, LbfgsConfig) and solver.max_steps > 0:
        config = jax.tree.unflatten(jax.tree.structure(solver), row.solver)
        found = _minimise_lanes(objective, starts, given, config, solver.max_steps)
    elif isinstance(solver, LbfgsConfig):
        stay = lambda x, given: optimum_at(x, objective(x, given), solver)  # noqa: E731
        found = over_lanes(stay)(starts, given)
    else:
        curved = lambda x, given: planner.curvature_at(x, given[1])  # noqa: E731
        found = minimise_lanes(objective, starts, given, solver, curved)
    if free is None:
        return found
    point = jnp.zeros((size, *found.point.shape[1:]), found.point.dtype)
    return dataclasses.replace(found, point=point.at[free].set(found.point))


def _minimise_lanes(
    objective: Callable[[Array, PyTree], Evaluation],
    starts: Array,
    contexts: PyTree,
    config: LbfgsConfig,
    turns: int,
) -> Optimum:
    """Minimise L problems by L-BFGS, whose numbers in `config` are known only at run time.

    On a GPU `turns` iterations follow each other before it is tested whether all lanes are done.
    """
    is_gpu = _is_on_gpu()
    step = functools.partial(_step_lanes, objective)
    if is_gpu:
        advance = over_lanes(lambda s, given: lbfgs.step(lambda x: objective(x, given), s, config))
        step = lambda s, given, _: lax.fori_loop(0, turns, lambda _, s: advance(s, given), s)  # noqa: E731
    state = lax.while_loop(
        lambda state: jnp.any(lbfgs.is_unfinished(state.numbers, config)),
        lambda state: step(state, contexts, config),
        over_lanes(lambda start: lbfgs.init(start, config))(starts),
    )
    numbers = state.numbers
    stationary = lbfgs.is_stationary(numbers, config)
    return Optimum(state.best_point, numbers.best, numbers.iteration, stationary)


def _step_lanes(
    objective: Callable[[Array, PyTree], Evaluation],
    state: lbfgs.LbfgsState,
    contexts: PyTree,
    config: LbfgsConfig,
) -> lbfgs.LbfgsState:
    """Return the states of L problems after one iteration; the last axes count the problems.

    `objective` takes a point (n,) and the context of one problem. The result is equal to
    `lbfgs.step` up to rounding, but the two-loop recursion is a loop, for CPUs.
    """

    def try_steps(state: lbfgs.LbfgsState, context: PyTree, *found: PyTree) -> lbfgs.LbfgsState:
        return lbfgs.try_steps(lambda x: objective(x, context), config, state, *found)

    evaluate = lambda x, context: lbfgs.evaluate(lambda x: objective(x, context), x)  # noqa: E731
    here, grad = over_lanes(evaluate)(state.point, contexts)
    memory = over_lanes(lbfgs.remember)(state.memory, state.step, grad - state.grad)
    direction = lbfgs.recur_twice(memory, grad, config.step_cap, lax.scan, over_lanes)
    return over_lanes(try_steps)(state, contexts, here, grad, memory, direction)


def _order_starts(row: Row, items: _Item, num: int) -> Array:
    """Return the indices of all items with the starting points of each case ordered, best first."""
    cost, violation, status = (
        leaf.reshape(num, -1)
        for leaf in (
            items.optimum.evaluation.cost,
            items.optimum.evaluation.violation,
            items.status,
        )
    )
    places = jnp.arange(cost.shape[1], dtype=jnp.int32)
    is_own = places[None] < row.width
    is_good, is_finite = is_solved(status) & is_own, jnp.isfinite(cost) & is_own
    has_good = jnp.any(is_good, axis=1, keepdims=True)
    least = jnp.where(is_finite & jnp.isfinite(violation), violation, jnp.inf)
    last = jnp.where(has_good, jnp.where(is_good, cost, jnp.inf), least)
    rank = jnp.where(row.ends, last, jnp.where(is_finite, cost, jnp.inf))
    order = jnp.argsort(rank, axis=1)
    return (jnp.arange(0, num * len(places), len(places))[:, None] + order).ravel()


def _take(tree: PyTree, index: Array) -> PyTree:
    get = lambda x: x.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)  # noqa: E731
    return jax.tree.map(get, tree)


def _put(tree: PyTree, index: Array, new: PyTree) -> PyTree:
    """Return arrays with new entries; entries at indices past the end are left out."""
    put = lambda x, y: x.at[index].set(y, mode="drop", wrap_negative_indices=False)  # noqa: E731
    return jax.tree.map(put, tree, new)
