"""Rounds (attempts) that search from several starting points of a case as one batch.

Each search of each case is one lane of the batch.
"""

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import numpy_of
from planner_jax.core.protocol import index_of_best
from planner_jax.lanes import over_lanes
from planner_jax.optimise.multistart import (
    minimise_lanes,
    plan_at,
    put_lanes_first,
    put_lanes_last,
)
from planner_jax.optimise.settings import Curvature, Evaluation, Round, Stage

if TYPE_CHECKING:
    from planner_jax.optimise.planner import OptimisedPlanner


@struct.dataclass
class Searches:
    """The inputs of L searches that run together: case and starting point of each search."""

    cases: PyTree  # leaves (L, ...)
    index: Array  # (L,) int32, index of the starting point among the guesses; -1: `point`
    point: Array  # (L, n), starting points in n variables


def count_guesses(rounds: Sequence[Round], stage: Stage) -> int:
    """Return how many guessed starting points the compiled program of a search must compute.

    A round (attempt) is a sequence of stages (searches). Only its first stage starts at guesses.
    All rounds whose first stage has the planner settings of `stage` share the program, so the
    greatest number of guesses among these rounds is returned.
    """
    begun = [each for each in rounds if each.all_stages[0].settings == stage.settings]
    return max((each.first + each.starts for each in begun if each.is_divided), default=0)


def run_searches(
    planner: "OptimisedPlanner", stage: Stage, num: int, searches: Searches
) -> tuple[Array, PyTree]:
    """Run L searches, each from its own point or from one of the first `num` guesses; pure.

    Returns:
        The points (L, n) at which the L searches end, and the plans at these points.
    """
    problem = planner.with_settings(stage.settings)
    contexts = over_lanes(problem.prepare)(put_lanes_last(searches.cases))

    def start_of(context: PyTree, index: Array, point: Array) -> Array:
        if not num:
            return point
        guesses = problem.guesses(context, num)
        guess = jnp.sum(
            jnp.where(jnp.arange(num, dtype=index.dtype)[:, None] == index, guesses, 0.0), axis=0
        )
        return jnp.where(index < 0, point, guess) if point.size else guess

    starts = over_lanes(start_of)(contexts, searches.index, searches.point.T)
    held = problem.held

    def objective(point: Array, given: tuple[Array, PyTree]) -> Evaluation:
        start, context = given
        if held is not None:
            point = jnp.where(stage.frozen & held, start, point)
        return problem.objective(point, context)

    def curvature_at(point: Array, given: tuple[Array, PyTree]) -> Curvature:
        return problem.curvature_at(point, given[1])

    optimum = minimise_lanes(objective, starts, (starts, contexts), stage.solver, curvature_at)
    plans = over_lanes(functools.partial(plan_at, problem))(optimum, contexts)
    return optimum.point.T, put_lanes_first(plans)


def divide_round(
    search: Callable[[Stage, PyTree, PyTree, PyTree], tuple[PyTree, PyTree]],
    attempt: Round,
    cases: PyTree,
) -> PyTree:
    """Return each case's best plan over all starting points of an attempt (round), for a batch.

    An attempt has one or more stages, which search in turn from every starting point. `search` runs
    one stage of L searches and returns the end points (L, n) and the plans at these points. It
    takes the stage, cases with leaves (L, ...), indices (L,) of the starts among the guesses, and
    starting points (L, n), None in the first stage. The arrays may be NumPy's or JAX's.
    """
    xp = numpy_of(*jax.tree.leaves(cases))
    size, num = len(jax.tree.leaves(cases)[0]), attempt.starts
    owner = xp.repeat(xp.arange(size), num)  # (L,), the case of each search
    index = xp.tile(xp.arange(attempt.first, attempt.first + num, dtype=np.int32), size)
    points, spent, plans = None, 0, None
    for stage in attempt.all_stages:
        own = jax.tree.map(lambda leaf, owner=owner: leaf[owner], cases)
        points, plans = search(stage, own, index, points)
        plans = plans.replace(iterations=spent + plans.iterations)
        if stage.keep is not None and stage.keep < num:
            costs = xp.where(xp.isfinite(plans.cost), plans.cost, xp.inf).reshape(size, num)
            kept = xp.argsort(costs, axis=1)[:, : stage.keep] + num * xp.arange(size)[:, None]
            owner, points, plans = jax.tree.map(
                lambda leaf, kept=kept: leaf[kept.ravel()], (owner, points, plans)
            )
            num = stage.keep
        index, spent = xp.full(size * num, -1, np.int32), plans.iterations
    by_case = jax.tree.map(lambda leaf: leaf.reshape(size, num, *leaf.shape[1:]), plans)
    best = index_of_best(jax.tree.map(lambda leaf: xp.moveaxis(leaf, 1, 0), by_case))
    return jax.tree.map(lambda leaf: leaf[xp.arange(size), best], by_case)


def solve_divided(planner: "OptimisedPlanner", attempt: Round, cases: PyTree) -> PyTree:
    """Search from all starts of a round (attempt) as one batch; return each case's best plan."""

    def search(
        stage: Stage, cases: PyTree, index: Array, points: Array | None
    ) -> tuple[Array, PyTree]:
        num = attempt.first + attempt.starts if points is None else 0
        if points is None:
            points = jnp.zeros((len(index), 0))
        return run_searches(planner, stage, num, Searches(cases, index, points))

    return divide_round(search, attempt, cases)
