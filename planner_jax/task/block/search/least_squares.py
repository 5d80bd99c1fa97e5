"""The searches by least squares: for one case start by start, for a batch on a GPU together."""

import dataclasses
import functools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.protocol import is_solved, select
from planner_jax.optimise import levenberg
from planner_jax.optimise.levenberg import LevenbergConfig, LevenbergState, continue_search
from planner_jax.robot import arm_motion
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan, make_empty_plan
from planner_jax.task.block.problem.end_poses import EndPoses, end_poses
from planner_jax.task.block.problem.flight import Flight, flight_of
from planner_jax.task.block.search.attempts import (
    Search,
    count_starts,
    read_learned_starts,
    settle_by,
)
from planner_jax.task.block.search.straight import EVERY, order_straight

if TYPE_CHECKING:
    from planner_jax.task.block.default_planner import OnlineBlock

# On a GPU, steps of least squares before searches that have ended make room for others, and the
# least number of searches that take steps together; fewer would take as long.
_TURN, _LANES = 5, 1024


def refine_in_turn(
    planner: "OnlineBlock", case: BlockCase, attempt: Search
) -> tuple[BlockPlan, EndPoses]:
    """Return the plan of one case by straight motions, then least squares, and the end poses.

    With `attempt.in_turn`, starting points are refined one after another. Otherwise all take a few
    trial steps, and the `attempt.kept` points of least cost are refined. The search ends at the
    first solved plan, unless `settling` requires a comparison.
    """
    flight, poses, order = rank_end_poses(planner, case)
    goals, goal_order, straight = order_straight(planner, case, poses, EVERY, attempt)
    model = lambda point: planner.model(point, case, flight)  # noqa: E731
    solver, tries = attempt.solver, jnp.where(flight.comes, attempt.tries, 0)
    kept = jnp.where(attempt.in_turn, 0, jnp.minimum(attempt.kept, tries))

    def take_turn(turn: tuple[Array, LevenbergState, Array, BlockPlan]) -> tuple:
        k, searches, costs, best = turn
        is_straight, index = k < straight, jnp.maximum(k - straight, 0)
        is_trial = ~is_straight & jnp.logical_not(attempt.in_turn) & (index < tries)
        is_detour = index >= tries + kept
        is_new = is_straight | is_trial | attempt.in_turn | is_detour
        index = jnp.where(is_new, index, jnp.argmin(costs))
        start = _encode_start(planner, case, poses, order, attempt.first + index)
        bump = 0.5 * _encode_bump(planner, case, index - tries - kept)
        start = jnp.where(is_detour, encode(best) + bump, start)
        straight_start = planner.encode_straight(case, goals, goal_order[k])
        begin = levenberg.start_search(jnp.where(is_straight, straight_start, start), solver)
        pick = lambda new, old: jnp.where(is_new, new, old[index])  # noqa: E731
        search = jax.tree.map(pick, begin, searches)
        most = jnp.where(is_straight, -1, jnp.where(is_trial, solver.trial, solver.max_steps))
        search = continue_search(model, search, solver, most)
        searches = jax.tree.map(lambda old, new: old.at[index].set(new), searches, search)
        costs = costs.at[index].set(jnp.where(is_trial, _trial_cost(search, solver), jnp.inf))
        finish = lambda s: planner.finish(case, flight, s.point, jnp.maximum(s.steps, 0))  # noqa: E731
        plan = lax.cond(is_trial, lambda _: best, finish, search)
        return k + 1, searches, costs, select(plan, best)

    def is_open(turn: tuple[Array, LevenbergState, Array, BlockPlan]) -> Array:
        k, best = turn[0], turn[-1]
        most = straight + tries + kept + jnp.where(flight.comes, attempt.detours, 0)
        return (k < most) & (bool(planner.settling) | ~is_solved(best.status))

    num, dtype = len(_starts(planner, case)[0]), case.angles.dtype
    size = case.arm.num * planner.pieces + 1
    empty = levenberg.start_search(jnp.zeros(size, dtype), solver)
    searches = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)), empty)
    costs, best = jnp.full(num, jnp.inf, dtype), make_empty_plan(case, planner.pieces)
    turn = (jnp.zeros((), jnp.int32), searches, costs, best)
    plan = settle_plan(planner, case, flight, lax.while_loop(is_open, take_turn, turn)[-1])
    return plan, poses


def refine_at_once(
    planner: "OnlineBlock",
    cases: BlockCase,
    flights: Flight,
    poses: EndPoses,
    orders: Array,
    best: BlockPlan,
    attempt: Search,
) -> BlockPlan:
    """Return the plans of a batch by least squares.

    Every unsolved case has a search from each starting point. The searches of all cases first take
    their trial steps. Then the `attempt.kept` best ones of each case continue. In every turn as
    many searches as there are lanes take a few steps together.
    """
    solver, kept = attempt.solver, max(search.kept for search in planner.searches)
    num, dtype = orders.shape[0], cases.angles.dtype
    starts = max(search.tries for search in planner.searches)
    size = num * starts
    lanes = min(size, max(num, _LANES))
    is_left = (~is_solved(best.status)) | bool(planner.settling)
    is_tried = is_left[:, None] & (jnp.arange(starts) < attempt.tries)

    def rank(searches: LevenbergState) -> tuple[Array, Array]:
        """Return the order of each case's searches, and which of them are kept, (B, starts)."""
        costs = _trial_cost(searches, solver).reshape(num, starts)
        order = jnp.argsort(jnp.where(is_tried, costs, jnp.inf), axis=1)
        place = jnp.argsort(order, axis=1)
        return order, is_tried & (place < attempt.kept) & jnp.isfinite(costs)

    def find_open(searches: LevenbergState) -> tuple[Array, Array]:
        """Return which searches take the next steps, (B * starts,), and whether it is a trial."""
        each = jax.vmap(lambda search: levenberg.is_open(search, solver, solver.max_steps))
        is_new = is_tried.reshape(-1) & (searches.steps < 0)
        is_trial = jnp.any(is_new)
        is_open = rank(searches)[1].reshape(-1) & each(searches)
        return jnp.where(is_trial, is_new, is_open), is_trial

    def take_turn(state: tuple[LevenbergState, Array, Array]) -> tuple:
        searches, is_open, is_trial = state
        at = jnp.nonzero(is_open, size=lanes, fill_value=size)[0]
        own, k = jnp.minimum(at // starts, num - 1), at % starts
        case, flight, goals, order = jax.tree.map(
            lambda leaf: leaf[own], (cases, flights, poses, orders)
        )
        some = jax.tree.map(lambda leaf: leaf.at[at].get(mode="clip"), searches)
        encode_start = functools.partial(_encode_start, planner)
        begun = jax.vmap(encode_start)(case, goals, order, attempt.first + k)
        some = dataclasses.replace(some, point=jnp.where(is_trial, begun, some.point))
        later = jnp.minimum(some.steps + _TURN, solver.max_steps)
        most = jnp.where(at < size, jnp.where(is_trial, solver.trial, later), -1)

        def advance(search: LevenbergState, most: Array, *given: PyTree) -> LevenbergState:
            return continue_search(lambda x: planner.model(x, *given), search, solver, most)

        some = jax.vmap(advance)(some, most, case, flight)
        searches = jax.tree.map(lambda a, b: a.at[at].set(b, mode="drop"), searches, some)
        return searches, *find_open(searches)

    empty = levenberg.start_search(jnp.zeros(cases.arm.num * planner.pieces + 1, dtype), solver)
    searches = jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), empty)
    state = searches, *find_open(searches)
    ends, *_ = lax.while_loop(lambda state: jnp.any(state[1]), take_turn, state)
    order, is_kept = rank(ends)

    def finish(k: Array, best: BlockPlan) -> BlockPlan:
        at = starts * jnp.arange(num) + order[:, k]
        plans = jax.vmap(planner.finish)(cases, flights, ends.point[at], ends.steps[at])
        return select(plans, best, is_kept.reshape(-1)[at] & is_left)

    return lax.fori_loop(0, jnp.minimum(attempt.kept, kept), finish, best)


def settle_plan(
    planner: "OnlineBlock", case: BlockCase, flight: Flight, plan: BlockPlan
) -> BlockPlan:
    """Return the plan, or a plan of less cost that least squares find from it."""
    if planner.brisk or not planner.settling:
        return plan
    solver = dataclasses.replace(Search.solver, **settle_by(planner.settling), hope=None)

    def settle() -> BlockPlan:
        return select(planner.refine(case, flight, encode(plan), solver), plan)

    return lax.cond(is_solved(plan.status), settle, lambda: plan)


def rank_poses(poses: EndPoses, num: int, most: float) -> Array:
    """Return the indices (num,) of the end poses that need the least effort, in rising order.

    In an end pose the shield meets the ball. The effort is the greatest ratio of a joint's rate or
    acceleration to its limit. Random numbers from 0 to 1 are added to efforts, so that the first
    poses differ more. A pose whose effort exceeds `most` cannot be reached before the ball, and
    is ranked far behind.
    """
    rng = np.random.default_rng(0)
    noise = jnp.asarray(rng.random(poses.effort.shape[0]), poses.effort.dtype)
    late = jnp.where(poses.effort > most, 10.0 * poses.effort, 0.0)
    return lax.top_k(-(poses.effort + noise + late), num)[1]


def rank_end_poses(planner: "OnlineBlock", case: BlockCase) -> tuple[Flight, EndPoses, Array]:
    """Return the ball's flight, the end poses, and the indices of poses at which starts end."""
    flight = flight_of(case)
    poses = end_poses(case, flight, planner.points, planner.pieces)
    ranks, _ = read_learned_starts()
    return flight, poses, rank_poses(poses, 1 + max(ranks), 1.0 - planner.slack)


def _starts(planner: "OnlineBlock", case: BlockCase) -> tuple[np.ndarray, np.ndarray]:
    return read_learned_starts(count_starts(planner.searches), case.arm.num)


def _encode_start(
    planner: "OnlineBlock", case: BlockCase, poses: EndPoses, order: Array, k: Array
) -> Array:
    ranks = jnp.asarray(_starts(planner, case)[0])
    rank = ranks[jnp.minimum(k, len(ranks) - 1)]
    return planner.encode_straight(case, poses, order[rank]) + _encode_bump(planner, case, k)


def _encode_bump(planner: "OnlineBlock", case: BlockCase, k: Array) -> Array:
    bumps = jnp.asarray(_starts(planner, case)[1], case.angles.dtype)
    bump = arm_motion.bump_steps(bumps[jnp.minimum(k, len(bumps) - 1)], planner.pieces)
    return jnp.append(bump.reshape(-1), jnp.zeros((), bump.dtype))


def _trial_cost(tried: LevenbergState, solver: LevenbergConfig) -> Array:
    return jnp.where(tried.stalled >= solver.settled, -1.0, tried.model.cost)


def encode(plan: BlockPlan) -> Array:
    """Return the unknowns of a plan whose motion lasts until the contact."""
    coeffs, durations = plan.motion.coeffs, plan.motion.durations
    rates = coeffs[:, 1] + 2.0 * durations[:, None] * coeffs[:, 2]
    return jnp.append((jnp.sum(durations) * rates).reshape(-1), plan.contact_time)
