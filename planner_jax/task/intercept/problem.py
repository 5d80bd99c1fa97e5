"""The least-squares problem about an interception, solved in stages and differentiated.

Unknowns are speed and curvature at the knots 1..K, and the time of the meeting where it is free.
The cost is a sum of squares: effort, and hinges on the miss, limits and obstacles (`terms`).

The search for a path round the obstacles has no derivative. From its path, least squares lead to a
point of least cost, and that point moves smoothly with the case: its derivatives are those of the
implicit function theorem. Hinges on obstacles and limits that bind pull; the others do not count.
"""

import dataclasses
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.protocol import is_solved, select
from planner_jax.optimise.levenberg import LevenbergConfig, LevenbergState, Model, least_squares
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, NewtonConfig, Round
from planner_jax.plane.cell_paths import CellPath
from planner_jax.plane.distance_field import DistanceField
from planner_jax.plane.reach import Grid
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.motion import Quadratic, by_unknowns, motion
from planner_jax.task.intercept.plan import InterceptPlan, make_plan
from planner_jax.task.intercept.searches import Search, Warm
from planner_jax.task.intercept.terms import (
    Weights,
    following_terms,
    join_obstacles,
    limit_terms,
    meeting_terms,
    obstacle_terms,
)

_SOONEST = 0.01  # share of the case's time that a meeting takes at least

# Weights of each stage.
_FOLLOWING = Weights(follow=10.0, obstacle=0.0, early=0.0)
_KEEPING = Weights()
_SETTLING = Weights(effort=10.0)
_HURRYING = Weights(early=1000.0)  # instead of `_SETTLING`, for meetings as early as possible
# Weight of an early meeting where the cost is differentiated: so little beside the limits that the
# least cost lies within their slack.
_EARLY = 30.0


@struct.dataclass
class Stage:
    """Some steps of least squares."""

    weights: Weights
    steps: Array | int  # at most
    tolerance: Array | float = 1.0  # see `LevenbergConfig`; 1 ends at the first good point
    settled: Array | int = 1  # see `LevenbergConfig`
    of_good: Array | bool = False  # whether only a point that keeps every limit is changed


@struct.dataclass
class Guess:
    """A starting point of least squares: unknowns, and the positions that cells give the car."""

    point: Array  # (n,)
    places: Array  # (K, 2) [m], of the rear axle's middle at the knots 1..K


@dataclasses.dataclass(frozen=True)
class MotionProblem:
    """The problem of a planner: what its unknowns are, and how closely it checks them; static.

    The fields are those of `SpacetimeIntercept`.
    """

    meet: Literal["given", "early", "least"] = "given"
    pieces: int = 32
    samples: int = 3
    checked: int = 10

    @property
    def is_time_free(self) -> bool:
        """Whether the meeting time is an unknown."""
        return self.meet != "given"

    @property
    def weights(self) -> Weights:
        """The weights of the last stage."""
        return _HURRYING if self.meet == "early" else _SETTLING

    def pack(self, speed: Array, curvature: Array, time: Array) -> Array:
        """Return the unknowns (..., n) of values (..., K) at the knots 1..K and a time (...)."""
        parts = [speed, curvature, time[..., None]]
        return jnp.concatenate(parts if self.is_time_free else parts[:2], axis=-1)

    def unpack(self, case: InterceptCase, point: Array) -> tuple[Array, Array, Array]:
        """Return speed and curvature at all knots, (K + 1,) each, and the time of the meeting."""
        speed, curvature = point[: self.pieces], point[self.pieces : 2 * self.pieces]
        time = jnp.clip(point[-1], _SOONEST * case.time, case.time)
        return (
            jnp.concatenate([case.speed[None], speed]),
            jnp.concatenate([case.curvature[None], curvature]),
            time if self.is_time_free else case.time,
        )

    def decode(self, case: InterceptCase, point: Array, steps: Array) -> InterceptPlan:
        """Make the plan of a point and check it at more samples than least squares use."""
        speed, curvature, time = self.unpack(case, point)
        plan = make_plan(case, time, speed, curvature, samples=self.checked, places=12, steps=steps)
        return dataclasses.replace(plan, cost=time) if self.meet == "early" else plan

    def guess_at(self, point: Array) -> Guess:
        """Return a guess at unknowns (n,) for stages that follow no path of cells."""
        return Guess(point=point, places=jnp.zeros((self.pieces, 2), point.dtype))

    def guess_along(self, case: InterceptCase, grid: Grid, path: CellPath, layer: Array) -> Guess:
        """Return a guess along a path of cells up to a layer."""
        width = 2.0 * np.pi / grid.lattice.headings
        pace = case.limits.speed / (grid.lattice.levels - 1)
        steps = layer + 0.5
        at = jnp.arange(1, self.pieces + 1) * (steps / self.pieces)  # in steps

        def between(values: Array, first: Array, place: Array) -> Array:
            """Interpolate values on the path: the first is at time 0, then one at every step."""
            place = jnp.clip(place - 1.0, -1.0, layer - 1.0)
            below = jnp.floor(place).astype(jnp.int32)
            share, is_first = (
                each.reshape(-1, *[1] * (values.ndim - 1)) for each in (place - below, below < 0)
            )
            low = jnp.where(is_first, first, values[jnp.maximum(below, 0)])
            return (1.0 - share) * low + share * values[jnp.minimum(below + 1, layer - 1)]

        speed = between(pace * path.level.astype(grid.cell.dtype), case.speed, at)
        bins = width * path.bin.astype(grid.cell.dtype)
        straight = jnp.round(bins[0] / (2.0 * np.pi)) * 2.0 * np.pi  # bin 0, on its turn
        rate = (between(bins, straight, at + 0.5) - between(bins, straight, at - 0.5)) / grid.step
        # The car may not turn yet where the path of cells already does: it makes up for it soon.
        time = steps * grid.step
        knot = time / self.pieces
        first = case.speed * case.curvature
        turned = 0.5 * knot * (first + 2.0 * rate[0] + rate[1])
        lag = between(bins, straight, at)[1] - straight - turned
        rate = rate.at[:2].add(0.5 * lag / knot)
        curvature = rate / jnp.maximum(speed, 0.3 * case.limits.speed)
        limit = case.limits.curvature
        point = self.pack(speed, jnp.clip(curvature, -limit, limit), time)
        cells = grid.corner + grid.cell * path.cell.astype(grid.cell.dtype)
        return Guess(point=point, places=between(cells, case.start[:2], at - 0.5))

    def build_model(
        self,
        point: Array,
        case: InterceptCase,
        field: DistanceField,
        weights: Weights,
        places: Array,
        discs: int = 3,
    ) -> Model:
        """Return the sum of squares at a point (n,) of unknowns, and its quadratic model.

        `weights.follow` draws the car to places (K, 2) [m]; a static number of discs stands for
        the body.
        """
        speed, curvature, time = self.unpack(case, point)
        drive = motion(case.start, time, speed, curvature, self.samples)
        limits, violation = limit_terms(case, time, speed, curvature, weights, 4)
        end, missed = meeting_terms(case, drive, time, weights)
        squares, close = obstacle_terms(case, field, drive, weights, discs)
        squares = squares.at[:, -1].add(following_terms(drive, places, weights))
        squares = squares.at[-1, -1].add(end)
        cost = Quadratic(
            push=squares[..., :4, 4],
            stiffness=squares[..., :4, :4],
            piece_push=limits[:, :5, 5],
            piece_stiffness=limits[:, :5, :5],
        )
        gradient, curvature = by_unknowns(drive, cost, self.is_time_free)
        total = jnp.sum(squares[..., 4, 4]) + jnp.sum(limits[:, 5, 5])
        if self.is_time_free:
            # A meeting later than the case's time costs much, and an earlier one costs little.
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

    def list_stages(self, attempt: Search) -> list[Stage]:
        """List the stages of a guess along a path of cells."""
        return [Stage(_FOLLOWING, attempt.following), *self.list_last_stages(attempt)]

    def list_last_stages(self, attempt: Search | Warm) -> list[Stage]:
        """List the stages of a guess that is near to a plan."""
        margins = {"margin": attempt.margin, "slack": attempt.slack}
        keeping = Stage(dataclasses.replace(_KEEPING, **margins), attempt.solver.max_steps)
        if self.is_time_free:
            solver = attempt.solver
            keeping = dataclasses.replace(
                keeping, tolerance=solver.tolerance, settled=solver.settled
            )
        steps = attempt.settling
        weights = dataclasses.replace(self.weights, **margins)
        return [keeping, Stage(weights, steps, settled=steps, of_good=True)]

    def run_stages(
        self,
        case: InterceptCase,
        field: DistanceField,
        guess: Guess,
        attempt: Search | Warm,
        stages: list[Stage],
    ) -> tuple[Array, Array]:
        """Run S stages of least squares, each from the point at which the one before ended.

        Returns:
            points: (S, n), at which the stages end.
            steps: () int32, of all stages.
        """

        def run(state: tuple[Array, Array], stage: Stage) -> tuple[tuple, LevenbergState]:
            point, is_good = state
            most = jnp.where(stage.of_good & ~is_good, 0, stage.steps)
            config = dataclasses.replace(
                attempt.solver, max_steps=most, tolerance=stage.tolerance, settled=stage.settled
            )

            def model(x: Array) -> Model:
                return self.build_model(x, case, field, stage.weights, guess.places, attempt.discs)

            end = least_squares(model, point, config)
            return (end.point, end.model.violation <= 0.0), end

        # A loop over stages, so that all of them share one compiled step.
        stacked = jax.tree.map(lambda *each: jnp.stack([jnp.asarray(x) for x in each]), *stages)
        _, ends = lax.scan(run, (guess.point, jnp.asarray(False)), stacked)
        return ends.point, jnp.sum(ends.steps).astype(jnp.int32)

    def refine(
        self,
        case: InterceptCase,
        field: DistanceField,
        guess: Guess,
        attempt: Search | Warm,
        stages: list[Stage],
    ) -> InterceptPlan:
        """Return the plan at the end of the stages, or before the last one if that is better."""
        points, steps = self.run_stages(case, field, guess, attempt, stages)
        plans = lax.map(lambda point: self.decode(case, point, steps), points[-2:])
        before, after = (jax.tree.map(lambda leaf, k=k: leaf[k], plans) for k in range(2))
        return select(after, before)

    def refine_solved(
        self, case: InterceptCase, field: DistanceField, plan: InterceptPlan, attempt: Search
    ) -> InterceptPlan:
        """Return a plan after the last stage alone, if it is solved."""
        guess = self.guess_at(self.pack(plan.speed[1:], plan.curvature[1:], plan.time))
        last = self.list_last_stages(attempt)[-1]
        steps = jnp.where(is_solved(plan.status), last.steps, 0)
        stage = dataclasses.replace(last, steps=steps, of_good=False)
        points, steps = self.run_stages(case, field, guess, attempt, [stage])
        return select(self.decode(case, points[0], plan.iterations + steps), plan)


@struct.dataclass
class BegunCase(InterceptCase):
    """A case with a path round the obstacles."""

    begun: Array  # (n,) unknowns of a plan, constant to derivatives


@struct.dataclass
class _Context:
    case: BegunCase
    moving: BegunCase
    field: DistanceField  # of nothing


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SmoothIntercept(OptimisedPlanner):
    """Least squares from a plan of `SpacetimeIntercept` to a point of stationary cost.

    The cost of its plans is the sum of squares of `MotionProblem`.
    """

    case_type: ClassVar[type] = BegunCase
    adjoint: ClassVar[str] = "whole"
    problem: MotionProblem = MotionProblem()
    solver: LevenbergConfig = LevenbergConfig(2000, settled=12, tolerance=1e-9)
    # No round of its own: least squares run to the end.
    rounds: tuple[Round, ...] = (Round(solver=LbfgsConfig(max_steps=0)),)

    def prepare(self, case: BegunCase) -> _Context:
        """Return the case, and the same case with walls that are movers at standstill.

        Distances from movers are exact. Those from the field of the walls are interpolated, and
        their slope jumps from node to node.
        """
        nowhere = jnp.full((2, 2), 1e3, case.lower.dtype)
        return _Context(
            case=case,
            moving=dataclasses.replace(case, movers=join_obstacles(case.walls, case.movers)),
            field=DistanceField(values=nowhere, corner=case.lower, spacing=case.time),
        )

    def guesses(self, context: _Context, num: int) -> Array:
        """Return the end of least squares, (1, n); there is one such point."""
        fixed = lax.stop_gradient(context)
        end = least_squares(lambda x: self._exact_model(x, fixed), fixed.case.begun, self.solver)
        return jnp.broadcast_to(end.point, (num, *end.point.shape))

    def _model(self, point: Array, context: _Context) -> Model:
        """Return the sum of squares and its quadratic model."""
        problem = self.problem
        weights = dataclasses.replace(problem.weights, early=_EARLY)
        places = problem.guess_at(point).places
        return problem.build_model(point, context.moving, context.field, weights, places)

    def _exact_model(self, point: Array, context: _Context) -> Model:
        """Return the model with the gradient of the cost itself.

        The problem's own gradient leaves out how the greatest rate of curvature changes with the
        curvature.
        """
        model = self._model(point, context)
        gradient = jax.grad(lambda x: self.objective(x, context).cost)(point)
        return dataclasses.replace(model, gradient=0.5 * gradient)  # halved as the problem's own

    def objective(self, point: Array, context: _Context) -> Evaluation:
        """Return the sum of squares and the largest violation at a point (n,)."""
        model = self._model(point, context)
        return Evaluation(cost=model.cost, violation=model.violation)

    def decode(self, point: Array, context: _Context) -> InterceptPlan:
        """Return the plan of a point."""
        return self.problem.decode(context.case, point, jnp.zeros((), jnp.int32))

    def with_polish(self, solver: NewtonConfig | None = None) -> "SmoothIntercept":
        """Return the planner: its plans are optimal already."""
        return self


def add_start(case: InterceptCase, begun: Array) -> BegunCase:
    """Return a case, or a batch, with the unknowns (n,) or (B, n) of a plan."""
    return BegunCase(**vars(case), begun=lax.stop_gradient(begun))
