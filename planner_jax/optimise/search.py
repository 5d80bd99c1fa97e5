"""One loop over all searches of a planner of segments, for `pj.solve`.

A planner's rounds (attempts) consist of stages, each a search with its own settings. Here the
settings are rows of a table, over which a compiled program iterates. The program contains the
preparation of a case, the starting points, the final check and each L-BFGS loop once, so that it
compiles much faster than one program for each stage.

A search of one case from one starting point is an item. The items that a row needs are gathered in
tiles of lanes, so that solved cases take no time.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.planner import Solve
from planner_jax.core.protocol import Status, is_better, is_solved, is_unsolved, mark_bad_input
from planner_jax.core.rules import has_rules, is_sound
from planner_jax.lanes import kernels, over_lanes
from planner_jax.lanes.packing import Packing
from planner_jax.optimise import lbfgs
from planner_jax.optimise.chain import ChainPlanner
from planner_jax.optimise.multistart import (
    Optimum,
    plan_at,
    put_lanes_first,
    put_lanes_last,
    start_at,
)
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.rows import Model, Row, list_models, list_rows
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, Round

_TILE = 256  # greatest number of lanes that run together; a tile lasts until its slowest lane ends


@struct.dataclass
class _Item:
    """The end of a search of one case from one starting point."""

    optimum: Optimum  # with the violation of the plan
    status: Array  # () int32


@struct.dataclass
class _Score:
    """The numbers of a case's best plan by which it is compared with later plans."""

    cost: Array
    violation: Array
    status: Array


def make_solve(planner: ChainPlanner, attempts: Sequence[Round], cases: PyTree) -> Solve | None:
    """Return a function that makes all attempts (rounds) of a planner in one loop.

    It takes the plans of earlier attempts, or None without such attempts. The result is None if the
    attempts do not fit a table, see `list_models`; if one of them also searches solved cases; and
    on GPUs, where CUDA kernels need constant settings.
    """
    inherited = ((ChainPlanner, "guesses"), (OptimisedPlanner, "load_attempt"))
    inherited += ((OptimisedPlanner, "solve"), (OptimisedPlanner, "solve_lanes"))
    is_usual = all(getattr(type(planner), name) is getattr(base, name) for base, name in inherited)
    if not is_usual or kernels.in_use() or any(each.improves for each in attempts):
        return None
    cases = jax.tree.map(jnp.asarray, cases)
    attempts = [planner.fit_attempt(each, cases) for each in attempts]
    models = list_models(planner, attempts, cases)
    if models is None:
        return None
    finest = max(models.values(), key=lambda each: len(each.planner.scale)).planner
    rows = list_rows(planner, attempts, models)
    return functools.partial(_Program(finest, tuple(dict.fromkeys(models.values())), rows), cases)


@dataclasses.dataclass(frozen=True)
class _Program:
    """The loop over the rows of a table."""

    finest: ChainPlanner  # prepares cases, guesses and decodes for all models
    models: tuple[Model, ...]
    rows: list[Row]

    def __call__(self, cases: PyTree, plans: PyTree) -> PyTree:
        """Return the best plans of cases over all rows, and over earlier `plans` if not None."""
        if cases.batch_shape == ():
            cases, plans = jax.tree.map(lambda leaf: leaf[None], (cases, plans))
            return jax.tree.map(lambda leaf: leaf[0], self(cases, plans))
        num, starts = cases.batch_shape[0], max(int(row.width) for row in self.rows)
        lane = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), cases)
        item, plan = jax.eval_shape(self._plan_guess, lane)
        packings = of_cases, of_items, of_plans = tuple(map(Packing, (lane, item, plan)))
        dtype = plan.cost.dtype
        rows = self.rows
        if plans is None:
            best, zeros = of_plans.zeros(num), jnp.zeros(num, dtype)
            unsolved = jnp.full(num, Status.INFEASIBLE, jnp.int32)
            score = _Score(zeros, jnp.full(num, jnp.inf, dtype), unsolved)
        else:
            rows = [dataclasses.replace(row, is_first=False) for row in rows]
            best = of_plans.pack(put_lanes_last(plans))
            score = _Score(plans.cost, plans.violation, plans.status)
        packed = of_cases.pack(put_lanes_last(cases))
        is_usable = is_sound(cases) if has_rules(cases) else jnp.ones(num, bool)
        table = jax.tree.map(lambda *column: _make_column(column, dtype), *rows)

        def take_row(state: tuple, row: Row) -> tuple[tuple, None]:
            found, due = state
            score = found[1]
            again = is_unsolved(score.status) & (score.violation <= row.within) & is_usable
            due = jnp.where(row.starts, again | row.is_first, due)
            run = functools.partial(self._run, row, packings, packed, due, starts)
            return (lax.cond(jnp.any(due), run, lambda x: x, found), due), None

        state = (best, score, of_items.zeros(num * starts)), jnp.ones(num, bool)
        (found, _), _ = lax.scan(take_row, state, table)
        plans = put_lanes_first(of_plans.unpack(found[0]))
        return mark_bad_input(plans, cases)

    def _plan_guess(self, case: PyTree) -> tuple[_Item, PyTree]:
        """Return the first guess of a case as a search of 0 iterations, and its plan.

        All other searches, and their plans, have arrays of the same shapes and types.
        """
        context = self.finest.prepare(case)
        optimum = start_at(self.finest.plain_guesses(context, 1)[0])
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
        tile = min(num, _TILE)
        is_due = (due[:, None] & (jnp.arange(starts) < row.width)[None]).ravel()
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
            later = _Score(plan.cost, plan.violation, plan.status)
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
        most = max(int(each.first) + int(each.width) for each in self.rows if each.starts)
        contexts = over_lanes(self.finest.prepare)(cases)
        inputs = over_lanes(self.finest.network_inputs)(contexts)

        def guess(context: PyTree, index: Array) -> Array:
            points = self.finest.plain_guesses(context, most)
            is_own = jnp.arange(most, dtype=index.dtype)[:, None] == index
            return jnp.sum(jnp.where(is_own, points, 0.0), axis=0)

        stay = lambda *_: before.optimum.point  # noqa: E731
        points = lax.cond(row.starts, over_lanes(guess), stay, contexts, index)
        loops = [functools.partial(_minimise, model, row) for model in self.models]
        given = points, inputs, contexts, index
        found = loops[0](*given) if len(loops) == 1 else lax.switch(row.model, loops, *given)
        old = before.optimum
        is_kept = row.solver[0] == 0
        found = jax.tree.map(lambda new, old: jnp.where(is_kept, old, new), found, old)
        spent = jnp.where(row.starts, 0, old.iterations)
        found = found.replace(iterations=jnp.where(is_kept, spent, spent + found.iterations))
        plan = over_lanes(functools.partial(plan_at, self.finest))(found, contexts)
        found = found.replace(evaluation=found.evaluation.replace(violation=plan.violation))
        return _Item(found, plan.status), plan


def _minimise(
    model: Model, row: Row, starts: Array, inputs: Array, contexts: PyTree, index: Array
) -> Optimum:
    """Minimise by L-BFGS from points (n, lanes) of the finest model."""
    planner = model.planner.with_weights({name: row.weights[name] for name in model.varying})
    config = jax.tree.unflatten(jax.tree.structure(model.solver), row.solver)
    size, free = len(starts), model.free
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

    state = lax.while_loop(
        lambda state: jnp.any(lbfgs.is_unfinished(state.numbers, config)),
        lambda state: _step_lanes(objective, state, (starts, contexts), config),
        over_lanes(lambda start: lbfgs.init(start, config))(starts),
    )
    point, numbers = state.best_point, state.numbers
    if free is not None:
        point = jnp.zeros((size, *point.shape[1:]), point.dtype).at[free].set(point)
    is_stationary = lbfgs.is_stationary(numbers, config)
    return Optimum(point, numbers.best, numbers.iteration, is_stationary)


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


def _make_column(values: Sequence[float], dtype: np.dtype) -> np.ndarray:
    column = np.array(values)
    kinds = {"b": np.dtype(bool), "i": np.dtype(np.int32), "f": dtype}
    return column.astype(kinds[column.dtype.kind])
