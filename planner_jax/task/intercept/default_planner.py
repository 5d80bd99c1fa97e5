"""The default planner: a reach set in space and time, random paths through it, least squares.

[Qu2022] plans a path among the walls and then a speed along it among the movers; where the path
crosses a mover that stays on it, no speed helps. Here path and speed are planned together. A reach
set of cells (`plane.reach`) says what the car can reach and when. Levenberg-Marquardt on speed and
curvature at knots (`problem`) starts from random paths through the set. It runs in stages: a motion
that follows the cells, for speeds and turns of cells alone drift through walls; a motion that keeps
every limit; and, once one does, a motion of less effort, or an earlier one.
"""

import dataclasses
from collections.abc import Callable
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
from jax import Array, lax

from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import (
    Status,
    index_of_best,
    is_solved,
    require_attempts,
    require_settings,
    select,
)
from planner_jax.plane.cell_paths import Chance
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan, explain, make_straight_plan
from planner_jax.task.intercept.problem import (
    BegunCase,
    Guess,
    MotionProblem,
    SmoothIntercept,
    add_start,
)
from planner_jax.task.intercept.replan import ReplanIntercept
from planner_jax.task.intercept.searches import (
    BEST,
    QUICK,
    SEARCHES,
    Found,
    Search,
    draw_cell_path,
    make_grid,
    search_reach,
)

_SPREAD = 2  # layers from the earliest one on at which paths to the earliest meeting end


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SpacetimeIntercept(Planner[InterceptCase, InterceptPlan]):
    """Meets the target at the case's time, or earlier.

    `meet` says when: at the "given" time, as "early" as possible until then, or at the time until
    then which takes the "least" effort, the integral of the squared acceleration. A plan's cost
    is the meeting time of the early ones [s], and the effort of the others [m^2/s^3].
    """

    case_type: ClassVar[type] = InterceptCase
    is_sequential: ClassVar[bool] = True
    meet: Literal["given", "early", "least"] = "given"
    pieces: int = 32  # of speed and curvature
    samples: int = 3  # of each piece, at which obstacles are checked
    checked: int = 10  # samples of each piece of the plan that is returned
    # Whether all paths of a search are tried and the best one is selected; always if the time is
    # free.
    tries_all: bool = False
    searches: tuple[Search, ...] | None = None  # by default those that suit `meet`

    def __post_init__(self) -> None:
        require_settings(self)
        if self.searches is not None:
            require_attempts("searches", self.searches, Search)
        if self.meet not in ("given", "early", "least"):
            raise ArgumentError("meet", "given, early or least", self.meet)

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches."""
        return self.searches or SEARCHES[self.meet]

    @property
    def problem(self) -> MotionProblem:
        """The least-squares problem."""
        return MotionProblem(self.meet, self.pieces, self.samples, self.checked)

    def replanner(self) -> ReplanIntercept:
        """Return the planner that continues from a plan that is being driven; see `pj.replan`."""
        return ReplanIntercept(self, self.attempts[0], self.problem)

    def smooth_near(
        self, cases: InterceptCase, plans: InterceptPlan
    ) -> tuple[SmoothIntercept, BegunCase]:
        """Return the planner that minimises the cost from plans on, and the cases with the plans.

        `pj.gradient` and `pj.optimal_plan` use them.
        """
        problem = self.problem
        start = problem.pack(plans.speed[..., 1:], plans.curvature[..., 1:], plans.time)
        return SmoothIntercept(problem), add_start(cases, start)

    def settle(
        self,
        cases: InterceptCase,
        plan_of: Callable[[Planner, InterceptCase], InterceptPlan] | None = None,
    ) -> tuple[SmoothIntercept, BegunCase]:
        """Return `smooth_near` of plans; by default of the plan of the first search."""
        if plan_of is None:
            plans = self.solve(lax.stop_gradient(cases), self.attempts[0])
        else:
            plans = plan_of(self, cases)
        return self.smooth_near(cases, plans)

    def solve(self, case: InterceptCase, attempt: Search) -> InterceptPlan:
        """Return the plan of one case: path after path is tried until one keeps every limit.

        With `tries_all`, or if the meeting time is free, all are tried, and the best is selected.
        """
        found = search_reach(case, attempt, is_time_free=self.problem.is_time_free)
        chances = attempt.draw_chances()
        num = jnp.where(found.is_reached, attempt.ways, 0)

        def try_path(state: tuple) -> tuple:
            k, best = state
            chance = jax.tree.map(lambda leaf: leaf[k], chances)
            return k + 1, select(self._solve_along(case, found, chance, attempt), best)

        def is_open(state: tuple) -> Array:
            k, best = state
            tries_all = self.tries_all or self.problem.is_time_free
            return (k < num) & (tries_all | ~is_solved(best.status))

        _, best = lax.while_loop(is_open, try_path, (0, make_straight_plan(case, self.pieces)))
        return self._explain(case, attempt, found, best)

    def solve_at_once(self, cases: InterceptCase, attempt: Search) -> InterceptPlan:
        """Return the plans of a batch: all paths of all cases together, the best one of each."""
        # All compute as many layers as the case with the most, so that they stay in step.
        layers = jnp.max(jax.vmap(lambda case: make_grid(case, attempt.lattice).num)(cases))
        return jax.vmap(lambda case: self._solve_all_paths(case, attempt, layers))(cases)

    def _solve_all_paths(
        self, case: InterceptCase, attempt: Search, layers: Array
    ) -> InterceptPlan:
        """Try all paths of one case together, and run the last stage for the best one alone.

        With `tries_all` the last stage runs for all of them.
        """
        problem = self.problem
        found = search_reach(case, attempt, is_time_free=problem.is_time_free, layers=layers)

        def solve_without_last_stage(chance: Chance) -> InterceptPlan:
            guess = self._guess(case, found, chance, attempt)
            stages = problem.list_stages(attempt)[:-1]
            points, steps = problem.run_stages(case, found.field, guess, attempt, stages)
            return problem.decode(case, points[-1], steps)

        def solve_along(chance: Chance) -> InterceptPlan:
            return self._solve_along(case, found, chance, attempt)

        solve = solve_along if self.tries_all else solve_without_last_stage
        plans = jax.vmap(solve)(attempt.draw_chances())
        best = index_of_best(plans)
        plan = jax.tree.map(lambda leaf: leaf[best], plans)
        if not self.tries_all:
            plan = problem.refine_solved(case, found.field, plan, attempt)
        return self._explain(case, attempt, found, plan)

    def _solve_along(
        self, case: InterceptCase, found: Found, chance: Chance, attempt: Search
    ) -> InterceptPlan:
        """Return the plan that one random path leads to, after all stages."""
        guess = self._guess(case, found, chance, attempt)
        stages = self.problem.list_stages(attempt)
        return self.problem.refine(case, found.field, guess, attempt, stages)

    def _guess(self, case: InterceptCase, found: Found, chance: Chance, attempt: Search) -> Guess:
        """Draw a random path to one of the first layers that reach the target, or to any layer."""
        layer = found.grid.num
        if self.problem.is_time_free:
            allowed = found.layers
            if self.meet == "early":
                allowed &= jnp.cumsum(found.layers) <= _SPREAD
            layer = jnp.argmax(jnp.where(allowed, chance.layers, -jnp.inf))
        path = draw_cell_path(case, found, layer, chance, attempt.directness)
        return self.problem.guess_along(case, found.grid, path, layer)

    def _explain(
        self, case: InterceptCase, attempt: Search, found: Found, plan: InterceptPlan
    ) -> InterceptPlan:
        """Set the status of an unsolved plan to the reason why there is none."""
        reason = plan.status
        if attempt == self.attempts[-1]:
            reason = jnp.where(found.is_reached, reason, Status.NO_PATH)
        return explain(case, reason, plan, is_time_free=self.problem.is_time_free)


def quick(**fields: object) -> SpacetimeIntercept:
    """Make a `SpacetimeIntercept` with fewer paths and steps, for meetings at the case's time."""
    return SpacetimeIntercept(**{"searches": QUICK, **fields})


def best(**fields: object) -> SpacetimeIntercept:
    """Make a `SpacetimeIntercept` with more paths and steps that selects the least effort."""
    return SpacetimeIntercept(**{"searches": BEST, "tries_all": True, **fields})
