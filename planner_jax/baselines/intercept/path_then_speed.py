"""Planners that first find a path and then a speed along it [Qu2022].

If an obstacle stays on the path, no speed along the path avoids it. These planners therefore try
several paths that pass the standing obstacles on different sides.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.baselines.intercept.path import Path
from planner_jax.baselines.intercept.projection import Projection, station_time_problem
from planner_jax.baselines.intercept.speed import SPEED_PLANNERS, SpeedPlanner, plan_speed
from planner_jax.baselines.intercept.static_paths import PathSource, StaticPaths
from planner_jax.baselines.intercept.station_time import StationTimeProblem, reference_line
from planner_jax.core.choices import require_size
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Status, is_solved, require_settings
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan, explain, make_plan
from planner_jax.task.intercept.searches import Search, make_grid


@dataclasses.dataclass(frozen=True)
class SpeedStep:
    """Settings of the speed step, which all path sources share; static."""

    # None: constant speed, moving obstacles are ignored.
    speed: SpeedPlanner | None = dataclasses.replace(SPEED_PLANNERS["trapezoid"], pieces=20)
    projection: Projection = Projection()
    slack: float = 0.015  # fraction of every limit that stays unused
    pieces: int = 200  # number of pieces of the plan's speed and curvature
    checked: int = 2  # samples per piece at which distances from obstacles are computed

    def problem(self, case: InterceptCase, path: Path) -> StationTimeProblem:
        """Return the station-time problem of driving along a path."""
        return station_time_problem(
            path,
            case.movers,
            case.body,
            case.limits,
            case.time,
            case.speed,
            self.projection,
            self.slack,
        )

    def drive(self, case: InterceptCase, path: Path, problem: StationTimeProblem) -> InterceptPlan:
        """Return the plan along one path: the planned speed, with the curvature of the path."""
        times = jnp.linspace(0.0, 1.0, self.pieces + 1) * case.time
        if self.speed is None:
            station, speed = ramp_and_cruise(problem, times)
            is_found, steps = jnp.ones((), bool), jnp.zeros((), jnp.int32)
            status = jnp.full((), Status.CONVERGED, jnp.int32)
        else:
            found = plan_speed(problem, self.speed)
            station, speed = found.curve.at(times), found.curve.at(times, 1)
            is_found, steps, status = is_solved(found.status), found.iterations, found.status
        plan = make_plan(
            case,
            case.time,
            jnp.maximum(speed, 0.0).at[0].set(case.speed),
            path.curvature_at(station).at[0].set(case.curvature),
            samples=self.checked,
            points=2,
            steps=steps,
        )
        return dataclasses.replace(
            plan,
            status=jnp.where(is_found, plan.status, status),
            violation=jnp.where(is_found, plan.violation, jnp.inf),
        )


def ramp_and_cruise(problem: StationTimeProblem, times: Array) -> tuple[Array, Array]:
    """Return station [m] and speed [m/s] at times (M,) for a short ramp to a constant speed.

    The ramp has the greatest acceleration a. Its speed change d makes the car reach the end of the
    path at the horizon T if possible: the path length is v0 T + d T - d |d| / (2 a). [Qu2022]
    compares with constant speed (Fig. 4) and leaves out the ramp.
    """
    limit, horizon = problem.acceleration_limit, problem.horizon
    missing = problem.end_station - problem.initial_speed * horizon
    root = jnp.sqrt(jnp.maximum((limit * horizon) ** 2 - 2.0 * limit * jnp.abs(missing), 0.0))
    change = jnp.sign(missing) * (limit * horizon - root)
    ramp = jnp.abs(change) / limit
    passed = jnp.minimum(times, ramp)
    rise = jnp.sign(change) * limit
    station = problem.initial_speed * times + rise * passed * (times - 0.5 * passed)
    return station, problem.initial_speed + rise * passed


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class PathThenSpeed(Planner):
    """A planner that reaches the target at the case's time along the best of several paths."""

    case_type: ClassVar[type] = InterceptCase
    is_sequential: ClassVar[bool] = True
    source: PathSource = PathSource()
    step: SpeedStep = SpeedStep()
    # Number of paths that get a speed, ranked by the acceleration of their lines from dynamic
    # programming; None: all paths.
    tries: int | None = None
    searches: tuple[Search, ...] = (Search(8),)

    def __post_init__(self) -> None:
        require_settings(self)
        if self.tries is not None:
            require_size("tries", self.tries)

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches; `paths` of a search is their number."""
        return self.searches

    def solve(self, case: InterceptCase, attempt: Search) -> InterceptPlan:
        """Return the plan of one case: the best among all paths that get a speed."""
        return self.solve_in_layers(case, attempt, None)

    def solve_at_once(self, cases: InterceptCase, attempt: Search) -> InterceptPlan:
        """Return the plans of a batch, computed together."""
        # Every case uses the largest number of layers, so that all loops have the same length.
        layers = jnp.max(jax.vmap(lambda case: make_grid(case, attempt.lattice).num)(cases))
        return jax.vmap(lambda case: self.solve_in_layers(case, attempt, layers))(cases)

    def solve_in_layers(
        self, case: InterceptCase, attempt: Search, layers: Array | None
    ) -> InterceptPlan:
        """Return the plan of one case; `layers` () int32 sets the reach set's number of layers."""
        found = self.source.paths(case, attempt, layers)
        plan = self.best_drive(case, found)
        reason = jnp.where(found.is_reached, plan.status, Status.NO_PATH)
        return explain(case, reason, plan)

    def best_drive(self, case: InterceptCase, found: StaticPaths) -> InterceptPlan:
        """Return the plan of least acceleration along one of the paths.

        If no plan is solved, the plan with the smallest violation is returned.
        """
        problems = jax.vmap(lambda path: self.step.problem(case, path))(found.paths)
        paths, violation = found.paths, found.violation
        if self.tries is not None:
            order = self.rank_paths(problems, violation)[: self.tries]
            paths, problems = jax.tree.map(lambda leaf: leaf[order], (paths, problems))
        drives = jax.vmap(lambda path, problem: self.step.drive(case, path, problem))(
            paths, problems
        )
        return jax.tree.map(lambda leaf: leaf[best_of(drives)], drives)

    def rank_paths(self, problems: StationTimeProblem, violation: Array) -> Array:
        """Return the indices of the paths (P,), the most promising path first."""
        grid = (self.step.speed or SPEED_PLANNERS["trapezoid"]).grid
        lines = jax.vmap(lambda problem: reference_line(problem, grid))(problems)
        cost = jnp.where(lines.found, lines.cost, 1e6) + jnp.where(violation > 0.0, 1e3, 0.0)
        return jnp.argsort(cost)


def best_of(plans: InterceptPlan) -> Array:
    """Return the index of the best of several plans of one case.

    A solved plan of least cost is best, then the plan with the smallest violation. A plan without a
    line through the station-time graph is worse than a plan without a curve beside the line.
    """
    cost = jnp.where(is_solved(plans.status), plans.cost - 1e6, plans.violation)
    cost = jnp.where(jnp.isfinite(cost), cost, 1e6)
    return jnp.argmin(cost + jnp.where(plans.status == Status.NO_PATH, 1e6, 0.0))


def lattice(**fields: object) -> PathThenSpeed:
    """Create the planner of eight paths with curves in corridors; options are its fields."""
    return dataclasses.replace(PathThenSpeed(), **fields)


def em(**fields: object) -> PathThenSpeed:
    """Create the planner with the best path and the speed step of the EM planner.

    The speed step has the pieces and sample times of `lattice`; options are fields of the planner.
    """
    speed = dataclasses.replace(SPEED_PLANNERS["em"], pieces=20, samples=5)
    return PathThenSpeed(**{"tries": 1, "step": SpeedStep(speed=speed), **fields})


def constant(**fields: object) -> PathThenSpeed:
    """Create the planner that drives the best path at constant speed, ignoring movers.

    A short ramp from the initial speed comes first; options are fields of the planner.
    """
    return PathThenSpeed(**{"tries": 1, "step": SpeedStep(speed=None), **fields})
