"""The default planner: a reach set in space and time, random ways through it, least squares.

Paper 003 plans a path among what stands and then a speed along it among what moves; where the
path crosses something that stays on it, no speed helps. Here both are planned together. A reach
set of cells (`plane.reach`) says what the car can reach and when; ways through it, each drawn at
random, are where Levenberg-Marquardt begins on speed and curvature at knots (`motion`). The first
one that keeps every limit is taken, smoothed.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.optimise.levenberg import LevenbergConfig, Model, least_squares
from planner_jax.plane import reach
from planner_jax.protocol import Attempt
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.checked import checked_plan, explained, straight_on
from planner_jax.task.intercept.motion import motion
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.terms import (
    Weights,
    discs_of,
    limit_rows,
    meeting_rows,
    obstacle_terms,
    wrapped,
)

_HIGHEST = lax.Precision.HIGHEST


# A way takes about as much memory as so many starts of planners with few unknowns.
_ROOM = 8


@dataclasses.dataclass(frozen=True)
class Search(Attempt):
    """An attempt: so many ways, and so many steps from each; static."""

    starts: int = dataclasses.field(init=False, default=1)
    ways: int = 16
    solver: LevenbergConfig = LevenbergConfig()
    seed: int = 0  # of the ways

    def __post_init__(self) -> None:
        if self.ways < 1:
            raise ValueError(f"ways must be >= 1, got {self.ways}")
        object.__setattr__(self, "starts", _ROOM * self.ways)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SpacetimeIntercept:
    """Meets the target at the case's time."""

    case_type: ClassVar[type] = InterceptCase
    lattice: reach.Lattice = reach.Lattice()
    pieces: int = 32  # of speed and curvature
    samples: int = 4  # of each piece, where obstacles are looked at
    checked: int = 10  # the same, of the plan that is given back
    margin: float = 0.02  # [m], kept from obstacles
    slack: float = 0.015  # share of every limit that is kept free
    searches: tuple[Search, ...] = (
        Search(4),
        Search(16, seed=1),
        Search(32, LevenbergConfig(40), seed=2),
    )

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches."""
        return self.searches

    def solve(self, case: InterceptCase, attempt: Search) -> InterceptPlan:
        """The plan of one case: way after way, until one keeps every limit."""
        found = self.prepare(case)
        chances = self.chances(attempt)
        ways = jnp.where(found.is_reached, attempt.ways, 0)

        def try_way(state: tuple) -> tuple:
            k, best = state
            chance = jax.tree.map(lambda leaf: leaf[k], chances)
            return k + 1, better_of_two(best, self.improved(case, found, chance, attempt))

        _, best = lax.while_loop(
            lambda s: (s[0] < ways) & (s[1].violation > 0.0),
            try_way,
            (0, straight_on(case, self.pieces)),
        )
        return explained(case, found.is_reached, best)

    def solve_lanes(self, cases: InterceptCase, attempt: Search) -> InterceptPlan:
        """The plans of a batch: on a CPU one after another, else all ways of all at once."""
        return lax.platform_dependent(
            cases,
            cpu=lambda cases: lax.map(lambda case: self.solve(case, attempt), cases),
            default=lambda cases: self.solve_at_once(cases, attempt),
        )

    def solve_at_once(self, cases: InterceptCase, attempt: Search) -> InterceptPlan:
        """The plans of a batch: all ways of all cases together, of each the best one."""
        # All go through as many layers as the one with the most, so that they stay in step.
        layers = jnp.max(jax.vmap(self.grid)(cases).num)
        return jax.vmap(lambda case: self.best_of_all(case, attempt, layers))(cases)

    def best_of_all(self, case: InterceptCase, attempt: Search, layers: Array) -> InterceptPlan:
        """The plan of one case: all ways together, the best one."""
        found = self.prepare(case, layers)
        improved = jax.vmap(lambda chance: self.improved(case, found, chance, attempt))
        plans = improved(self.chances(attempt))
        cost = jnp.where(plans.violation <= 0.0, plans.cost - 1e6, plans.violation)
        best = jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))
        return explained(case, found.is_reached, jax.tree.map(lambda leaf: leaf[best], plans))

    def chances(self, attempt: Search) -> reach.Chance:
        """What makes the ways of an attempt, a leading axis for its starts."""
        return reach.draw_chance(self.lattice, attempt.ways, attempt.seed)

    def grid(self, case: InterceptCase) -> reach.Grid:
        """Where the cells and layers of a case lie."""
        return reach.grid_of(
            self.lattice, case.start, case.time, case.limits.speed, case.lower, case.upper
        )

    def prepare(self, case: InterceptCase, layers: Array | None = None) -> "Found":
        """Grid and reach set of a case, of so many layers; by default those up to its time."""
        grid = self.grid(case)
        field = reach.distance_field(grid, case.walls, case.lower, case.upper)
        radius, ahead = discs_of(case.body, 2)
        level = case.limits.speed * jnp.linspace(0.0, 1.0, self.lattice.levels)
        turn_rates = jnp.minimum(
            case.limits.curvature * level,
            case.limits.lateral_acceleration / jnp.maximum(level, 0.1 * case.limits.speed),
        )
        found = reach.reach_set(
            self.lattice,
            grid,
            field,
            case.movers,
            reach.Footprint(radius, ahead),
            case.limits.speed,
            case.speed,
            case.start,
            turn_rates,
            case.lower,
            case.upper,
            grid.num if layers is None else layers,
        )
        cells, there = reach.goal_cells(
            self.lattice,
            grid,
            found.bits[grid.num],
            case.target.at(case.time).pos,
            case.body.middle,
            self.end_headings(case, grid),
        )
        return Found(grid=grid, reach=found, cells=cells, there=there)

    def improved(
        self, case: InterceptCase, found: "Found", chance: reach.Chance, attempt: Search
    ) -> InterceptPlan:
        """The plan that one random way leads to."""
        way = reach.draw_way(
            self.lattice, found.reach, found.grid.num, found.cells, found.there, chance
        )
        return self.refined(case, self.guess(case, found.grid, way), case.time, attempt.solver)

    def refined(
        self, case: InterceptCase, guess: Array, time: Array, solver: LevenbergConfig
    ) -> InterceptPlan:
        """The plan that least squares make of a guess (2 K,)."""
        goal = case.target.at(time).pos
        weights = Weights()
        end = least_squares(lambda x: self.model(x, case, time, goal, weights), guess, solver)
        return self.plan_at(case, end.point, time, end.steps)

    def end_headings(self, case: InterceptCase, grid: reach.Grid) -> Array:
        """Which bins of heading a meeting may have."""
        width = 2.0 * np.pi / self.lattice.headings
        angle = grid.heading + width * jnp.arange(self.lattice.headings)
        return jnp.abs(wrapped(angle - case.end_heading)) <= case.heading_tolerance + width

    def guess(self, case: InterceptCase, grid: reach.Grid, way: reach.Way) -> Array:
        """Speed and curvature at the knots, (2 K,), along a way of cells."""
        width = 2.0 * np.pi / self.lattice.headings
        pace = case.limits.speed / (self.lattice.levels - 1)
        at = jnp.arange(1, self.pieces + 1) * ((grid.num + 0.5) / self.pieces)  # in steps

        def between(values: Array, first: Array, place: Array) -> Array:
            """Values on the way; the first is that of time 0, then one at every step."""
            place = jnp.clip(place - 1.0, -1.0, grid.num - 1.0)
            below = jnp.floor(place).astype(jnp.int32)
            share = place - below
            low = jnp.where(below < 0, first, values[jnp.maximum(below, 0)])
            return (1.0 - share) * low + share * values[jnp.minimum(below + 1, grid.num - 1)]

        speed = between(pace * way.level.astype(grid.cell.dtype), case.speed, at)
        bins = width * way.bin.astype(grid.cell.dtype)
        straight = jnp.round(bins[0] / (2.0 * np.pi)) * 2.0 * np.pi  # bin 0, on its turn
        rate = (between(bins, straight, at + 0.5) - between(bins, straight, at - 0.5)) / grid.step
        # The car may not turn yet where the way of cells already does: it makes up for it soon.
        knot = case.time / self.pieces
        first = case.speed * case.curvature
        turned = 0.5 * knot * (first + 2.0 * rate[0] + rate[1])
        lag = between(bins, straight, at)[1] - straight - turned
        rate = rate.at[:2].add(0.5 * lag / knot)
        curvature = rate / jnp.maximum(speed, 0.3 * case.limits.speed)
        limit = case.limits.curvature
        return jnp.concatenate([speed, jnp.clip(curvature, -limit, limit)])

    def knots(self, case: InterceptCase, point: Array) -> tuple[Array, Array]:
        """Speed and curvature at all knots, (K + 1,) each."""
        speed, curvature = jnp.split(point, 2)
        return (
            jnp.concatenate([case.speed[None], speed]),
            jnp.concatenate([case.curvature[None], curvature]),
        )

    def model(
        self, point: Array, case: InterceptCase, time: Array, goal: Array, weights: Weights
    ) -> Model:
        """Sum of squares of a point (2 K,): miss, obstacles, limits, effort."""
        speed, curvature = self.knots(case, point)
        way = motion(case.start, time, speed, curvature, self.samples)
        rows, values, violation = limit_rows(case, time, speed, curvature, weights, self.slack, 4)
        end, end_values, missed = meeting_rows(case, way, goal, weights)
        rows = jnp.concatenate([rows, end])
        values = jnp.concatenate([values, end_values])
        push, stiffness, cost, close = obstacle_terms(case, way, time, weights, self.margin)
        slopes = jnp.concatenate([way.pos_slope, way.heading_slope[:, None]], axis=1)  # (M, 3, 2 K)
        stiff = jnp.sum(stiffness[..., None] * slopes[:, None], axis=2)
        # One product for curvature and gradient.
        pushed = jnp.concatenate([stiff, push[..., None]], axis=2).reshape(-1, point.size + 1)
        pulled = jnp.concatenate([rows, values[:, None]], axis=1)
        seen = jnp.matmul(slopes.reshape(-1, point.size).T, pushed, precision=_HIGHEST)
        seen += jnp.matmul(rows.T, pulled, precision=_HIGHEST)
        return Model(
            cost=jnp.sum(values**2) + cost,
            gradient=seen[:, -1],
            curvature=seen[:, :-1],
            violation=jnp.maximum(jnp.maximum(violation, missed), close),
        )

    def plan_at(
        self, case: InterceptCase, point: Array, time: Array, steps: Array
    ) -> InterceptPlan:
        """The plan of a point, looked at more closely."""
        speed, curvature = self.knots(case, point)
        return checked_plan(
            case, time, speed, curvature, samples=self.checked, places=12, steps=steps
        )


@struct.dataclass
class Found:
    """What of a case all its ways share."""

    grid: reach.Grid
    reach: reach.ReachSet
    cells: Array  # of `reach.goal_cells`
    there: Array

    @property
    def is_reached(self) -> Array:
        """Whether a way of cells leads to the target, () bool."""
        return jnp.any(self.there)


def better_of_two(plan: InterceptPlan, later: InterceptPlan) -> InterceptPlan:
    """The later plan where it violates less."""
    better = (later.violation < plan.violation) | ~jnp.isfinite(plan.violation)
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), later, plan)
