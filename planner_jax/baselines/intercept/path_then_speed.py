"""Planners that first find a path for a car, and then a speed along the path [Qu2022].

An obstacle that stays on a path cannot be avoided by a speed along this path. These planners
therefore try several paths, which pass the standing obstacles on different sides.
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
    """Settings of speed planning, the second step after the search for a path."""

    # The speed planner. With None the car drives at constant speed and ignores moving obstacles.
    speed: SpeedPlanner | None = dataclasses.replace(SPEED_PLANNERS["trapezoid"], pieces=20)
    projection: Projection = Projection()
    slack: float = 0.015  # fraction of every limit that stays unused
    pieces: int = 200  # number of pieces of the plan's speed and curvature
    checked: int = 2  # number of samples per piece at which obstacle distances are computed

    def problem(self, case: InterceptCase, path: Path) -> StationTimeProblem:
        """Return the problem of reaching a path's end at the case's time, past moving obstacles."""
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
        """Plan the speed along one path, and return the plan that follows this path."""
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
    """Return stations (M,) [m] and speeds (M,) [m/s] at M times: a ramp, then constant speed.

    A station is a distance along the path. During the ramp the car has its greatest acceleration a.
    The speed changes by d from v0, such that the car reaches the end of the path at the horizon T
    if possible: (path length) = v0 T + d T - d |d| / (2 a).
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
    """A planner that meets the target at the case's time, on the best of several paths."""

    case_type: ClassVar[type] = InterceptCase
    is_sequential: ClassVar[bool] = True
    source: PathSource = PathSource()
    step: SpeedStep = SpeedStep()
    # Number of paths for which a speed is planned; None for all paths. The paths on which dynamic
    # programming finds a drive with little acceleration are selected.
    tries: int | None = None
    searches: tuple[Search, ...] = (Search(8),)

    def __post_init__(self) -> None:
        require_settings(self)
        if self.tries is not None:
            require_size("tries", self.tries)

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches, each for a number `paths` of paths; unsolved cases get the next search."""
        return self.searches

    def solve(self, case: InterceptCase, attempt: Search) -> InterceptPlan:
        """Return the plan of one case: the best plan among all paths for which a speed exists."""
        return self.solve_in_layers(case, attempt, None)

    def solve_at_once(self, cases: InterceptCase, attempt: Search) -> InterceptPlan:
        """Return the plans of a batch, computed together with `vmap`."""
        # All cases search with the same number of time steps, so that all loops are equally long.
        grids = jax.vmap(lambda case: make_grid(case, attempt.lattice, is_time_free=True))(cases)
        layers = jnp.max(grids.num)
        return jax.vmap(lambda case: self.solve_in_layers(case, attempt, layers))(cases)

    def solve_in_layers(
        self, case: InterceptCase, attempt: Search, layers: Array | None
    ) -> InterceptPlan:
        """Return the plan of one case.

        `layers` () is the number of equal time steps of the search for paths, by default chosen for
        the case.
        """
        found = self.source.paths(case, attempt, layers)
        plan = self.best_drive(case, found)
        reason = jnp.where(found.is_reached, plan.status, Status.NO_PATH)
        return explain(case, reason, plan)

    def best_drive(self, case: InterceptCase, found: StaticPaths) -> InterceptPlan:
        """Return the plan of least acceleration along one of the paths `found`.

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
        """Return the indices (P,) of P paths, first those with a drive of little acceleration.

        Dynamic programming finds each path's drive past the moving obstacles. Paths with a
        `violation` (P,), the relative excess over a limit, above 0 come later, paths without a
        drive last.
        """
        grid = (self.step.speed or SPEED_PLANNERS["trapezoid"]).grid
        lines = jax.vmap(lambda problem: reference_line(problem, grid))(problems)
        cost = jnp.where(lines.found, lines.cost, 1e6) + jnp.where(violation > 0.0, 1e3, 0.0)
        return jnp.argsort(cost)


def best_of(plans: InterceptPlan) -> Array:
    """Return the index of the best of several plans of one case.

    The best plan is the solved plan of least cost, or else the plan with the smallest violation.
    Plans with the status NO_PATH come last.
    """
    cost = jnp.where(is_solved(plans.status), plans.cost - 1e6, plans.violation)
    cost = jnp.where(jnp.isfinite(cost), cost, 1e6)
    return jnp.argmin(cost + jnp.where(plans.status == Status.NO_PATH, 1e6, 0.0))


def lattice(**fields: object) -> PathThenSpeed:
    """Create the planner `lattice`: it searches eight paths, and plans a speed along each of them.

    The paths lead through a lattice of cells in the plane. The cheapest solved plan is returned.
    `fields` are fields of the planner that replace defaults.
    """
    return dataclasses.replace(PathThenSpeed(), **fields)


def em(**fields: object) -> PathThenSpeed:
    """Create the planner `em`: one of eight searched paths, with the speed planner of [Fan2018].

    Dynamic programming over time and distance finds a drive past the moving obstacles along each
    path; the path of least acceleration is selected. The speed has 20 polynomial pieces, whose
    bounds hold at 5 samples each. `fields` are fields of the planner that replace defaults.
    """
    speed = dataclasses.replace(SPEED_PLANNERS["em"], pieces=20, samples=5)
    return PathThenSpeed(**{"tries": 1, "step": SpeedStep(speed=speed), **fields})


def constant(**fields: object) -> PathThenSpeed:
    """Create a planner that ignores moving obstacles and drives at constant speed after a ramp.

    The speed lets the car arrive in time on one of eight searched paths. `fields` are fields of the
    planner that replace defaults.
    """
    return PathThenSpeed(**{"tries": 1, "step": SpeedStep(speed=None), **fields})
