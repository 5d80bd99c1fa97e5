"""The default planner of interceptions: a reach set in space and time, then least squares.

[Qu2022] plans a path among the walls, and then a speed along it among the moving obstacles. If such
an obstacle stays on the path, no speed avoids it. Here path and speed are planned together. The
unknowns are the car's speed and curvature at equally spaced times, found by Levenberg-Marquardt
(`problem`). The first starting point is the direct motion to the target. If it leads to no plan,
the others are random paths of cells through the reach set (`plane.reach`), which holds the cells of
the map in which the car can be at each time. The last search starts from motions of `state_paths`.
There are three stages:

1. follow the positions of the starting point;
2. keep every limit;
3. once every limit holds, reduce the discomfort, or meet the target earlier.

All numbers are in the units of the case (`units`).
"""

import dataclasses
import functools
from typing import ClassVar, Literal, Self

import jax
import jax.numpy as jnp
from jax import Array, lax

from planner_jax.core import protocol
from planner_jax.core.choices import EFFORTS, require, require_one_of
from planner_jax.core.decision import index_of_best
from planner_jax.core.planner import Planner
from planner_jax.core.shapes import fit_resident
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan, explain, make_straight_plan
from planner_jax.task.intercept.problem.motion_problem import Guess, MotionProblem
from planner_jax.task.intercept.problem.shapes import fit_case
from planner_jax.task.intercept.problem.smooth import SmoothIntercept
from planner_jax.task.intercept.replan import ReplanIntercept
from planner_jax.task.intercept.searches import (
    NARROW,
    QUICK,
    SEARCHES,
    LoadedSearch,
    Reachability,
    Search,
    choose_searches,
    draw_cell_path,
    load_search,
    make_field,
    make_grid,
    search_reach,
)
from planner_jax.task.intercept.state_paths import StatePaths, find_state_paths
from planner_jax.task.intercept.units import enter_units, leave_units, units_of

_EFFORTS = {"good": (8, 48), "best": (32, 96)}  # numbers of paths, and of steps of the last stage
_SPREAD = 2  # early paths end in one of the first two time layers that reach the target


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SpacetimeIntercept(Planner[InterceptCase, InterceptPlan]):
    """Planner of interceptions by least squares from random paths of reachable grid cells.

    `meet` selects the time of the meeting: "given" is the time of the case, "early" is as early as
    possible before it, and "least" is the time, up to the case's time, of the least discomfort. A
    plan's cost is the meeting time [s] if `meet` is "early", and else the discomfort [m^2/s^3] of
    `terms.limit_terms`.

    Attributes:
        meet: choice of the time of the meeting, see above.
        pieces: number of pieces of speed and curvature.
        samples: number of samples of each piece at which least squares check obstacles.
        checked: number of samples of each piece at which the finished plan is checked.
        searches: searches in their order; by default `SEARCHES[meet]`.
    """

    case_type: ClassVar[type] = InterceptCase
    is_sequential: ClassVar[bool] = True
    meet: Literal["given", "early", "least"] = "given"
    pieces: int = 32
    samples: int = 3
    checked: int = 16
    searches: tuple[Search, ...] | None = None

    def __post_init__(self) -> None:
        protocol.require_settings(self)
        if self.searches is not None:
            protocol.require_attempts("searches", self.searches, Search)
        is_known = isinstance(self.meet, str) and self.meet in ("given", "early", "least")
        require(is_known, "meet", "given, early or least", self.meet)

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches for a plan, in the order in which they are tried."""
        return self.searches or SEARCHES[self.meet]

    def attempts_for(self, cases: InterceptCase) -> tuple[Search, ...]:
        """Return the searches of `attempts` that the cases need."""
        return choose_searches(self.attempts, cases)

    def fit_shapes(self, cases: InterceptCase) -> InterceptCase:
        """Return cases with the same plans, padded to one of few shapes; see `fit_case`."""
        return fit_resident(fit_case, cases)

    @property
    def problem(self) -> MotionProblem:
        """The least-squares problem that every search solves."""
        return MotionProblem(self.meet, self.pieces, self.samples, self.checked)

    def with_effort(self, effort: str) -> Self:
        """Return a planner with one more search, which tries to lower the cost of every plan.

        Args:
            effort: "good" tries 8 paths, and takes up to 48 steps to reduce the cost of each plan.
                "best" tries 32 paths, takes up to 96 steps, and makes more searches for narrow
                passages. "feasible" returns the planner itself, which ends with the first plan.
        """
        require_one_of(EFFORTS, "effort", effort)
        if effort not in _EFFORTS:
            return self
        first, (paths, settling) = self.attempts[0], _EFFORTS[effort]
        paths = max(paths, first.paths)
        more = {"paths": paths, "settling": settling, "tries_all": True, "improves": True}
        last = dataclasses.replace(first, **more)
        searches = (*self.attempts, last, *(NARROW if effort == "best" else ()))
        return dataclasses.replace(self, searches=searches)

    def replanner(self) -> ReplanIntercept:
        """Return the planner by which `pj.replan` updates a plan while it is being driven."""
        return ReplanIntercept(self, self.attempts[0], self.problem)

    def smooth(self) -> SmoothIntercept:
        """Return the problem whose minima are near this planner's plans."""
        return SmoothIntercept(self.problem)

    def solve(self, case: InterceptCase, attempt: Search) -> InterceptPlan:
        """Plan one case by least squares from several starting points, up to the first solved plan.

        If the search tries all paths, the best plan is returned.
        """
        units = units_of(case)
        plan = self._solve(enter_units(case, units), self.load_attempt(attempt, case))
        return leave_units(plan, case, units, is_early=self.meet == "early")

    def _solve(self, case: InterceptCase, search: LoadedSearch) -> InterceptPlan:
        problem, is_free = self.problem, self.problem.is_time_free
        grid = make_grid(case, search.lattice, is_time_free=is_free)
        field, stages = make_field(case, grid), problem.list_stages(search)

        def find() -> Reachability | StatePaths:
            if search.states:
                return find_state_paths(case, search, grid, field, self.pieces)
            return search_reach(case, search, grid, field, is_time_free=is_free)

        def try_start(state: tuple) -> tuple:
            k, found, best = state
            # Start -1 is the direct motion. If it solves the case, nothing is searched.
            found = lax.cond(k == 0, find, lambda: found)

            directly = lambda: problem.guess_directly(case, search.is_late)  # noqa: E731
            guess = lax.cond(k < 0, directly, lambda: self._guess(case, found, k, search))
            plan = problem.refine(case, field, guess, search, stages)
            plan = self._select_guess(case, guess, search, plan)
            is_path = (k < 0) | found.is_reached
            return k + 1, found, protocol.select(plan, best, is_path)

        def is_open(state: tuple) -> Array:
            k, found, best = state
            is_enough = protocol.is_solved(best.status) & ~jnp.asarray(search.tries_all | is_free)
            return ((k <= 0) | ((k < search.paths) & found.is_reached)) & ~is_enough

        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(find))
        first = jnp.where(search.is_direct, -1, 0)
        unsolved = make_straight_plan(case, self.pieces)
        k, found, best = lax.while_loop(is_open, try_start, (first, nothing, unsolved))
        return self._explain(case, search, (k <= 0) | found.is_reached, best)

    def solve_at_once(self, cases: InterceptCase, attempt: Search) -> InterceptPlan:
        """Plan a batch: try all starting points together, select each case's best plan."""
        search, is_free = self.load_attempt(attempt, cases), self.problem.is_time_free
        units = jax.vmap(units_of)(cases)
        local = jax.vmap(enter_units)(cases, units)
        grids = jax.vmap(lambda case: make_grid(case, search.lattice, is_time_free=is_free))(local)
        layers = jnp.max(grids.num)
        plans = jax.vmap(lambda case: self._solve_all_paths(case, search, layers))(local)
        leave = functools.partial(leave_units, is_early=self.meet == "early")
        return jax.vmap(leave)(plans, cases, units)

    def _solve_all_paths(
        self, case: InterceptCase, attempt: LoadedSearch, layers: Array
    ) -> InterceptPlan:
        problem = self.problem
        is_free = problem.is_time_free
        grid = make_grid(case, attempt.lattice, is_time_free=is_free)
        field = make_field(case, grid)
        if attempt.states:
            found = find_state_paths(case, attempt, grid, field, self.pieces)
        else:
            found = search_reach(case, attempt, grid, field, is_time_free=is_free, layers=layers)

        # Either every plan runs the last stage, or only the best plan does.
        early, late = (
            dataclasses.replace(attempt, settling=jnp.where(is_due, attempt.settling, 0))
            for is_due in (attempt.tries_all, ~jnp.asarray(attempt.tries_all))
        )
        stages = problem.list_stages(early)

        def solve_from(guess: Guess) -> InterceptPlan:
            plan = problem.refine(case, field, guess, attempt, stages)
            return self._select_guess(case, guess, attempt, plan)

        each = jnp.arange(len(attempt.noise.layers))
        guesses = jax.vmap(lambda k: self._guess(case, found, k, attempt))(each)
        direct = problem.guess_directly(case, attempt.is_late)
        guesses = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), direct, guesses)
        plans = jax.vmap(solve_from)(guesses)
        best = index_of_best(plans)
        plan = jax.tree.map(lambda leaf: leaf[best], plans)
        plan = problem.refine_solved(case, field, plan, late)
        return self._explain(case, attempt, found.is_reached, plan)

    def load_attempt(self, attempt: Search, cases: InterceptCase) -> LoadedSearch:
        """Return the search `attempt` in the form of the second argument of the compiled `solve`.

        Its settings become arrays, so that on a CPU all searches of the planner with equal lattices
        share one program. Of the cases only the presence of a reverse gear is used.
        """
        if isinstance(attempt, LoadedSearch):
            return attempt
        attempts = self.attempts if attempt in self.attempts else (attempt,)
        is_apart = jax.default_backend() != "cpu"
        has_reverse = cases.limits.reverse_speed is not None
        return load_search(attempt, attempts, is_apart, has_reverse)

    def compiles_quickly(self, attempt: Search) -> bool:  # noqa: ARG002
        """Return true: the program for one case compiles in less time, and runs as fast."""
        return True

    def _guess(
        self, case: InterceptCase, found: Reachability | StatePaths, k: Array, attempt: LoadedSearch
    ) -> Guess:
        problem = self.problem
        if isinstance(found, StatePaths):
            return problem.guess_at(problem.pack(found.speed[k], found.curvature[k], case.time))
        layer, noise = found.grid.num, jax.tree.map(lambda leaf: leaf[k], attempt.noise)
        if problem.is_time_free:
            allowed = found.layers
            if self.meet == "early":
                allowed &= jnp.cumsum(found.layers) <= _SPREAD
            layer = jnp.argmax(jnp.where(allowed, noise.layers, -jnp.inf))
            numbers = jnp.arange(found.layers.size)
            latest = jnp.max(jnp.where(found.layers, numbers, 0))
            layer = jnp.where(attempt.is_late, latest, layer)
        path = draw_cell_path(case, found, layer, noise, attempt.directness)
        return problem.guess_along(case, found.grid, found.reach.speeds, path, layer)

    def _select_guess(
        self, case: InterceptCase, guess: Guess, attempt: LoadedSearch, plan: InterceptPlan
    ) -> InterceptPlan:
        """Return the better of a plan and its starting point, if this point is a whole motion."""
        if not attempt.states:
            return plan
        return protocol.select(plan, self.problem.decode(case, guess.point, plan.iterations))

    def _explain(
        self, case: InterceptCase, attempt: LoadedSearch, is_reached: Array, plan: InterceptPlan
    ) -> InterceptPlan:
        is_open = is_reached | ~attempt.is_last
        reason = jnp.where(is_open, plan.status, protocol.Status.NO_PATH)
        return explain(case, reason, plan, is_time_free=self.problem.is_time_free)


def quick(**fields: object) -> SpacetimeIntercept:
    """Make a fast `SpacetimeIntercept` with fewer paths and steps; `fields` set other fields."""
    return SpacetimeIntercept(**{"searches": QUICK, **fields})
