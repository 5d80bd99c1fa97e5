"""The search that checks straight joint motions to end poses, in the order of rising cost."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.core.protocol import FEASIBILITY_TOLERANCE, is_solved, select
from planner_jax.robot import arm_motion
from planner_jax.robot.arm_clearance import least_clearances
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan, make_empty_plan
from planner_jax.task.block.problem.check import (
    checked_shares,
    make_plan,
    margin_from,
    torque_excess,
)
from planner_jax.task.block.problem.end_poses import EndPoses, end_poses, rank_straight, thin_points
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.task.block.search.attempts import Search, StraightSearch

if TYPE_CHECKING:
    from planner_jax.task.block.default_planner import OnlineBlock

# Straight motions are first checked for collisions at `_COARSE` samples, several motions together.
# Of the motions that pass, at most `_CHECKS` are checked at all samples.
_COARSE, _CHECKS = 12, 3
EVERY = 3  # straight motions lead to the end poses of one in so many points of the ball's path


def checks_straight(planner: "OnlineBlock", attempt: Search) -> bool:
    """Return whether the program of an attempt from `load_attempt` checks straight motions."""
    is_shared = jax.default_backend() == "cpu" or any(
        search.straight for search in planner.searches if search.tries
    )
    return is_shared or isinstance(attempt, StraightSearch)


def order_straight(
    planner: "OnlineBlock", case: BlockCase, poses: EndPoses, every: int, attempt: Search
) -> tuple[EndPoses, Array, Array]:
    """Return poses, the order in which a search checks straight motions to them, and their number.

    The poses belong to every `every`-th point of the ball's path; see `rank_straight`.
    """
    points = len(thin_points(planner.points, EVERY // every))
    settings = (points, every, planner.pieces, 1.0 - planner.slack, planner.brisk)
    poses, order, num = rank_straight(case, poses, *settings)
    most = max(search.straight for search in planner.searches)
    return poses, order[: max(most, 1)], jnp.minimum(num, attempt.straight)


def plan_straight(
    planner: "OnlineBlock", case: BlockCase, attempt: Search
) -> tuple[BlockPlan, EndPoses]:
    """Return the first valid one of an attempt's straight motions, and the end poses.

    With `settling`, all motions are compared, and the best one is returned.

    A few samples of each motion are checked for collisions first. Nearly all motions that pass
    are valid, so that few motions are checked at all samples.
    """
    flight = flight_of(case)
    poses = end_poses(case, flight, planner.points, planner.pieces, every=EVERY)
    if not checks_straight(planner, attempt):
        return make_empty_plan(case, planner.pieces), poses
    poses, order, num = order_straight(planner, case, poses, 1, attempt)
    shares, coarse = checked_shares(planner), min(_COARSE, planner.checked)
    few = tuple(np.arange(1, coarse + 1) / coarse)
    block = max(1, len(shares) // coarse)  # number of motions that are checked together first
    blocks, start = (num + block - 1) // block, (block - 1) * coarse

    def sample(k: Array, at: tuple[float, ...]) -> Array:
        index = order[jnp.minimum(k, len(order) - 1)]
        moves, initial, _ = planner.decode(case, planner.encode_straight(case, poses, index))
        return arm_motion.angles_at(case.angles, initial, moves, at)

    def take_turn(state: tuple[Array, Array, BlockPlan]) -> tuple[Array, Array, BlockPlan]:
        turn, free, best = state
        is_coarse, k = turn < blocks, jnp.argmax(free)
        first = block * jnp.where(is_coarse, turn, 0)
        several = jax.vmap(lambda k: sample(k, few))(first + jnp.arange(block))
        # The start replaces a sample of the last motion that is shortly after the start.
        several = jnp.resize(several, (len(shares), case.arm.num)).at[start].set(case.angles)
        angles = jnp.where(is_coarse, several, sample(k, shares))
        gaps = least_clearances(case.arm, case.scene, angles)
        others = gaps.at[start].set(jnp.inf)[: block * coarse]
        least = jnp.min(others.reshape(block, coarse), axis=1)
        found = (least >= margin_from(planner, gaps[start])) & (first + jnp.arange(block) < num)
        if case.limits.torque is not None:
            ranks = jnp.minimum(first + jnp.arange(block), len(order) - 1)
            points = jax.vmap(lambda k: planner.encode_straight(case, poses, order[k]))(ranks)
            excess = jax.vmap(lambda point: torque_excess(planner, case, point))(points)
            found &= excess <= FEASIBILITY_TOLERANCE
        found = lax.dynamic_update_slice(free, found, (first,))
        point = planner.encode_straight(case, poses, order[k])
        plan = make_plan(planner, case, flight, point, jnp.zeros((), jnp.int32), angles, gaps)
        free = jnp.where(is_coarse, found, free.at[k].set(False))
        return turn + 1, free, select(plan, best, ~is_coarse)

    def goes_on(state: tuple[Array, Array, BlockPlan]) -> Array:
        turn, free, best = state
        if planner.settling:
            return (turn < blocks) | jnp.any(free)
        stops = is_solved(best.status) | (turn >= blocks + _CHECKS)
        return (turn < blocks) | (jnp.any(free) & ~stops)

    free = jnp.zeros(block * -(-len(order) // block), bool)
    first = jnp.zeros((), jnp.int32), free, make_empty_plan(case, planner.pieces)
    return lax.while_loop(goes_on, take_turn, first)[-1], poses
