"""One loop over several rows of a table of searches, with tiles of lanes that run together.

The program contains the preparation of a case, the starting points, the final check and each search
loop once, so that it compiles much faster than one program for each row. A search of one case from
one starting point is an item. The items that a row needs are gathered in tiles, so that solved
cases take no time.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.protocol import Score, is_better, is_solved
from planner_jax.core.rules import is_sound
from planner_jax.lanes.kernels import is_on_gpu
from planner_jax.lanes.packing import Packing
from planner_jax.optimise import lbfgs
from planner_jax.optimise.multistart import (
    Optimum,
    plan_at,
    put_lanes_first,
    put_lanes_last,
    start_at,
)
from planner_jax.optimise.rows import Row, Table
from planner_jax.optimise.search import Item, Search, find_due, over
from planner_jax.optimise.settings import Evaluation, LbfgsConfig

# Greatest number of lanes that run together; a tile lasts until its slowest lane ends.
_CPU_TILE, _GPU_TILE = 256, 8192
_BLOCK = 128  # the lanes of a tile on a GPU are a multiple of this number, as its kernels need


def solve_in_tiles(search: Search, cases: PyTree, before: Score) -> PyTree:
    """Return the best plans of B cases over all rows of a table; see `search.solve_table`."""
    num, starts = cases.batch_shape[0], search.table.starts
    lane = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), cases)
    item, plan = jax.eval_shape(functools.partial(_plan_guess, search), lane)
    packings = of_cases, of_items, of_plans = tuple(map(Packing, (lane, item, plan)))
    packed = of_cases.pack(put_lanes_last(cases))
    is_usable = is_sound(cases)

    def take_row(state: tuple, row: Row) -> tuple[tuple, None]:
        found, due = state
        due = jnp.where(row.starts, find_due(row, found[1], is_usable), due)
        run = functools.partial(_run, search, row, packings, packed, due, starts)
        return (lax.cond(jnp.any(due), run, lambda x: x, found), due), None

    state = (of_plans.zeros(num), before, of_items.zeros(num * starts)), jnp.ones(num, bool)
    (found, _), _ = lax.scan(take_row, state, search.table.rows)
    plans = put_lanes_first(of_plans.unpack(found[0]))
    score = found[1]
    return plans.replace(cost=score.cost, violation=score.violation, status=score.status)


def _plan_guess(search: Search, case: PyTree) -> tuple[Item, PyTree]:
    """Return the first guess of a case as a search of 0 iterations, and its plan.

    All other searches, and their plans, have arrays of the same shapes and types.
    """
    context = search.finest.prepare(case)
    optimum = start_at(search.finest.guesses(context, 1)[0])
    plan = plan_at(search.finest, optimum, context)
    return Item(optimum, plan.status), plan


def _run(
    search: Search,
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
        item, plan = search.run(row, own, row.first + start, before)
        is_new = is_own & row.writes
        is_new &= row.is_first | is_better(plan, _take(score, owner))
        target = jnp.where(is_new, owner, num)
        best = _put(best, target, of_plans.pack(plan))
        score = _put(score, target, Score.of(plan))
        items = _put(items, jnp.where(is_own, index, num * starts), of_items.pack(item))
        return done + tile, (best, score, items)

    state = lax.while_loop(lambda s: s[0] < total, run_tile, (jnp.zeros_like(total), found))
    best, score, items = state[1]
    if starts > 1:
        sort = lambda items: _take(items, _order_starts(row, of_items.unpack(items), num))  # noqa: E731
        items = lax.cond(row.keep < row.width, sort, lambda items: items, items)
    return best, score, items


def _count_lanes(num: int, starts: int) -> int:
    """Return how many lanes run together if each of `num` cases has up to `starts` searches."""
    if is_on_gpu():
        most = max(num, min(num * starts, _GPU_TILE))
        return -(-most // _BLOCK) * _BLOCK
    return min(num, _CPU_TILE)


def _order_starts(row: Row, items: Item, num: int) -> Array:
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


def minimise_tile(
    objective: Callable[[Array, PyTree], Evaluation],
    starts: Array,
    contexts: PyTree,
    config: LbfgsConfig,
    turns: int,
    table: Table,
) -> Optimum:
    """Minimise L problems by L-BFGS, whose numbers in `config` are known only at run time.

    On a GPU `turns` iterations follow each other before it is tested whether all lanes are done. A
    plain table has the two-loop recursion without loops, which is faster.
    """
    advance = over(lambda s, given: lbfgs.step(lambda x: objective(x, given), s, config))
    step = functools.partial(_step_lanes, objective)
    if table.is_plain:
        step = lambda s, given, _: advance(s, given)  # noqa: E731
    if is_on_gpu():
        step = lambda s, given, _: lax.fori_loop(0, turns, lambda _, s: advance(s, given), s)  # noqa: E731
    state = over(lambda start: lbfgs.init(start, config))(starts)
    if table.is_counted and is_on_gpu():
        state = step(state, contexts, config)
    else:
        state = lax.while_loop(
            lambda state: jnp.any(lbfgs.is_unfinished(state.numbers, config)),
            lambda state: step(state, contexts, config),
            state,
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
    here, grad = over(evaluate)(state.point, contexts)
    memory = over(lbfgs.remember)(state.memory, state.step, grad - state.grad)
    direction = lbfgs.recur_twice(memory, grad, config.step_cap, lax.scan, over)
    return over(try_steps)(state, contexts, here, grad, memory, direction)
