"""Planners that split path and speed [Qu2022]: a path among what stands, then a speed along it.

Where a path crosses something that stays on it no speed helps, which is what the split loses. So
several paths are tried, each another way round what stands.
"""

import dataclasses
from typing import ClassVar, Literal

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
    """Sizes of the second half, which all sources of paths share; static."""

    # None drives with constant speed, whatever moves.
    speed: SpeedPlanner | None = dataclasses.replace(SPEED_PLANNERS["trapezoid"], pieces=20)
    projection: Projection = Projection()
    slack: float = 0.015  # share of every limit that is kept free
    pieces: int = 200  # of the plan's speed and curvature
    checked: int = 2  # samples of each, where obstacles are looked at

    def problem(self, case: InterceptCase, path: Path) -> StationTimeProblem:
        """The problem of driving along a path."""
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
        """The plan of one path: its speed, and the curvature that the path has there."""
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
    """Station [m] and speed [m/s] at times (M,) with the shortest ramp to a constant speed.

    The ramp has the greatest acceleration, and the car is at the end of the way in time if it can
    be: with a change of speed d the way is v0 T + d T - d |d| / (2 a). [Qu2022] compares with
    constant speed (its Fig. 4), and leaves out how the car comes by it.
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
    """Meets the target at the case's time along one of several paths among what stands."""

    case_type: ClassVar[type] = InterceptCase
    is_sequential: ClassVar[bool] = True
    source: PathSource = PathSource()
    step: SpeedStep = SpeedStep()
    # How many paths get a speed, those first through which dynamic programming finds the line of
    # least acceleration; None: all.
    tries: int | None = None
    searches: tuple[Search, ...] = (Search(8),)

    def __post_init__(self) -> None:
        require_settings(self)
        if self.tries is not None:
            require_size("tries", self.tries)

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches; their ways are paths."""
        return self.searches

    def solve(self, case: InterceptCase, attempt: Search) -> InterceptPlan:
        """The plan of one case: of all paths that got a speed, the best."""
        return self.solve_in_layers(case, attempt, None)

    def solve_at_once(self, cases: InterceptCase, attempt: Search) -> InterceptPlan:
        """The plans of a batch, all together."""
        # All go through as many layers as the one with the most, so that they stay in step.
        layers = jnp.max(jax.vmap(lambda case: make_grid(case, attempt.lattice).num)(cases))
        return jax.vmap(lambda case: self.solve_in_layers(case, attempt, layers))(cases)

    def solve_in_layers(
        self, case: InterceptCase, attempt: Search, layers: Array | None
    ) -> InterceptPlan:
        """The plan of one case, of a reach set of so many layers."""
        found = self.source.paths(case, attempt, layers)
        plan = self.best_drive(case, found)
        reason = jnp.where(found.is_reached, plan.status, Status.NO_PATH)
        return explain(case, reason, plan)

    def best_drive(self, case: InterceptCase, found: StaticPaths) -> InterceptPlan:
        """The plan of least acceleration along one of the paths; without any the least bad."""
        problems = jax.vmap(lambda path: self.step.problem(case, path))(found.paths)
        paths, violation = found.paths, found.violation
        if self.tries is not None:
            order = self.ranked(problems, violation)[: self.tries]
            paths, problems = jax.tree.map(lambda leaf: leaf[order], (paths, problems))
        drives = jax.vmap(lambda path, problem: self.step.drive(case, path, problem))(
            paths, problems
        )
        return jax.tree.map(lambda leaf: leaf[best_of(drives)], drives)

    def ranked(self, problems: StationTimeProblem, violation: Array) -> Array:
        """Places of paths (P,), the best first."""
        grid = (self.step.speed or SPEED_PLANNERS["trapezoid"]).grid
        lines = jax.vmap(lambda problem: reference_line(problem, grid))(problems)
        cost = jnp.where(lines.found, lines.cost, 1e6) + jnp.where(violation > 0.0, 1e3, 0.0)
        return jnp.argsort(cost)


def best_of(plans: InterceptPlan) -> Array:
    """Place of the best of some plans of one case: solved with the least cost, else violated least.

    A plan without a line through the graph is worse than one without a curve along it.
    """
    cost = jnp.where(is_solved(plans.status), plans.cost - 1e6, plans.violation)
    cost = jnp.where(jnp.isfinite(cost), cost, 1e6)
    return jnp.argmin(cost + jnp.where(plans.status == Status.NO_PATH, 1e6, 0.0))


def lattice(**fields: object) -> PathThenSpeed:
    """Up to eight paths, on each a curve of least acceleration in a corridor of trapezoids.

    Args:
        **fields: of `PathThenSpeed`.
    """
    return dataclasses.replace(PathThenSpeed(), **fields)


def em(kind: Literal["em", "em-exact"] = "em", **fields: object) -> PathThenSpeed:
    """The best path with the speed step of the EM planner, at the same setting.

    Args:
        kind: a key of `SPEED_PLANNERS`, its pieces and samples set to those of `lattice`.
        **fields: of `PathThenSpeed`.
    """
    speed = dataclasses.replace(SPEED_PLANNERS[kind], pieces=20, samples=5)
    return PathThenSpeed(**{"tries": 1, "step": SpeedStep(speed=speed), **fields})


def constant(**fields: object) -> PathThenSpeed:
    """The best path with constant speed after a short ramp, whatever moves.

    Args:
        **fields: of `PathThenSpeed`.
    """
    return PathThenSpeed(**{"tries": 1, "step": SpeedStep(speed=None), **fields})
