"""The default planner: a reach set in space and time, random ways through it, least squares.

Paper 003 plans a path among what stands and then a speed along it among what moves; where the
path crosses something that stays on it, no speed helps. Here both are planned together. A reach
set of cells (`plane.reach`) says what the car can reach and when; ways through it, each drawn at
random, are where Levenberg-Marquardt begins on speed and curvature at knots (`motion`). It does so
in stages: a motion that follows the cells, for speeds and turns of cells alone drift through walls
on the way; one that keeps every limit; and, once one does, one of less effort, or an earlier one.
"""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Status, is_solved, require_attempts, require_settings
from planner_jax.optimise.levenberg import (
    LevenbergState,
    Model,
    least_squares,
)
from planner_jax.plane import reach
from planner_jax.plane.distance_field import DistanceField, distance_field
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.finalize import checked_plan, explained, straight_on
from planner_jax.task.intercept.motion import Quadratic, by_unknowns, motion
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.searches import BEST, QUICK, SEARCHES, Search
from planner_jax.task.intercept.terms import (
    Weights,
    discs_of,
    following_terms,
    limit_terms,
    meeting_terms,
    obstacle_terms,
    wrapped,
)

if TYPE_CHECKING:
    from planner_jax.task.intercept.replan import ReplanIntercept, Warm
    from planner_jax.task.intercept.smooth import BegunCase, SmoothIntercept

_FIELD = 128  # places of the distance field along either side of the map
_SOONEST = 0.01  # share of the case's time that a meeting takes at least
_SPREAD = 2  # layers from the earliest one on at which ways to the earliest meeting end

# What each stage minimises.
_FOLLOWING = Weights(follow=10.0, obstacle=0.0, early=0.0)
_KEEPING = Weights()
_SETTLING = Weights(effort=10.0)
_HURRYING = Weights(early=1000.0)  # in place of it, for meetings as early as they can be


@struct.dataclass
class Stage:
    """Some steps of least squares."""

    weights: Weights
    steps: Array | int  # at most
    tolerance: Array | float = 1.0  # see `LevenbergConfig`; 1 ends at the first good point
    settled: Array | int = 1  # likewise
    of_good: Array | bool = False  # whether only a point that keeps every limit goes through it


@struct.dataclass
class Guess:
    """Where least squares begin: the unknowns, and the places that cells give the car."""

    point: Array  # (n,)
    places: Array  # (K, 2) [m], of the rear axle's middle at the knots 1..K


@struct.dataclass
class Found:
    """What of a case all its ways share."""

    grid: reach.Grid
    field: DistanceField  # of what stands
    reach: reach.ReachSet
    layers: Array  # (layers + 1,) bool, at which a way of cells leads to the target

    @property
    def is_reached(self) -> Array:
        """Whether there is any, () bool."""
        return jnp.any(self.layers)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SpacetimeIntercept(Planner):
    """Meets the target at the case's time, or earlier.

    `meet` says when: at the "given" time, as "early" as it can until then, or at that time until
    then which takes the "least" effort, the integral of the squared acceleration. A plan's cost
    is the meeting time of the early ones [s], and the effort of the others [m^2/s^3].
    """

    case_type: ClassVar[type] = InterceptCase
    is_sequential: ClassVar[bool] = True
    meet: Literal["given", "early", "least"] = "given"
    pieces: int = 32  # of speed and curvature
    samples: int = 3  # of each piece, where obstacles are looked at
    checked: int = 10  # the same, of the plan that is given back
    tries_all: bool = False  # ways of a search, of which the best is kept; of a free time always
    searches: tuple[Search, ...] | None = None  # by default those that suit `meet`

    def __post_init__(self) -> None:
        require_settings(self)
        if self.searches is not None:
            require_attempts("searches", self.searches, Search)
        if self.meet not in ("given", "early", "least"):
            raise ValueError(f"meet must be given, early or least, got {self.meet!r}")

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches."""
        return self.searches or SEARCHES[self.meet]

    @property
    def is_time_free(self) -> bool:
        """Whether the meeting time is an unknown."""
        return self.meet != "given"

    @property
    def weights(self) -> Weights:
        """What a plan ends at the least of."""
        return _HURRYING if self.meet == "early" else _SETTLING

    def replanner(self) -> "ReplanIntercept":
        """What plans again from a plan that is being driven; see `pj.replan`."""
        from planner_jax.task.intercept.replan import ReplanIntercept

        return ReplanIntercept(self)

    def smooth_near(
        self, cases: InterceptCase, plans: InterceptPlan
    ) -> "tuple[SmoothIntercept, BegunCase]":
        """What minimises the cost from plans on, and the cases with these; see `pj.gradient`."""
        from planner_jax.task.intercept.smooth import SmoothIntercept, begun_case

        parts = [plans.speed[..., 1:], plans.curvature[..., 1:], plans.time[..., None]]
        begun = jnp.concatenate(parts if self.is_time_free else parts[:2], axis=-1)
        return SmoothIntercept(self), begun_case(cases, begun)

    def settle(
        self, cases: InterceptCase, plan_of: Callable[[Planner, Any], Any] | None = None
    ) -> "tuple[SmoothIntercept, BegunCase]":
        """Return what minimises from plans on; by default from the plan of the first search."""
        if plan_of is None:
            plans = self.solve(lax.stop_gradient(cases), self.attempts[0])
        else:
            plans = plan_of(self, cases)
        return self.smooth_near(cases, plans)

    def solve(self, case: InterceptCase, attempt: Search) -> InterceptPlan:
        """The plan of one case: way after way, until one keeps every limit.

        With `tries_all`, or of a free meeting time, all are tried, and the best one is taken.
        """
        found = self.prepare(case, attempt)
        chances = self.chances(attempt)
        ways = jnp.where(found.is_reached, attempt.ways, 0)

        def try_way(state: tuple) -> tuple:
            k, best = state
            chance = jax.tree.map(lambda leaf: leaf[k], chances)
            return k + 1, self.better_of_two(best, self.improved(case, found, chance, attempt))

        def is_wanted(state: tuple) -> Array:
            k, best = state
            tries_all = self.tries_all or self.is_time_free
            return (k < ways) & (tries_all | ~is_solved(best.status))

        _, best = lax.while_loop(is_wanted, try_way, (0, straight_on(case, self.pieces)))
        return self.explained(case, attempt, found.is_reached, best)

    def solve_at_once(self, cases: InterceptCase, attempt: Search) -> InterceptPlan:
        """The plans of a batch: all ways of all cases together, of each the best one."""
        # All go through as many layers as the one with the most, so that they stay in step.
        layers = jnp.max(jax.vmap(lambda case: self.grid(case, attempt).num)(cases))
        return jax.vmap(lambda case: self.best_of_all(case, attempt, layers))(cases)

    def best_of_all(self, case: InterceptCase, attempt: Search, layers: Array) -> InterceptPlan:
        """The plan of one case: all ways together, of which the best one is settled.

        With `tries_all` each is settled first, and the best one is what it is then.
        """
        found = self.prepare(case, attempt, layers)

        def kept(chance: reach.Chance) -> InterceptPlan:
            guess, stages = self.begun(case, found, chance, attempt), self.stages(attempt)[:-1]
            points, steps = self.staged(case, found.field, guess, attempt, stages)
            return self.plan_at(case, points[-1], steps)

        def improved(chance: reach.Chance) -> InterceptPlan:
            return self.improved(case, found, chance, attempt)

        plans = jax.vmap(improved if self.tries_all else kept)(self.chances(attempt))
        cost = jnp.where(is_solved(plans.status), plans.cost - 1e6, plans.violation)
        best = jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))
        plan = jax.tree.map(lambda leaf: leaf[best], plans)
        if not self.tries_all:
            plan = self.settled(case, found.field, plan, attempt)
        return self.explained(case, attempt, found.is_reached, plan)

    def chances(self, attempt: Search) -> reach.Chance:
        """What makes the ways of an attempt, a leading axis for its starts."""
        return reach.draw_chance(attempt.lattice, attempt.ways, attempt.seed, attempt.drawn)

    def grid(self, case: InterceptCase, attempt: Search) -> reach.Grid:
        """Where the cells and layers of a case lie."""
        return reach.grid_of(
            attempt.lattice, case.start, case.time, case.limits.speed, case.lower, case.upper
        )

    def field(self, case: InterceptCase, grid: reach.Grid) -> DistanceField:
        """Distances from what stands, some places for each cell."""
        spacing = grid.cell * (grid.lattice.cells / _FIELD)
        return distance_field(case.walls, grid.corner, spacing, _FIELD)

    def prepare(self, case: InterceptCase, attempt: Search, layers: Array | None = None) -> Found:
        """Grid and reach set of a case, of so many layers; by default those up to its time."""
        grid = self.grid(case, attempt)
        field = self.field(case, grid)
        radius, ahead = discs_of(case.body, 2)
        level = case.limits.speed * jnp.linspace(0.0, 1.0, attempt.lattice.levels)
        turn_rates = jnp.minimum(
            case.limits.curvature * level,
            case.limits.lateral_acceleration / jnp.maximum(level, 0.1 * case.limits.speed),
        )
        vehicle = reach.Vehicle(
            radius=attempt.girth * radius,
            ahead=ahead,
            speed=case.limits.speed,
            turn_rates=turn_rates,
        )
        needed = grid.num if layers is None else layers
        by = _FIELD // attempt.lattice.cells
        coarse = field.values[::by, ::by]
        found = reach.reach_set(grid, coarse, case.movers, vehicle, case.speed, needed)
        places = jnp.arange(attempt.lattice.layers + 1)
        is_there = jax.vmap(lambda n: jnp.any(self.meetings(case, grid, found, n)[1]))
        if self.is_time_free:
            reached = is_there(places) & (places >= 1) & (places <= grid.num)
        else:
            reached = is_there(grid.num[None])[0] & (places == grid.num)
        return Found(grid=grid, field=field, reach=found, layers=reached)

    def meetings(
        self, case: InterceptCase, grid: reach.Grid, found: reach.ReachSet, layer: Array
    ) -> tuple[Array, Array]:
        """The cells of a layer at which the target is met; see `reach.goal_cells`."""
        goal = case.target.at((layer + 0.5) * grid.step).pos
        headings = self.end_headings(case, grid)
        return reach.goal_cells(grid, found.bits[layer], goal, case.body.middle, headings)

    def end_headings(self, case: InterceptCase, grid: reach.Grid) -> Array:
        """Which bins of heading a meeting may have."""
        num = grid.lattice.headings
        width = 2.0 * np.pi / num
        angle = grid.heading + width * jnp.arange(num)
        return jnp.abs(wrapped(angle - case.end_heading)) <= case.heading_tolerance + width

    def improved(
        self, case: InterceptCase, found: Found, chance: reach.Chance, attempt: Search
    ) -> InterceptPlan:
        """The plan that one random way leads to."""
        guess = self.begun(case, found, chance, attempt)
        return self.refined(case, found.field, guess, attempt, self.stages(attempt))

    def begun(
        self, case: InterceptCase, found: Found, chance: reach.Chance, attempt: Search
    ) -> Guess:
        """Where least squares begin on a random way."""
        layer = self.layer(found, chance)
        cells, there = self.meetings(case, found.grid, found.reach, layer)
        way = reach.smooth_way(
            found.grid, found.reach, layer, cells, there, chance, attempt.directness
        )
        return self.guess(case, found.grid, way, layer)

    def layer(self, found: Found, chance: reach.Chance) -> Array:
        """The layer at which a way ends: one of the first that reach the target, or of all."""
        if self.meet == "given":
            return found.grid.num
        allowed = found.layers
        if self.meet == "early":
            allowed &= jnp.cumsum(found.layers) <= _SPREAD
        return jnp.argmax(jnp.where(allowed, chance.layers, -jnp.inf))

    def stages(self, attempt: Search) -> list[Stage]:
        """What a guess along a way of cells goes through."""
        return [Stage(_FOLLOWING, attempt.following), *self.last_stages(attempt)]

    def last_stages(self, attempt: "Search | Warm") -> list[Stage]:
        """What a guess that is near to a plan goes through."""
        kept = {"margin": attempt.margin, "slack": attempt.slack}
        keeping = Stage(dataclasses.replace(_KEEPING, **kept), attempt.solver.max_steps)
        if self.is_time_free:
            solver = attempt.solver
            keeping = dataclasses.replace(
                keeping, tolerance=solver.tolerance, settled=solver.settled
            )
        steps = attempt.settling
        weights = dataclasses.replace(self.weights, **kept)
        return [keeping, Stage(weights, steps, settled=steps, of_good=True)]

    def staged(
        self,
        case: InterceptCase,
        field: DistanceField,
        guess: Guess,
        attempt: "Search | Warm",
        stages: list[Stage],
    ) -> tuple[Array, Array]:
        """Where each of S stages of least squares ends, which begins where the last one ended.

        Returns:
            points: (S, n).
            steps: () int32, of all stages.
        """

        def one(state: tuple[Array, Array], stage: Stage) -> tuple[tuple, LevenbergState]:
            point, is_good = state
            most = jnp.where(stage.of_good & ~is_good, 0, stage.steps)
            config = dataclasses.replace(
                attempt.solver, max_steps=most, tolerance=stage.tolerance, settled=stage.settled
            )

            def model(x: Array) -> Model:
                return self.model(x, case, field, stage.weights, guess.places, attempt.discs)

            end = least_squares(model, point, config)
            return (end.point, end.model.violation <= 0.0), end

        # A loop over stages, so that all of them share one compiled step.
        stacked = jax.tree.map(lambda *each: jnp.stack([jnp.asarray(x) for x in each]), *stages)
        _, ends = lax.scan(one, (guess.point, jnp.asarray(False)), stacked)
        return ends.point, jnp.sum(ends.steps).astype(jnp.int32)

    def refined(
        self,
        case: InterceptCase,
        field: DistanceField,
        guess: Guess,
        attempt: "Search | Warm",
        stages: list[Stage],
    ) -> InterceptPlan:
        """The plan at the end of some stages, or before the last one where that breaks a limit."""
        points, steps = self.staged(case, field, guess, attempt, stages)
        plans = lax.map(lambda point: self.plan_at(case, point, steps), points[-2:])
        before, after = (jax.tree.map(lambda leaf, k=k: leaf[k], plans) for k in range(2))
        return self.better_of_two(before, after)

    def settled(
        self, case: InterceptCase, field: DistanceField, plan: InterceptPlan, attempt: Search
    ) -> InterceptPlan:
        """A plan after the last stage alone, if it is solved."""
        point = self.point(plan.speed[1:], plan.curvature[1:], plan.time)
        guess = self.guess_at(point)
        last = self.last_stages(attempt)[-1]
        steps = jnp.where(is_solved(plan.status), last.steps, 0)
        stage = dataclasses.replace(last, steps=steps, of_good=False)
        points, steps = self.staged(case, field, guess, attempt, [stage])
        return self.better_of_two(plan, self.plan_at(case, points[0], plan.iterations + steps))

    def guess_at(self, point: Array) -> Guess:
        """A guess of unknowns (n,) for stages that follow no way of cells."""
        return Guess(point=point, places=jnp.zeros((self.pieces, 2), point.dtype))

    def guess(self, case: InterceptCase, grid: reach.Grid, way: reach.Way, layer: Array) -> Guess:
        """Unknowns and places along a way of cells up to a layer."""
        width = 2.0 * np.pi / grid.lattice.headings
        pace = case.limits.speed / (grid.lattice.levels - 1)
        steps = layer + 0.5
        at = jnp.arange(1, self.pieces + 1) * (steps / self.pieces)  # in steps

        def between(values: Array, first: Array, place: Array) -> Array:
            """Values on the way; the first is that of time 0, then one at every step."""
            place = jnp.clip(place - 1.0, -1.0, layer - 1.0)
            below = jnp.floor(place).astype(jnp.int32)
            share, is_first = (
                each.reshape(-1, *[1] * (values.ndim - 1)) for each in (place - below, below < 0)
            )
            low = jnp.where(is_first, first, values[jnp.maximum(below, 0)])
            return (1.0 - share) * low + share * values[jnp.minimum(below + 1, layer - 1)]

        speed = between(pace * way.level.astype(grid.cell.dtype), case.speed, at)
        bins = width * way.bin.astype(grid.cell.dtype)
        straight = jnp.round(bins[0] / (2.0 * np.pi)) * 2.0 * np.pi  # bin 0, on its turn
        rate = (between(bins, straight, at + 0.5) - between(bins, straight, at - 0.5)) / grid.step
        # The car may not turn yet where the way of cells already does: it makes up for it soon.
        time = steps * grid.step
        knot = time / self.pieces
        first = case.speed * case.curvature
        turned = 0.5 * knot * (first + 2.0 * rate[0] + rate[1])
        lag = between(bins, straight, at)[1] - straight - turned
        rate = rate.at[:2].add(0.5 * lag / knot)
        curvature = rate / jnp.maximum(speed, 0.3 * case.limits.speed)
        limit = case.limits.curvature
        point = self.point(speed, jnp.clip(curvature, -limit, limit), time)
        cells = grid.corner + grid.cell * way.cell.astype(grid.cell.dtype)
        return Guess(point=point, places=between(cells, case.start[:2], at - 0.5))

    def point(self, speed: Array, curvature: Array, time: Array) -> Array:
        """The unknowns (n,): values at the knots 1..K, and the time where it is free."""
        parts = [speed, curvature, time[None]]
        return jnp.concatenate(parts if self.is_time_free else parts[:2])

    def parts(self, case: InterceptCase, point: Array) -> tuple[Array, Array, Array]:
        """Speed and curvature at all knots, (K + 1,) each, and the time of the meeting."""
        speed, curvature = point[: self.pieces], point[self.pieces : 2 * self.pieces]
        time = jnp.clip(point[-1], _SOONEST * case.time, case.time)
        return (
            jnp.concatenate([case.speed[None], speed]),
            jnp.concatenate([case.curvature[None], curvature]),
            time if self.is_time_free else case.time,
        )

    def model(
        self,
        point: Array,
        case: InterceptCase,
        field: DistanceField,
        weights: Weights,
        places: Array,
        discs: int = 3,
    ) -> Model:
        """Sum of squares of a point: miss, obstacles, limits, effort, distance from places.

        Of obstacles the body keeps off as so many discs, static.
        """
        speed, curvature, time = self.parts(case, point)
        way = motion(case.start, time, speed, curvature, self.samples)
        limits, violation = limit_terms(case, time, speed, curvature, weights, 4)
        end, missed = meeting_terms(case, way, time, weights)
        squares, close = obstacle_terms(case, field, way, weights, discs)
        squares = squares.at[:, -1].add(following_terms(way, places, weights))
        squares = squares.at[-1, -1].add(end)
        cost = Quadratic(
            push=squares[..., :4, 4],
            stiffness=squares[..., :4, :4],
            piece_push=limits[:, :5, 5],
            piece_stiffness=limits[:, :5, :5],
        )
        gradient, curvature = by_unknowns(way, cost, self.is_time_free)
        total = jnp.sum(squares[..., 4, 4]) + jnp.sum(limits[:, 5, 5])
        if self.is_time_free:
            # Later than the case's time it costs much, and earlier it costs little.
            late = jnp.maximum(point[-1] / case.time - 1.0, 0.0)
            pull = weights.early if self.meet == "early" else 0.0
            push = (weights.limit * late + pull * time / case.time) / case.time
            gradient = gradient.at[-1].add(push)
            stiffness = pull + jnp.where(late > 0.0, weights.limit, 0.0)
            curvature = curvature.at[-1, -1].add(stiffness / case.time**2)
            total += weights.limit * late**2 + pull * (time / case.time) ** 2
        return Model(
            cost=total,
            gradient=gradient,
            curvature=curvature,
            violation=jnp.maximum(jnp.maximum(violation, missed), close),
        )

    def plan_at(self, case: InterceptCase, point: Array, steps: Array) -> InterceptPlan:
        """The plan of a point, looked at more closely."""
        speed, curvature, time = self.parts(case, point)
        plan = checked_plan(
            case, time, speed, curvature, samples=self.checked, places=12, steps=steps
        )
        return dataclasses.replace(plan, cost=time) if self.meet == "early" else plan

    def explained(
        self, case: InterceptCase, attempt: Search, is_reached: Array, plan: InterceptPlan
    ) -> InterceptPlan:
        """The plan with a status that says why there is none."""
        reason = plan.status
        if attempt == self.attempts[-1]:
            reason = jnp.where(is_reached, reason, Status.NO_PATH)
        return explained(case, reason, plan, is_time_free=self.is_time_free)

    def better_of_two(self, plan: InterceptPlan, later: InterceptPlan) -> InterceptPlan:
        """The later plan where it is solved at less cost, or violates less than an unsolved one."""
        both = is_solved(plan.status) & is_solved(later.status)
        less = (later.violation < plan.violation) | ~jnp.isfinite(plan.violation)
        better = jnp.where(both, later.cost < plan.cost, less & ~is_solved(plan.status))
        return jax.tree.map(lambda new, old: jnp.where(better, new, old), later, plan)


def quick(**fields: Any) -> SpacetimeIntercept:
    """The default planner with fewer ways and steps, for meetings at the case's time.

    Args:
        **fields: of `SpacetimeIntercept`.
    """
    return SpacetimeIntercept(**{"searches": QUICK, **fields})


def best(**fields: Any) -> SpacetimeIntercept:
    """The default planner with more ways and steps, of which the plan of least effort is kept.

    Args:
        **fields: of `SpacetimeIntercept`.
    """
    return SpacetimeIntercept(**{"searches": BEST, "tries_all": True, **fields})
