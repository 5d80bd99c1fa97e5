"""The planner of joint motions: the fastest motion if it is free, else least squares from a path.

The planner first checks the fastest motion and the straight motion to each goal. If none is free of
collisions, Levenberg-Marquardt shortens motions that start from straight motions with a bump (a
detour of the joints), or from a path that RRT-Connect finds. A path itself is also a plan, if the
arm stops at its corners.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.compiled import place_numbers, with_run_time_numbers
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import (
    FEASIBILITY_TOLERANCE,
    Attempt,
    Status,
    is_solved,
    require_settings,
    select,
    status_of,
)
from planner_jax.optimise.levenberg import LevenbergConfig, continue_search, start_search
from planner_jax.robot.arm import Arm, ArmPlan
from planner_jax.task.block.clearance import clearances
from planner_jax.task.block.motion import bump_steps
from planner_jax.task.reach import motion, tree
from planner_jax.task.reach.case import ReachCase
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, total_duration

_TURN = 0.018  # [rad], greatest joint-space distance between two states that are checked
_CHUNK = 64  # number of states that are checked together
_POWERS = (2.0, 4.0, 8.0)  # powers of relative accelerations in the cost, one after another
_CUTS = 200  # number of attempts to shorten a path


@struct.dataclass
class ReachPlan(ArmPlan):
    """The plan of a motion from standstill to standstill, or a batch of plans."""

    goal: Array  # () int32, index of the goal at which the motion ends


@dataclasses.dataclass(frozen=True)
class Search(Attempt):
    """An attempt: check the fastest and the straight motion to each goal."""


@dataclasses.dataclass(frozen=True)
class BumpSearch(Search):
    """An attempt: shorten straight motions with bumps until one is free of collisions."""

    bumps: int = 8


@with_run_time_numbers("rays", "seed")
@dataclasses.dataclass(frozen=True)
class TreeSearch(Search):
    """An attempt: find a path by RRT-Connect, and shorten the motion along it."""

    rays: int = 1000  # greatest number of attempts to grow a tree of joint states
    seed: int = 0  # of the random states


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ReachPlanner(Planner):
    """Planner of arm motions from standstill to standstill; cost: the duration [s]."""

    case_type: ClassVar[type] = ReachCase
    plan_type: ClassVar[type] = ReachPlan
    is_sequential: ClassVar[bool] = True
    pieces: int = 30  # greatest number of pieces of a motion
    samples: int = 60  # samples of a motion at which least squares compute distances
    worst: int = 12  # samples with the least distances, at which derivatives are computed
    capacity: int = 8192  # greatest number of states of a tree
    margin: float = 0.002  # [m], distance from obstacles, if start and goal have twice as much
    slack: float = 1e-4  # fraction of every limit of rates and accelerations that is left unused
    solver: LevenbergConfig = LevenbergConfig(12, 1e-2, 0.25, 6.0, longest=2.0)
    searches: tuple[Search, ...] = (
        Search(),
        BumpSearch(),
        TreeSearch(),
        TreeSearch(rays=8000, seed=1),
        TreeSearch(rays=8000, seed=2),
        TreeSearch(rays=16000, seed=3),
        TreeSearch(rays=16000, seed=4),
    )

    def __post_init__(self) -> None:
        require_settings(self)

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches for a plan, in the order in which they are tried."""
        return self.searches

    def load_attempt(self, attempt: Search, cases: ReachCase) -> Search:
        """Return a search whose numbers are arrays, so that searches of a class share a program."""
        if isinstance(attempt, TreeSearch):
            return place_numbers(attempt)
        return super().load_attempt(attempt, cases)

    def compiles_quickly(self, attempt: Search) -> bool:
        """Return whether a search's program is compiled in less time, though it then runs slower.

        This is true for all but the first search, since fewer cases need these programs.
        """
        return type(getattr(attempt, "attempt", attempt)) is not Search

    def solve(self, case: ReachCase, attempt: Search) -> ReachPlan:
        """Return the plan of one case by one search."""
        attempt = getattr(attempt, "attempt", attempt)
        limits = jax.tree.map(lambda each: each * (1.0 - self.slack), case.limits)
        case = dataclasses.replace(case, limits=limits)
        states = jnp.concatenate([case.angles[None], case.goals])
        rows = clearances(case.arm, case.scene, states)
        gaps = jnp.min(rows, axis=0)
        is_within = jnp.all(
            (states >= case.arm.lower[None]) & (states <= case.arm.upper[None]), axis=1
        )
        is_good = is_within[1:] & (gaps[1:] >= 0.0)
        blocked = jnp.where(jnp.any(is_within[1:]), Status.BLOCKED, Status.OUT_OF_REACH)
        is_open = jnp.any(is_good) & (gaps[0] >= 0.0)
        best = self._stand_still(case)
        # Goals in the order of the least durations; goals that cannot be reached come last.
        times = jax.vmap(lambda goal: motion.quickest_knots(case.angles, goal, limits)[0][-1])(
            case.goals
        )
        order = jnp.argsort(jnp.where(is_good, times, jnp.inf))
        num = jnp.where(is_open, jnp.sum(is_good, dtype=jnp.int32), 0)
        if isinstance(attempt, TreeSearch):
            plan = lax.cond(
                is_open,
                lambda: self._plan_by_tree(case, rows, is_good, order, num, attempt),
                lambda: best,
            )
        elif isinstance(attempt, BumpSearch):
            plan = self._plan_by_bumps(case, rows, order, num, attempt, best)
        else:
            plan = self._plan_directly(case, rows, order, num, best)
        status = jnp.where(is_open, plan.status, jnp.where(gaps[0] < 0.0, Status.BLOCKED, blocked))
        return dataclasses.replace(plan, status=status.astype(jnp.int32))

    def _plan_directly(
        self, case: ReachCase, rows: Array, order: Array, num: Array, best: ReachPlan
    ) -> ReachPlan:
        def try_next(state: tuple[Array, ReachPlan]) -> tuple[Array, ReachPlan]:
            k, best = state
            index = order[k % num]
            points = jnp.stack([case.angles, case.goals[index]])
            quickest = motion.quickest_knots(points[0], points[1], case.limits)
            straight = motion.straight_knots(points, case.limits)
            both = [motion.pad_knots(*each, self.pieces) for each in (quickest, straight)]
            times, rates = jax.tree.map(lambda a, b: jnp.where(k < num, a, b), *both)
            return k + 1, select(self.finish(case, rows, index, times, rates), best)

        def is_open(state: tuple[Array, ReachPlan]) -> Array:
            return (state[0] < 2 * num) & ~is_solved(state[1].status)

        return lax.while_loop(is_open, try_next, (jnp.zeros((), jnp.int32), best))[1]

    def _plan_by_bumps(
        self,
        case: ReachCase,
        rows: Array,
        order: Array,
        num: Array,
        attempt: BumpSearch,
        best: ReachPlan,
    ) -> ReachPlan:
        joints = case.angles.shape[0]
        heights = np.random.default_rng(0).normal(size=(attempt.bumps, joints))
        heights[0] = 0.0
        heights *= np.where(np.arange(joints) < joints - 3, 0.6, 0.3)

        def try_next(state: tuple[Array, ReachPlan]) -> tuple[Array, ReachPlan]:
            k, best = state
            index = order[k % num]
            points = jnp.stack([case.angles, case.goals[index]])
            start = motion.steps_along(points, case.limits, self.pieces)
            height = jnp.asarray(heights, start.dtype)[k]
            start += bump_steps(height, self.pieces)[:-1]
            point, steps = self._refine(case, rows, index, start)
            plan = self.finish(case, rows, index, *motion.steps_knots(point, case.limits))
            return k + 1, select(dataclasses.replace(plan, iterations=steps), best)

        def is_open(state: tuple[Array, ReachPlan]) -> Array:
            return (state[0] < attempt.bumps) & (num > 0) & ~is_solved(state[1].status)

        return lax.while_loop(is_open, try_next, (jnp.zeros((), jnp.int32), best))[1]

    def _plan_by_tree(
        self,
        case: ReachCase,
        rows: Array,
        is_good: Array,
        order: Array,
        num: Array,
        attempt: TreeSearch,
    ) -> ReachPlan:
        ends = jnp.minimum(
            rows[:, 0], jnp.min(jnp.where(is_good[None], rows[:, 1:], jnp.inf), axis=1)
        )
        floors = self._floors(ends)[:, None]

        # The trees measure a turn by the greatest distance by which it can move a part of the arm.
        lever = _levers(case.arm)

        def is_free(turned: Array) -> Array:
            return jnp.all(clearances(case.arm, case.scene, turned / lever[None]) >= floors, axis=0)

        # Goals that cannot be reached are replaced by the nearest one that can.
        goals = case.goals[order]
        goals = jnp.where((jnp.arange(goals.shape[0]) < num)[:, None], goals, goals[:1])
        points, is_found, rays = tree.find_path(
            is_free,
            case.angles * lever,
            goals * lever[None],
            _finite_bounds(case, lever),
            attempt.rays,
            attempt.seed,
            self.capacity,
        )

        def follow() -> ReachPlan:
            path = tree.shorten(is_free, points, _CUTS, attempt.seed) / lever[None]
            goal = jnp.argmin(jnp.sum((case.goals - path[-1][None]) ** 2, axis=1))
            start = motion.steps_along(path, case.limits, self.pieces)
            point, steps = self._refine(case, rows, goal, start)
            both = [motion.steps_knots(point, case.limits), self._stop_at_corners(case, path)]
            knots = jax.tree.map(lambda *each: jnp.stack(each), *both)

            def check(k: Array, best: ReachPlan) -> ReachPlan:
                return select(self.finish(case, rows, goal, *(each[k] for each in knots)), best)

            plan = lax.fori_loop(0, 2, check, self._stand_still(case))
            return dataclasses.replace(plan, iterations=steps)

        plan = lax.cond(is_found, follow, lambda: self._stand_still(case))
        return dataclasses.replace(plan, iterations=plan.iterations + rays)

    def _stop_at_corners(self, case: ReachCase, path: Array) -> tuple[Array, Array]:
        """Return the knots of a motion along a path (N, n) [rad] that stops at its corners.

        The rates are NaN if the path has too many corners for the number of pieces.
        """
        line = jnp.diff(path, axis=0)
        length = jnp.sqrt(jnp.sum(line**2, axis=1))
        unit = line / jnp.maximum(length, 1e-9)[:, None]

        # A corner is a point after which the direction changes. Successive points may be equal.
        def turn(last: Array, each: tuple[Array, Array]) -> tuple[Array, Array]:
            unit, length = each
            moves = length > 1e-6
            return jnp.where(moves, unit, last), moves & (jnp.sum(last * unit) < 1.0 - 1e-6)

        _, bends = lax.scan(turn, unit[jnp.argmax(length > 1e-6)], (unit, length))
        most = self.pieces // 3  # of straight lines
        corners = jnp.nonzero(bends, size=most, fill_value=path.shape[0] - 1)[0]
        points = jnp.concatenate([path[:1], path[corners]])
        knots = motion.pad_knots(*motion.straight_knots(points, case.limits), self.pieces)
        fits = jnp.sum(bends, dtype=jnp.int32) < most
        return knots[0], jnp.where(fits, knots[1], jnp.nan)

    def _refine(
        self, case: ReachCase, rows: Array, goal: Array, start: Array
    ) -> tuple[Array, Array]:
        """Return unknowns (K - 1, n) with less duration and collisions, and the number of steps."""
        turn = case.goals[goal] - case.angles
        ends = jnp.minimum(rows[:, 0], rows[:, 1 + goal])
        sizes = (self.pieces, self.samples, self.worst)

        def refine(k: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            point, steps = state
            whole = motion.end_at(point.reshape(start.shape), turn)
            duration = motion.least_duration(whole, case.limits)
            power = jnp.asarray(_POWERS, point.dtype)[k]
            model = motion.make_model(case, turn, ends, duration, power, sizes)
            search = continue_search(model, start_search(point, self.solver), self.solver)
            return search.point, steps + search.steps

        first = (start.reshape(-1), jnp.zeros((), jnp.int32))
        point, steps = lax.fori_loop(0, len(_POWERS), refine, first)
        return motion.end_at(point.reshape(start.shape), turn), steps

    def _floors(self, ends: Array) -> Array:
        """Return the distance (R,) [m] that each pair keeps, by its distance (R,) at the ends."""
        return jnp.clip(0.5 * ends, 0.0, self.margin)

    def finish(
        self, case: ReachCase, rows: Array, goal: Array, times: Array, rates: Array
    ) -> ReachPlan:
        """Return the plan of a motion with these knots, and check it for collisions.

        Args:
            case: the case.
            rows: (R, 1 + G) [m], distances of R pairs of bodies at the start and at the goals.
            goal: () index of the motion's goal.
            times: (M + 1,) [s], of the knots.
            rates: (M + 1, n) [rad/s], joint rates at the knots.
        """
        path = motion.join_knots(case.angles, times, rates)
        duration = times[-1]
        floors = self._floors(jnp.minimum(rows[:, 0], rows[:, 1 + goal]))
        fastest = jnp.max(jnp.sqrt(jnp.sum(rates**2, axis=1)))
        violation = 100.0 * jnp.maximum(-self._least_excess(case, floors, path, fastest), 0.0)
        violation = jnp.where(jnp.isfinite(duration * fastest), violation, jnp.inf)
        return ReachPlan(
            motion=path,
            goal=goal.astype(jnp.int32),
            cost=duration,
            violation=violation,
            iterations=jnp.zeros((), jnp.int32),
            status=status_of(duration, violation, violation > FEASIBILITY_TOLERANCE),
        )

    def _least_excess(
        self, case: ReachCase, floors: Array, path: PiecewisePolynomial, fastest: Array
    ) -> Array:
        """Return the least excess [m] of a pair's distance over its required distance.

        It is -inf if a joint exceeds its limits of angle. The check ends at the first collision.
        """
        duration = total_duration(path)
        count = jnp.maximum(jnp.ceil(duration * fastest / _TURN), 1.0)

        def check(state: tuple[Array, Array]) -> tuple[Array, Array]:
            done, least = state
            share = jnp.minimum(done + jnp.arange(_CHUNK, dtype=done.dtype), count) / count
            angles = jax.vmap(lambda share: evaluate(path, share * duration))(share)
            near = jnp.min(clearances(case.arm, case.scene, angles) - floors[:, None])
            beyond = jnp.any(
                (angles < case.arm.lower[None] - 1e-4) | (angles > case.arm.upper[None] + 1e-4)
            )
            return done + _CHUNK, jnp.minimum(least, jnp.where(beyond, -jnp.inf, near))

        def is_open(state: tuple[Array, Array]) -> Array:
            return (state[0] <= count) & (state[1] >= 0.0)

        first = (jnp.zeros_like(count), jnp.full_like(count, jnp.inf))
        return lax.while_loop(is_open, check, first)[1]

    def _stand_still(self, case: ReachCase) -> ReachPlan:
        num, dtype = case.angles.shape[0], case.angles.dtype
        none = jnp.full((), jnp.inf, dtype)
        path = motion.join_knots(
            case.angles,
            jnp.linspace(0.0, 1.0, self.pieces + 1, dtype=dtype),
            jnp.zeros((self.pieces + 1, num), dtype),
        )
        return ReachPlan(
            motion=path,
            goal=jnp.zeros((), jnp.int32),
            cost=none,
            violation=none,
            iterations=jnp.zeros((), jnp.int32),
            status=jnp.full((), Status.INFEASIBLE, jnp.int32),
        )


def _finite_bounds(case: ReachCase, lever: Array) -> tuple[Array, Array]:
    """Return bounds of random joint angles, times levers: at most one turn around the start."""
    lower = jnp.maximum(case.arm.lower, case.angles - 2.0 * jnp.pi)
    upper = jnp.minimum(case.arm.upper, case.angles + 2.0 * jnp.pi)
    return lower * lever, upper * lever


def _levers(arm: Arm) -> Array:
    """Return bounds (n,) [m] of the distances of the arm's parts from each joint's axis."""
    steps = jnp.sqrt(jnp.sum(arm.origin**2, axis=1))
    link = np.asarray(arm.capsule_link)
    outer = jnp.sqrt(jnp.max(jnp.sum(arm.capsule_ends**2, axis=2), axis=1)) + arm.capsule_radius
    edges = jnp.sqrt(jnp.sum(arm.shield_centre**2)) + jnp.sqrt(jnp.sum(arm.shield_half**2))
    levers, beyond = [], edges
    for k in reversed(range(arm.num)):
        own = np.flatnonzero(link == k)
        beyond = jnp.max(jnp.append(outer[own], beyond))
        levers.append(beyond)
        beyond = beyond + steps[k]
    return jnp.stack(levers[::-1])
