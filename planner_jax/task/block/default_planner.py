"""The default planner of blocks: a straight joint motion if one is free, else least squares.

An end pose is a pose of the arm in which the shield meets the ball, between the outer box and the
protected inner box around the arm. A straight motion follows a straight line in joint space to an
end pose. The planner checks straight motions by rising cost, and returns the first one that is free
of collisions. If there is none, Levenberg-Marquardt optimises end pose, time of contact and motion
together. It starts from straight motions with an added bump (a detour of the joints), until one
start leads to a plan that keeps every limit. [Natarajan2024] takes its motions from a library; this
planner stores only the bumps.
"""

import dataclasses
import functools
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.core.choices import EFFORTS, require_one_of
from planner_jax.core.compiled import place_numbers, with_run_time_numbers
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import (
    FEASIBILITY_TOLERANCE,
    BaseAttempt,
    Status,
    is_solved,
    require_settings,
    select,
    status_of,
)
from planner_jax.optimise import levenberg
from planner_jax.optimise.levenberg import LevenbergConfig, LevenbergState, Model, continue_search
from planner_jax.robot import arm_dynamics, arm_motion
from planner_jax.robot.arm_clearance import (
    clearances_and_slopes,
    least_clearances,
    num_of_obstacles,
)
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan, explain_status, make_empty_plan
from planner_jax.task.block.problem import terms
from planner_jax.task.block.problem.end_poses import (
    EndPoses,
    all_profiles,
    coast,
    end_poses,
    rank_straight,
    thin_points,
)
from planner_jax.task.block.problem.flight import Flight, flight_of
from planner_jax.trajectory.polynomial import PiecewisePolynomial

if TYPE_CHECKING:
    from planner_jax.task.block.replan import ReplanBlock

_HIGHEST = lax.Precision.HIGHEST
# Straight motions are first checked for collisions at `_COARSE` samples, several motions together.
# Of the motions that pass, at most `_CHECKS` are checked at all samples.
_COARSE, _CHECKS = 12, 3
_EVERY = 3  # straight motions lead to the end poses of one in so many points of the ball's path
_SETTLING = {"good": 24, "best": 48}  # effort -> number of steps that lower the cost
_TORQUES = 24  # number of times, besides the knots of a motion, at which torques are computed
_TURN = 5  # steps of least squares on a GPU before searches that have ended make room for others


@with_run_time_numbers("straight", "tries", "first", "kept", "in_turn", "detours")
@dataclasses.dataclass(frozen=True)
class Search(BaseAttempt):
    """An attempt: check some straight joint motions, then run least squares from several starts.

    There may be any number of starting points: 15 are stored, and further ones are drawn.
    """

    starts: int = 8
    straight: int = 48  # number of straight joint motions to check
    tries: int = 15  # number of starting points from which least squares are tried
    first: int = 0  # index of the first starting point to try
    kept: int = 5  # number of starting points that continue after the solver's trial steps
    # Whether each starting point is refined to its end before the next, if a single case is
    # planned. Otherwise all take a few trial steps first, and only the `kept` best ones continue.
    in_turn: bool = True
    # Number of further starting points: the best plan so far, with half of a stored detour added.
    # Searches of a batch on a GPU leave them out.
    detours: int = 0
    # `hope`: a starting point is abandoned if its cost after the trial steps is higher. Nearly all
    # starting points that lead to a valid plan have a lower cost.
    solver: LevenbergConfig = LevenbergConfig(
        *(26, 1e-2, 0.25, 6.0), settled=1, tolerance=1.0, trial=3, hope=1000.0, fade=0.7
    )


@with_run_time_numbers("straight")
@dataclasses.dataclass(frozen=True)
class StraightSearch(Search):
    """A search that only checks straight joint motions, without least squares (`tries` is 0)."""


_LEAST_SQUARES = (
    Search(straight=0, tries=4, kept=2),
    Search(straight=0, tries=11, first=4, kept=5, in_turn=False),
)
# Plans that are at most some 6 cm inside an obstacle are often mended by a longer search. It takes
# 0.1 s, so that only planners of higher effort make it.
_LAST = Search(
    straight=0,
    detours=4,
    within=6.0,
    solver=dataclasses.replace(Search.solver, max_steps=40, fade=0.85),
)
_SEARCHES = (Search(straight=12, tries=0), Search(tries=0), *_LEAST_SQUARES)


@functools.cache
def read_learned_starts(num: int = 0, joints: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Read the stored starting points, each a straight motion in joint space plus a detour.

    If there are fewer than `num`, further ones are drawn: the ranks in turn, and detours from the
    normal distribution with the stored detours' mean and standard deviation for each joint. The
    detours were learned for an arm of six joints. For an arm of seven joints, the additional joint
    is the third one, which turns the upper arm about its axis, and has no detour.

    Returns:
        ranks: (N,) int32, index of the motion's end pose among poses in order of rising effort.
        bumps: (N, n), detour of each joint [rad] at half of the motion's duration.
    """
    starts = json.loads((Path(__file__).parent / "learned_starts.json").read_text())
    ranks = np.array([start["rank"] for start in starts], np.int32)
    bumps = np.array([start["bump"] for start in starts], np.float32)
    more = max(num - len(starts), 0)
    drawn = np.random.default_rng(0).normal(size=(more, bumps.shape[1]))
    drawn = (bumps.mean(axis=0) + bumps.std(axis=0) * drawn).astype(np.float32)
    turns = (np.arange(more) % (1 + ranks.max())).astype(np.int32)
    every = np.insert(np.concatenate([bumps, drawn]), [2] * (joints - bumps.shape[1]), 0.0, axis=1)
    return np.append(ranks, turns), every


def _combine_excess(joints: Array, contact: Array, too_near: Array) -> Array:
    return jnp.maximum(jnp.maximum(joints, contact), 100.0 * too_near)


def _trial_cost(tried: LevenbergState, solver: LevenbergConfig) -> Array:
    return jnp.where(tried.stalled >= solver.settled, -1.0, tried.model.cost)


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


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class OnlineBlock(Planner):
    """Planner of arm motions that block a ball outside a protected box.

    The arm moves until the contact. The cost of a plan is the root mean square, over joints and
    time, of the joints' accelerations divided by their limits. With `brisk` it is the duration [s].
    """

    case_type: ClassVar[type] = BlockCase
    is_sequential: ClassVar[bool] = True
    pieces: int = 10  # number of pieces of each joint's rate
    points: int = 48  # number of points of the ball's path for which end poses are computed
    samples: int = 32  # samples of a motion at which least squares compute distances
    worst: int = 8  # samples with the least distances, at which least squares compute derivatives
    checked: int = 96  # samples of the returned plan at which limits are checked
    # [m], least distance of the arm from all obstacles and itself. If the arm starts nearer, the
    # margin is half of the distance at the start.
    margin: float = 0.003
    # [m], least distance from capsules, boxes and cylinders; covers gaps between samples
    obstacle_margin: float = 0.012
    slack: float = 0.004  # fraction of every limit that plans leave unused
    # Whether motions from standstill to standstill are as fast as the limits allow: the arm then
    # waits for the ball. Otherwise the arm moves until the contact, which needs less torque.
    brisk: bool = False
    # Number of steps of least squares that lower the cost of a solved plan, unless `brisk` is true.
    # If the number is not 0, all straight motions and starting points of a search are compared.
    settling: int = 0
    weights: terms.Weights = terms.Weights()
    searches: tuple[Search, ...] = _SEARCHES

    def __post_init__(self) -> None:
        require_settings(self)

    def with_effort(self, effort: str) -> Self:
        """Return a planner that compares motions, and selects the motion of least cost.

        Args:
            effort: "good" compares 48 straight motions, or starting points of least squares if none
                is solved, and lowers the cost of the best plan by up to 24 steps. "best" compares
                straight motions and all starting points, with up to 48 steps for each starting
                point. Both make a last search for balls that are nearly blocked. "feasible" returns
                the planner itself, which ends with the first plan.
        """
        require_one_of(EFFORTS, "effort", effort)
        if effort not in _SETTLING:
            return self
        straight = max(search.straight for search in self.searches)
        bent = tuple(search for search in self.searches if search.tries)
        if effort == "good":
            searches = (Search(straight=straight, tries=0), *bent)
        else:
            solver = dataclasses.replace(self.searches[0].solver, **_settle_by(_SETTLING[effort]))
            tries = max(_count_starts(bent), 1)
            searches = (Search(straight=straight, tries=tries, solver=solver),)
        settling = _SETTLING[effort]
        return dataclasses.replace(self, searches=(*searches, _LAST), settling=settling)

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches for a plan, in the order in which they are tried."""
        return self.searches

    def _checks_straight(self, attempt: Search) -> bool:
        """Return whether the program of an attempt from `load_attempt` checks straight motions."""
        is_shared = jax.default_backend() == "cpu" or any(
            search.straight for search in self.searches if search.tries
        )
        return is_shared or isinstance(attempt, StraightSearch)

    def load_attempt(self, attempt: Search, cases: BlockCase) -> Search:
        """Return a search whose numbers are arrays, so that all searches use one compiled program.

        Searches without least squares use a smaller program for a single case, so that the first
        plan comes early, and for batches on a GPU.
        """
        is_small = cases.batch_shape == () or jax.default_backend() != "cpu"
        is_straight = is_small and not attempt.tries
        return place_numbers(StraightSearch(**vars(attempt)) if is_straight else attempt)

    def compiles_quickly(self, attempt: Search) -> bool:
        """Return whether a search's program is compiled in less time, though it then runs slower.

        This is true for least squares: few cases need them, so that their run time matters less.
        """
        return attempt.tries > 0

    def solve(self, case: BlockCase, attempt: Search) -> BlockPlan:
        """Return the plan of one case: a straight motion, else least squares from starting points.

        With `attempt.in_turn`, starting points are refined one after another. Otherwise all take a
        few trial steps, and the `attempt.kept` points of least cost are refined. The search ends at
        the first solved plan, unless `settling` requires a comparison.
        """
        if isinstance(attempt, StraightSearch):
            plan, poses = self._plan_straight(case, attempt)
            plan = self._settle(case, flight_of(case), plan)
            return dataclasses.replace(plan, status=explain_status(poses, plan.status))
        flight, poses, order = self._rank(case)
        goals, goal_order, straight = self._rank_straight(case, poses, _EVERY, attempt)
        model = lambda point: self.model(point, case, flight)  # noqa: E731
        solver, tries = attempt.solver, jnp.where(flight.comes, attempt.tries, 0)
        kept = jnp.where(attempt.in_turn, 0, jnp.minimum(attempt.kept, tries))

        def take_turn(turn: tuple[Array, LevenbergState, Array, BlockPlan]) -> tuple:
            k, searches, costs, best = turn
            is_straight, index = k < straight, jnp.maximum(k - straight, 0)
            is_trial = ~is_straight & jnp.logical_not(attempt.in_turn) & (index < tries)
            is_detour = index >= tries + kept
            is_new = is_straight | is_trial | attempt.in_turn | is_detour
            index = jnp.where(is_new, index, jnp.argmin(costs))
            start = self._encode_start(case, poses, order, attempt.first + index)
            bump = 0.5 * self._encode_bump(case, index - tries - kept)
            start = jnp.where(is_detour, _encode(best) + bump, start)
            straight_start = self.encode_straight(case, goals, goal_order[k])
            begin = levenberg.start_search(jnp.where(is_straight, straight_start, start), solver)
            pick = lambda new, old: jnp.where(is_new, new, old[index])  # noqa: E731
            search = jax.tree.map(pick, begin, searches)
            most = jnp.where(is_straight, -1, jnp.where(is_trial, solver.trial, solver.max_steps))
            search = continue_search(model, search, solver, most)
            searches = jax.tree.map(lambda old, new: old.at[index].set(new), searches, search)
            costs = costs.at[index].set(jnp.where(is_trial, _trial_cost(search, solver), jnp.inf))
            finish = lambda s: self.finish(case, flight, s.point, jnp.maximum(s.steps, 0))  # noqa: E731
            plan = lax.cond(is_trial, lambda _: best, finish, search)
            return k + 1, searches, costs, select(plan, best)

        def is_open(turn: tuple[Array, LevenbergState, Array, BlockPlan]) -> Array:
            k, best = turn[0], turn[-1]
            most = straight + tries + kept + jnp.where(flight.comes, attempt.detours, 0)
            return (k < most) & (bool(self.settling) | ~is_solved(best.status))

        num, dtype = len(self._starts(case)[0]), case.angles.dtype
        size = case.arm.num * self.pieces + 1
        empty = levenberg.start_search(jnp.zeros(size, dtype), solver)
        searches = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)), empty)
        costs, best = jnp.full(num, jnp.inf, dtype), make_empty_plan(case, self.pieces)
        turn = (jnp.zeros((), jnp.int32), searches, costs, best)
        plan = self._settle(case, flight, lax.while_loop(is_open, take_turn, turn)[-1])
        return dataclasses.replace(plan, status=explain_status(poses, plan.status))

    def solve_at_once(self, cases: BlockCase, attempt: Search) -> BlockPlan:
        """Return the plans of a batch, on a GPU: the cases take the steps of searches together."""
        flights = jax.vmap(flight_of)(cases)
        best, poses = jax.vmap(lambda case: self._plan_straight(case, attempt))(cases)
        if not isinstance(attempt, StraightSearch):
            _, poses, orders = jax.vmap(self._rank)(cases)
            best = self._refine_at_once(cases, flights, poses, orders, best, attempt)
        best = jax.vmap(self._settle)(cases, flights, best)
        return dataclasses.replace(best, status=jax.vmap(explain_status)(poses, best.status))

    def _refine_at_once(
        self,
        cases: BlockCase,
        flights: Flight,
        poses: EndPoses,
        orders: Array,
        best: BlockPlan,
        attempt: Search,
    ) -> BlockPlan:
        """Return the plans of a batch by least squares.

        Each case has one more search than the `attempt.kept` best ones. In each of the first turns
        it starts at the next starting point, and takes trial steps. In a later turn, open searches
        of all cases, one for each case on average, take a few steps.
        """
        solver, kept = attempt.solver, max(search.kept for search in self.searches)
        is_left = (~is_solved(best.status)) | bool(self.settling)
        slots, num, dtype = kept + 1, orders.shape[0], cases.angles.dtype

        def advance(search: LevenbergState, most: Array, given: tuple) -> LevenbergState:
            return continue_search(lambda x: self.model(x, *given), search, solver, most)

        def find_open(costs: Array, searches: LevenbergState) -> Array:
            each = jax.vmap(lambda search: levenberg.is_open(search, solver, solver.max_steps))
            chosen = (jnp.arange(slots) < attempt.kept) & jnp.isfinite(costs)
            is_open = each(searches).reshape(num, slots) & chosen
            return (is_open & is_left[:, None]).reshape(-1)

        def take_turn(state: tuple[Array, Array, LevenbergState]) -> tuple:
            turn, costs, searches = state
            is_trial = turn < attempt.tries
            start = functools.partial(self._encode_start, k=attempt.first + turn)
            begin = lambda *given: levenberg.start_search(start(*given), solver)  # noqa: E731
            begun = jax.vmap(begin)(cases, poses, orders)
            every = jnp.nonzero(find_open(costs, searches), size=num, fill_value=num * slots)[0]
            lanes = jnp.where(is_trial, slots * jnp.arange(num) + kept, every)
            some = jax.tree.map(lambda leaf: leaf.at[lanes].get(mode="clip"), searches)
            some = jax.tree.map(lambda a, b: jnp.where(is_trial, a, b), begun, some)
            own = jnp.minimum(lanes // slots, num - 1)
            given = jax.tree.map(lambda leaf: leaf[own], (cases, flights))
            later = jnp.minimum(some.steps + _TURN, solver.max_steps)
            some = jax.vmap(advance)(some, jnp.where(is_trial, solver.trial, later), given)
            searches = jax.tree.map(lambda a, b: a.at[lanes].set(b, mode="drop"), searches, some)

            def rank() -> tuple[Array, LevenbergState]:
                ranked = costs.at[:, kept].set(_trial_cost(some, solver))
                order = jnp.argsort(ranked, axis=1)
                flat = (slots * jnp.arange(num)[:, None] + order).reshape(-1)
                sort = lambda leaf: leaf[flat]  # noqa: E731
                return jnp.take_along_axis(ranked, order, 1), jax.tree.map(sort, searches)

            return turn + 1, *lax.cond(is_trial, rank, lambda: (costs, searches))

        def goes_on(state: tuple[Array, Array, LevenbergState]) -> Array:
            turn, costs, searches = state
            return (turn < attempt.tries) | jnp.any(find_open(costs, searches))

        empty = levenberg.start_search(jnp.zeros(cases.arm.num * self.pieces + 1, dtype), solver)
        empty = jax.tree.map(lambda x: jnp.broadcast_to(x, (num * slots, *x.shape)), empty)
        state = jnp.zeros((), jnp.int32), jnp.full((num, slots), jnp.inf, dtype), empty
        _, costs, ends = lax.while_loop(goes_on, take_turn, state)

        def finish(k: Array, best: BlockPlan) -> BlockPlan:
            lanes = slots * jnp.arange(num) + k
            plans = jax.vmap(self.finish)(cases, flights, ends.point[lanes], ends.steps[lanes])
            is_left = bool(self.settling) | ~is_solved(best.status)
            return select(plans, best, jnp.isfinite(costs[:, k]) & is_left)

        return lax.fori_loop(0, jnp.minimum(attempt.kept, kept), finish, best)

    def _plan_straight(self, case: BlockCase, attempt: Search) -> tuple[BlockPlan, EndPoses]:
        """Return the first valid one of an attempt's straight motions, and the end poses.

        With `settling`, all motions are compared, and the best one is returned.

        A few samples of each motion are checked for collisions first. Nearly all motions that pass
        are valid, so that few motions are checked at all samples.
        """
        flight = flight_of(case)
        poses = end_poses(case, flight, self.points, self.pieces, every=_EVERY)
        if not self._checks_straight(attempt):
            return make_empty_plan(case, self.pieces), poses
        poses, order, num = self._rank_straight(case, poses, 1, attempt)
        shares, coarse = self._shares(), min(_COARSE, self.checked)
        few = tuple(np.arange(1, coarse + 1) / coarse)
        block = max(1, len(shares) // coarse)  # number of motions that are checked together first
        blocks, start = (num + block - 1) // block, (block - 1) * coarse

        def sample(k: Array, at: tuple[float, ...]) -> Array:
            index = order[jnp.minimum(k, len(order) - 1)]
            moves, initial, _ = self.decode(case, self.encode_straight(case, poses, index))
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
            found = (least >= self._margin_from(gaps[start])) & (first + jnp.arange(block) < num)
            if case.limits.torque is not None:
                ranks = jnp.minimum(first + jnp.arange(block), len(order) - 1)
                points = jax.vmap(lambda k: self.encode_straight(case, poses, order[k]))(ranks)
                excess = jax.vmap(lambda point: self.torque_excess(case, point))(points)
                found &= excess <= FEASIBILITY_TOLERANCE
            found = lax.dynamic_update_slice(free, found, (first,))
            point = self.encode_straight(case, poses, order[k])
            plan = self._plan_of(case, flight, point, jnp.zeros((), jnp.int32), angles, gaps)
            free = jnp.where(is_coarse, found, free.at[k].set(False))
            return turn + 1, free, select(plan, best, ~is_coarse)

        def goes_on(state: tuple[Array, Array, BlockPlan]) -> Array:
            turn, free, best = state
            if self.settling:
                return (turn < blocks) | jnp.any(free)
            stops = is_solved(best.status) | (turn >= blocks + _CHECKS)
            return (turn < blocks) | (jnp.any(free) & ~stops)

        free = jnp.zeros(block * -(-len(order) // block), bool)
        first = jnp.zeros((), jnp.int32), free, make_empty_plan(case, self.pieces)
        return lax.while_loop(goes_on, take_turn, first)[-1], poses

    def _settle(self, case: BlockCase, flight: Flight, plan: BlockPlan) -> BlockPlan:
        """Return the plan, or a plan of less cost that least squares find from it."""
        if self.brisk or not self.settling:
            return plan
        solver = dataclasses.replace(Search.solver, **_settle_by(self.settling), hope=None)

        def settle() -> BlockPlan:
            return select(self.refine(case, flight, _encode(plan), solver), plan)

        return lax.cond(is_solved(plan.status), settle, lambda: plan)

    def _shares(self) -> tuple[float, ...]:
        """Return the samples of a motion that are checked, as fractions of the duration.

        They are the start and all samples except the first after it: 96 by default. A GPU runs
        threads in groups of 32, and takes a third longer for 97 samples.
        """
        return (0.0, *(np.arange(min(2, self.checked), self.checked + 1) / self.checked))

    def _rank(self, case: BlockCase) -> tuple[Flight, EndPoses, Array]:
        flight = flight_of(case)
        poses = end_poses(case, flight, self.points, self.pieces)
        ranks, _ = read_learned_starts()
        return flight, poses, rank_poses(poses, 1 + max(ranks), 1.0 - self.slack)

    def _rank_straight(
        self, case: BlockCase, poses: EndPoses, every: int, attempt: Search
    ) -> tuple[EndPoses, Array, Array]:
        points = len(thin_points(self.points, _EVERY // every))
        settings = (points, every, self.pieces, 1.0 - self.slack, self.brisk)
        poses, order, num = rank_straight(case, poses, *settings)
        most = max(search.straight for search in self.searches)
        return poses, order[: max(most, 1)], jnp.minimum(num, attempt.straight)

    def _starts(self, case: BlockCase) -> tuple[np.ndarray, np.ndarray]:
        return read_learned_starts(_count_starts(self.searches), case.arm.num)

    def _encode_start(self, case: BlockCase, poses: EndPoses, order: Array, k: Array) -> Array:
        ranks = jnp.asarray(self._starts(case)[0])
        rank = ranks[jnp.minimum(k, len(ranks) - 1)]
        return self.encode_straight(case, poses, order[rank]) + self._encode_bump(case, k)

    def _encode_bump(self, case: BlockCase, k: Array) -> Array:
        bumps = jnp.asarray(self._starts(case)[1], case.angles.dtype)
        bump = arm_motion.bump_steps(bumps[jnp.minimum(k, len(bumps) - 1)], self.pieces)
        return jnp.append(bump.reshape(-1), jnp.zeros((), bump.dtype))

    def refine(
        self, case: BlockCase, flight: Flight, start: Array, solver: LevenbergConfig
    ) -> BlockPlan:
        """Return the plan that least squares find from a start: joint rates and time of contact."""
        end = levenberg.least_squares(lambda point: self.model(point, case, flight), start, solver)
        return self.finish(case, flight, end.point, end.steps)

    def encode_straight(self, case: BlockCase, poses: EndPoses, index: Array) -> Array:
        """Return the unknowns, joint rates and time of contact, of a straight motion to a pose.

        The pose is the entry `index` of `poses`, in which the shield meets the ball.
        """
        time = poses.time[index]
        duration = jnp.maximum(time - case.delay, 1e-3)
        turned = poses.angles[index] - coast(case, duration, self.pieces)
        shapes = jnp.asarray(all_profiles(self.pieces)[0], turned.dtype)
        steps = shapes[poses.profile[index]][:, None] * turned[None]
        return jnp.append(steps.reshape(-1), time)

    def decode(self, case: BlockCase, point: Array) -> tuple[Array, Array, Array]:
        """Split the unknowns into joint rates and a duration.

        Returns:
            The rates after each of K pieces (K, n) and at the start (n,), both multiplied by the
            duration [rad], and the duration () [s].
        """
        steps = point[:-1].reshape(self.pieces, case.arm.num)
        duration = jnp.maximum(point[-1] - case.delay, 1e-3)
        last = jnp.where(case.ends_at_rest, 0.0, steps[-1])
        return steps.at[-1].set(last), case.rates * duration, duration

    def _margin_from(self, gap: Array) -> Array:
        """Return the margin () [m] of motions that start at a distance () [m] from other bodies."""
        return jnp.where(gap < self.margin, 0.5 * jnp.maximum(gap, 0.0), self.margin)

    def model(self, point: Array, case: BlockCase, flight: Flight) -> Model:
        """Return the cost, a sum of squares, and its quadratic model by rates and time of contact.

        The residuals are the errors of the shield's contact with the ball, excesses over joint
        limits, distances below their margins, and joint accelerations.
        """
        steps, first, duration = self.decode(case, point)
        pieces, dtype = self.pieces, point.dtype
        joints = terms.joint_terms(case, steps, first, duration, self.weights, 1.0 - self.slack)
        shares = tuple(np.arange(1, self.samples + 1) / self.samples)
        angles = arm_motion.angles_at(case.angles, first, steps, shares)
        gaps, slopes_at = clearances_and_slopes(case.arm, case.scene, angles)
        gaps = lax.optimization_barrier(gaps)  # (R, S)
        is_of_scene = np.arange(gaps.shape[0]) < num_of_obstacles(case.arm, case.scene)
        margins = np.where(is_of_scene, self.obstacle_margin, 1.3 * self.margin)[:, None]
        near, worst = lax.top_k(jnp.max(margins - gaps, axis=0), self.worst)
        slopes = slopes_at(worst)  # (R, n, W)
        short = jnp.maximum(margins - gaps[:, worst], 0.0) * self.weights.clearance  # (R, W)
        active = jnp.where(short > 0.0, -self.weights.clearance, 0.0)
        lifts, short = lax.optimization_barrier((slopes * active[:, None], short))
        grams = jnp.einsum("riw,rjw->wij", lifts, lifts, precision=_HIGHEST)
        pushes = jnp.einsum("riw,rw->wi", lifts, short, precision=_HIGHEST)
        grams, pushes = jnp.pad(grams, ((0, 0), (0, 1), (0, 1))), jnp.pad(pushes, ((0, 0), (0, 1)))
        contact = terms.contact_terms(case, flight, angles[-1], point[-1], self.weights)
        rows, row_slopes, contact_excess = contact
        gram = jnp.matmul(row_slopes.T, row_slopes, precision=_HIGHEST)
        push = jnp.matmul(row_slopes.T, rows, precision=_HIGHEST)
        grams = jnp.concatenate([grams, gram[None]])
        pushes = jnp.concatenate([pushes, push[None]])
        weights = arm_motion.step_weights(pieces, shares)
        of_first, of_steps = (jnp.asarray(each, dtype) for each in weights)
        chosen = jnp.append(worst, self.samples - 1)
        lift = of_steps[chosen]  # (W + 1, K)
        drift = of_first[chosen][:, None] * case.rates[None]  # (W + 1, n)
        gradient, curvature = terms.lift_to_unknowns(lift, drift, grams, pushes, joints)
        size = case.arm.num * pieces
        ends_free = jnp.where(case.ends_at_rest, 0.0, 1.0)
        free = jnp.ones(size + 1, dtype).at[size - case.arm.num : size].set(ends_free)
        too_near = near[0] - 0.3 * self.margin
        cost = joints.cost + jnp.sum(rows**2) + jnp.sum(short**2)
        joint_excess = joints.excess
        if case.limits.torque is not None:
            (more, push, gram), torque_excess = self._torque_terms(case, point)
            cost, gradient, curvature = cost + more, gradient + push, curvature + gram
            joint_excess = jnp.maximum(joint_excess, torque_excess)
        return Model(
            cost=cost,
            gradient=gradient * free,
            curvature=curvature * free[:, None] * free[None],
            violation=_combine_excess(joint_excess, contact_excess, too_near),
        )

    def _motion_of(self, case: BlockCase, point: Array) -> PiecewisePolynomial:
        steps, first, duration = self.decode(case, point)
        return arm_motion.polynomial(case.angles, first, steps, duration)

    def torque_excess(self, case: BlockCase, point: Array) -> Array:
        """Return the greatest relative excess () of a torque over its limit, less a reserve."""
        of_case, path = (case.arm, case.limits, case.gravity), self._motion_of(case, point)
        return arm_dynamics.measure_torques(*of_case, path, _TORQUES)[0]

    def _torque_terms(self, case: BlockCase, point: Array) -> tuple[tuple[Array, ...], Array]:
        """Return cost, gradient and curvature of excess torques at the knots, and their excess ().

        The derivatives are computed only if a torque exceeds its limit.
        """
        most = arm_dynamics.USED * jnp.asarray(case.limits.torque)
        sample = lambda point: arm_dynamics.sample_states(self._motion_of(case, point), 0)  # noqa: E731

        def share(angles: Array, rates: Array, rises: Array) -> Array:
            return (
                arm_dynamics.inverse_dynamics(case.arm, angles, rates, rises, case.gravity) / most
            )

        def derive() -> tuple[Array, ...]:
            over = self.weights.limits * jnp.maximum(jnp.abs(shares) - 1.0 + self.slack, 0.0)
            sign = jnp.where(over > 0.0, self.weights.limits * jnp.sign(shares), 0.0)
            by_state = jax.vmap(jax.jacfwd(share, (0, 1, 2)))(*states)  # each (S, n, n)
            lifts = zip(by_state, jax.jacfwd(sample)(point), strict=True)
            slopes = sum(jnp.einsum("sij,sju->siu", *pair, precision=_HIGHEST) for pair in lifts)
            slopes = (sign[:, :, None] * slopes).reshape(-1, num)
            push = jnp.matmul(over.reshape(-1), slopes, precision=_HIGHEST)
            return jnp.sum(over**2), push, jnp.matmul(slopes.T, slopes, precision=_HIGHEST)

        num, states = point.size, sample(point)
        shares = jax.vmap(share)(*states)
        none = [jnp.zeros(shape, point.dtype) for shape in ((), (num,), (num, num))]
        worst = jnp.max(jnp.abs(shares)) - 1.0
        return lax.cond(worst > -self.slack, derive, lambda: tuple(none)), worst

    def finish(self, case: BlockCase, flight: Flight, point: Array, steps: Array) -> BlockPlan:
        """Return the plan of the unknowns `point`, which are joint rates and time of contact.

        Limits are checked at `checked` samples. The plan reports `steps` as its iterations.
        """
        moves, first, _ = self.decode(case, point)
        angles = arm_motion.angles_at(case.angles, first, moves, self._shares())
        gaps = least_clearances(case.arm, case.scene, angles)
        return self._plan_of(case, flight, point, steps, angles, gaps)

    def _plan_of(
        self,
        case: BlockCase,
        flight: Flight,
        point: Array,
        steps: Array,
        angles: Array,
        gaps: Array,
    ) -> BlockPlan:
        moves, first, duration = self.decode(case, point)
        joints = terms.joint_terms(case, moves, first, duration, self.weights, 1.0 - self.slack)
        # A joint may exceed its position limit between two knots and turn back: check all samples.
        middle = 0.5 * (case.arm.upper + case.arm.lower)
        half = 0.5 * (case.arm.upper - case.arm.lower)
        beyond = jnp.max(jnp.abs(angles - middle[None]) / half[None]) - 1.0
        contact = terms.contact_terms(case, flight, angles[-1], point[-1], self.weights)[2]
        joint_excess = jnp.maximum(joints.excess, beyond)
        if case.limits.torque is not None:
            joint_excess = jnp.maximum(joint_excess, self.torque_excess(case, point))
        margin = self._margin_from(gaps[0])
        excess = _combine_excess(joint_excess, contact, margin - jnp.min(gaps[1:]))
        violation = jnp.where(point[-1] > case.delay, excess, jnp.inf)
        status = status_of(joints.load, violation, violation > FEASIBILITY_TOLERANCE)
        is_blocked = (gaps[0] < 0.0) & ~is_solved(status)  # the arm touches something at the start
        plan = BlockPlan(
            motion=arm_motion.polynomial(case.angles, first, moves, duration),
            contact_time=point[-1],
            cost=joints.load,
            violation=violation,
            iterations=jnp.asarray(steps, jnp.int32),
            status=jnp.where(is_blocked, Status.BLOCKED, status).astype(jnp.int32),
        )
        if not self.brisk:
            return plan
        most = 1.0 - self.slack
        rate, rise = most * case.limits.velocity, most * case.limits.acceleration
        path, pace = arm_motion.speed_up(plan.motion, rate, rise)
        if case.limits.torque is not None:
            of_case = case.arm, case.limits, case.gravity
            slower = arm_dynamics.measure_torques(*of_case, path, _TORQUES)[1]
            # The slow motion keeps the limits, also where the arm could not stand still.
            slower = jnp.minimum(slower, 1.0 / pace)
            path, pace = arm_dynamics.stretch(path, slower), pace * slower
        rests = is_solved(plan.status) & case.ends_at_rest & jnp.all(case.rates == 0.0)
        plan = dataclasses.replace(plan, cost=duration)
        quick = dataclasses.replace(plan, motion=path, cost=pace * duration)
        return jax.tree.map(lambda new, old: jnp.where(rests, new, old), quick, plan)

    def replanner(self) -> "ReplanBlock":
        """Return the planner by which `pj.replan` updates motions that are being executed."""
        from planner_jax.task.block.replan import ReplanBlock, WarmBlock

        return ReplanBlock(warm=WarmBlock(planner=self), planner=self)


def _encode(plan: BlockPlan) -> Array:
    """Return the unknowns of a plan whose motion lasts until the contact."""
    coeffs, durations = plan.motion.coeffs, plan.motion.durations
    rates = coeffs[:, 1] + 2.0 * durations[:, None] * coeffs[:, 2]
    return jnp.append((jnp.sum(durations) * rates).reshape(-1), plan.contact_time)


def _settle_by(steps: int) -> dict[str, Any]:
    """Return fields of a solver that continues at feasible points, for `steps` steps at most."""
    return {"max_steps": steps, "settled": 3, "tolerance": 2e-3}


def _count_starts(searches: tuple[Search, ...]) -> int:
    return max((search.first + search.tries for search in searches), default=0)


def brisk(**fields: object) -> OnlineBlock:
    """Make an `OnlineBlock` whose motions end as early as possible; the arm waits for the ball."""
    return OnlineBlock(**{"brisk": True, **fields})
