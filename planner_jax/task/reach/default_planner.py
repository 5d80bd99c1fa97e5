"""The planner of joint motions: the fastest motion if it is free, else a path and shortcuts.

The planner first checks the fastest motion and the straight motion to each goal. If none is free of
collisions, RRT-Connect finds a path. The arm could follow the path and stop at its corners. Random
shortcuts in time then remove the stops and make the motion fast.
"""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.compiled import place_numbers, with_run_time_numbers
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import (
    FEASIBILITY_TOLERANCE,
    BaseAttempt,
    Plan,
    Status,
    is_solved,
    require_settings,
    select,
    status_of,
)
from planner_jax.core.shapes import fit_resident, next_size, on_host, resize
from planner_jax.robot.arm import ArmLimits, ArmPlan
from planner_jax.robot.arm_clearance import clearances
from planner_jax.robot.arm_dynamics import measure_torques, stretch
from planner_jax.robot.scene_sizes import fit_scene
from planner_jax.task.reach import motion, shortcut, tree
from planner_jax.task.reach.case import ReachCase
from planner_jax.task.reach.check import finite_bounds, floors_of, least_excess, levers

if TYPE_CHECKING:
    from planner_jax.task.reach.closed_form import ClosedReach

# Distances [m] between states of a motion that are checked: of plans, and of motions that shortcuts
# make faster. If the coarse distance misses a collision, the shortcuts are repeated with the other.
_RESOLUTION, _COARSE = 0.02, 0.04
_TORQUES = 256  # number of times, besides the ends of pieces, at which torques are computed
_GOALS = (1, 8, 64)  # numbers of goals
_CUTS = 30  # number of attempts to shorten a path


@struct.dataclass
class ReachPlan(ArmPlan):
    """The plan of a motion from standstill to standstill, or a batch of plans.

    Attributes:
        goal: () int32, index of the goal at which the motion ends.
    """

    goal: Array


@dataclasses.dataclass(frozen=True)
class Search(BaseAttempt):
    """An attempt: check the fastest and the straight motion to each goal."""

    def is_due(self, plans: Plan) -> Array:
        """Return which plans need this search, bool: no search reaches a goal beyond the limits."""
        return super().is_due(plans) & (plans.status != Status.OUT_OF_REACH)


@with_run_time_numbers("rays", "shortcuts", "seed")
@dataclasses.dataclass(frozen=True)
class TreeSearch(Search):
    """An attempt: find a path by RRT-Connect, and make the motion along it faster."""

    rays: int = 1000  # greatest number of attempts to grow a tree of joint states
    shortcuts: int = 300  # number of attempts to make the motion faster
    seed: int = 0  # of the random states and shortcuts


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ReachPlanner(Planner):
    """Planner of arm motions from standstill to standstill; cost: the duration [s].

    Attributes:
        pieces: greatest number of pieces of a motion.
        capacity: greatest number of states of a tree.
        margin: [m], distance from obstacles, if start and goal have twice as much.
        slack: fraction of every limit of rates and accelerations that is left unused.
        searches: searches in their order; each tries the cases that earlier ones left unsolved.
    """

    case_type: ClassVar[type] = ReachCase
    plan_type: ClassVar[type] = ReachPlan
    is_sequential: ClassVar[bool] = True
    pieces: int = 96
    capacity: int = 8192
    margin: float = 0.002
    slack: float = 1e-4
    searches: tuple[Search, ...] = (
        Search(),
        TreeSearch(),
        TreeSearch(rays=2000, seed=1),
        TreeSearch(rays=4000, seed=2),
        TreeSearch(rays=8000, seed=3),
        TreeSearch(rays=16000, seed=4),
        TreeSearch(rays=16000, seed=5),
        TreeSearch(rays=16000, seed=6),
    )

    def __post_init__(self) -> None:
        require_settings(self)

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches for a plan, in the order in which they are tried."""
        return self.searches

    def fit_shapes(self, cases: ReachCase) -> ReachCase:
        """Return cases with the same plans, whose goals and scene are padded to few shapes.

        Added goals are beyond the limits of the joints, so that no search tries them.
        """
        return fit_resident(_fit_case, cases)

    def load_attempt(self, attempt: Search, cases: ReachCase) -> Search:
        """Return a search whose numbers are arrays, so that searches of a class share a program."""
        if isinstance(attempt, TreeSearch):
            return place_numbers(attempt)
        return super().load_attempt(attempt, cases)

    def solve(self, case: ReachCase, attempt: Search) -> ReachPlan:
        """Return the plan of one case by one search."""
        attempt = getattr(attempt, "attempt", attempt)
        limits = self.strict_limits(case)
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
        times = jax.vmap(lambda goal: jnp.sum(motion.quickest_knots(case.angles, goal, limits)[0]))(
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
            knots = jax.tree.map(lambda a, b: jnp.where(k < num, a, b), *both)
            return k + 1, select(self.finish(case, rows, index, *knots), best)

        def is_open(state: tuple[Array, ReachPlan]) -> Array:
            return (state[0] < 2 * num) & ~is_solved(state[1].status)

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
        floors = floors_of(ends, self.margin)[:, None]

        # The trees measure a turn by the greatest distance by which it can move a part of the arm.
        lever = levers(case.arm)

        def is_free(turned: Array) -> Array:
            return jnp.all(clearances(case.arm, case.scene, turned / lever[None]) >= floors, axis=0)

        # Goals that cannot be reached are replaced by the nearest one that can.
        goals = case.goals[order]
        goals = jnp.where((jnp.arange(goals.shape[0]) < num)[:, None], goals, goals[:1])
        points, is_found, rays = tree.find_path(
            is_free,
            case.angles * lever,
            goals * lever[None],
            finite_bounds(case, lever),
            attempt.rays,
            attempt.seed,
            self.capacity,
        )

        def follow() -> ReachPlan:
            path = tree.shorten(is_free, points, _CUTS, attempt.seed) / lever[None]
            goal = jnp.argmin(jnp.sum((case.goals - path[-1][None]) ** 2, axis=1))
            own = floors_of(jnp.minimum(rows[:, 0], rows[:, 1 + goal]), self.margin)
            stops = motion.stop_at_corners(path, case.limits, self.pieces)

            def try_next(state: tuple[Array, ReachPlan]) -> tuple[Array, ReachPlan]:
                k, best = state
                resolution = jnp.where(k == 0, _COARSE, _RESOLUTION)
                fast = shortcut.hasten(
                    lambda path: least_excess(case, own, path, resolution) >= 0.0,
                    case.angles,
                    stops,
                    case.limits,
                    jnp.where(k < 2, attempt.shortcuts, 0),
                    attempt.seed,
                )
                return k + 1, select(self.finish(case, rows, goal, *fast), best)

            def is_open(state: tuple[Array, ReachPlan]) -> Array:
                return (state[0] < 3) & ~is_solved(state[1].status)

            first = (jnp.zeros((), jnp.int32), self._stand_still(case))
            return lax.while_loop(is_open, try_next, first)[1]

        plan = lax.cond(is_found, follow, lambda: self._stand_still(case))
        return dataclasses.replace(plan, iterations=plan.iterations + rays)

    def finish(
        self, case: ReachCase, rows: Array, goal: Array, durations: Array, rates: Array
    ) -> ReachPlan:
        """Return the plan of a motion with these knots, and check it for collisions.

        A motion that exceeds a limit of torque is slowed down until it keeps the limit.

        Args:
            case: the case.
            rows: (R, 1 + G) [m], distances of R pairs of bodies at the start and at the goals.
            goal: () index of the motion's goal.
            durations: (M,) [s], of the pieces.
            rates: (M + 1, n) [rad/s], joint rates at the knots.
        """
        path = motion.join_knots(case.angles, durations, rates)
        weak = None
        if case.limits.torque is not None:
            _, factor, weak = measure_torques(case.arm, case.limits, case.gravity, path, _TORQUES)
            path = stretch(path, factor)
        duration = jnp.sum(path.durations)
        floors = floors_of(jnp.minimum(rows[:, 0], rows[:, 1 + goal]), self.margin)
        violation = 100.0 * jnp.maximum(-least_excess(case, floors, path, _RESOLUTION), 0.0)
        violation = violation if weak is None else jnp.maximum(violation, weak)
        violation = jnp.where(jnp.isfinite(duration + jnp.sum(rates)), violation, jnp.inf)
        return ReachPlan(
            motion=path,
            goal=goal.astype(jnp.int32),
            cost=duration,
            violation=violation,
            iterations=jnp.zeros((), jnp.int32),
            status=status_of(duration, violation, violation > FEASIBILITY_TOLERANCE),
        )

    def strict_limits(self, case: ReachCase) -> ArmLimits:
        """Return the limits of a case, reduced by the fraction `slack`; plans keep these limits."""
        return jax.tree.map(lambda each: each * (1.0 - self.slack), case.limits)

    def smooth(self) -> "ClosedReach":
        """Return the problem whose minima are this planner's fastest and straight motions."""
        from planner_jax.task.reach.closed_form import ClosedReach  # few plans need it

        return ClosedReach(self)

    def _stand_still(self, case: ReachCase) -> ReachPlan:
        num, dtype = case.angles.shape[0], case.angles.dtype
        none = jnp.full((), jnp.inf, dtype)
        path = motion.join_knots(
            case.angles,
            jnp.full(self.pieces, 1.0 / self.pieces, dtype),
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


def _fit_case(case: ReachCase) -> ReachCase:
    batch = case.batch_shape
    scene, num = fit_scene(case.scene, batch), case.goals.shape[-2]
    size = next_size(num, _GOALS)
    if size == num:
        return case if scene is case.scene else dataclasses.replace(case, scene=scene)
    upper, goals = (on_host(each, batch) for each in (case.arm.upper, case.goals))
    beyond = (upper + np.maximum(abs(upper), 1.0))[..., None, :]
    return dataclasses.replace(case, goals=resize(goals, -2, size, beyond), scene=scene)
