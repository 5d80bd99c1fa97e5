"""The planner of joint motions: the fastest motion if it is free, else a path and shortcuts.

The planner first checks the fastest motion and the straight motion to each goal. If none is free of
collisions, RRT-Connect finds a path. The arm could follow the path and stop at its corners. Random
shortcuts in time then remove the stops and make the motion fast.
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
    BaseAttempt,
    Plan,
    Status,
    is_solved,
    require_settings,
    select,
    status_of,
)
from planner_jax.robot.arm import Arm, ArmPlan
from planner_jax.robot.arm_clearance import clearances
from planner_jax.robot.arm_dynamics import measure_torques, stretch
from planner_jax.task.reach import motion, shortcut, tree
from planner_jax.task.reach.case import ReachCase
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

# Distances [m] between states of a motion that are checked: of plans, and of motions that shortcuts
# make faster. If the coarse distance misses a collision, the shortcuts are repeated with the other.
_RESOLUTION, _COARSE = 0.02, 0.04
_CHUNK = 16  # number of states that are checked together
_TORQUES = 256  # number of times, besides the ends of pieces, at which torques are computed
_CUTS = 30  # number of attempts to shorten a path


@struct.dataclass
class ReachPlan(ArmPlan):
    """The plan of a motion from standstill to standstill, or a batch of plans."""

    goal: Array  # () int32, index of the goal at which the motion ends


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
    """Planner of arm motions from standstill to standstill; cost: the duration [s]."""

    case_type: ClassVar[type] = ReachCase
    plan_type: ClassVar[type] = ReachPlan
    is_sequential: ClassVar[bool] = True
    pieces: int = 96  # greatest number of pieces of a motion
    capacity: int = 8192  # greatest number of states of a tree
    margin: float = 0.002  # [m], distance from obstacles, if start and goal have twice as much
    slack: float = 1e-4  # fraction of every limit of rates and accelerations that is left unused
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

    def load_attempt(self, attempt: Search, cases: ReachCase) -> Search:
        """Return a search whose numbers are arrays, so that searches of a class share a program."""
        if isinstance(attempt, TreeSearch):
            return place_numbers(attempt)
        return super().load_attempt(attempt, cases)

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
            own = self._floors(jnp.minimum(rows[:, 0], rows[:, 1 + goal]))
            stops = self._stop_at_corners(case, path)

            def try_next(state: tuple[Array, ReachPlan]) -> tuple[Array, ReachPlan]:
                k, best = state
                resolution = jnp.where(k == 0, _COARSE, _RESOLUTION)
                fast = shortcut.hasten(
                    lambda path: self._least_excess(case, own, path, resolution) >= 0.0,
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

    def _floors(self, ends: Array) -> Array:
        """Return the distance (R,) [m] that each pair keeps, by its distance (R,) at the ends."""
        return jnp.clip(0.5 * ends, 0.0, self.margin)

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
        floors = self._floors(jnp.minimum(rows[:, 0], rows[:, 1 + goal]))
        violation = 100.0 * jnp.maximum(-self._least_excess(case, floors, path, _RESOLUTION), 0.0)
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

    def _least_excess(
        self,
        case: ReachCase,
        floors: Array,
        path: PiecewisePolynomial,
        resolution: Array | float,
    ) -> Array:
        """Return the least excess [m] of a pair's distance over its required distance.

        It is -inf if a joint exceeds its limits of angle. Each chunk of states covers the motion,
        and the check ends after the first chunk with a collision. The offsets of successive chunks
        follow the golden ratio, so that the first chunks leave no wide gaps.
        """
        rates = path.coeffs[:, 1]
        last = rates[-1:] + 2.0 * path.durations[-1] * path.coeffs[-1:, 2]
        speed = jnp.concatenate([rates, last]) * _levers(case.arm)[None]
        speed = jnp.sqrt(jnp.sum(speed**2, axis=1))
        # Bounds of the distances from the start to the ends of the pieces.
        passed = jnp.cumsum(path.durations * jnp.maximum(speed[1:], speed[:-1]))
        passed, ends = (jnp.append(0.0, each) for each in (passed, jnp.cumsum(path.durations)))
        chunks = jnp.maximum(jnp.ceil(passed[-1] / (resolution * _CHUNK)), 1.0)
        num, lane = chunks.astype(jnp.int32), jnp.arange(_CHUNK, dtype=chunks.dtype)
        # The step between offsets has no common divisor with their number.
        steps = (0.618 * chunks).astype(jnp.int32) + jnp.arange(1, 9, dtype=jnp.int32)
        step = steps[jnp.argmax(jnp.gcd(steps, num) == 1)]

        def check(state: tuple[Array, Array]) -> tuple[Array, Array]:
            done, least = state
            offset = (done * step % num).astype(chunks.dtype)
            share = (lane * chunks + offset + 0.5) / (chunks * _CHUNK)
            times = jnp.interp(share * passed[-1], passed, ends)
            angles = jax.vmap(lambda time: evaluate(path, time))(times)
            near = jnp.min(clearances(case.arm, case.scene, angles) - floors[:, None])
            beyond = jnp.any(
                (angles < case.arm.lower[None] - 1e-4) | (angles > case.arm.upper[None] + 1e-4)
            )
            return done + 1, jnp.minimum(least, jnp.where(beyond, -jnp.inf, near))

        def is_open(state: tuple[Array, Array]) -> Array:
            return (state[0] < num) & (state[1] >= 0.0)

        first = (jnp.zeros_like(num), jnp.full_like(floors[0], jnp.inf))
        return lax.while_loop(is_open, check, first)[1]

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
