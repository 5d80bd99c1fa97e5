"""The least-squares problem of an interception, solved in stages and differentiated.

The unknowns are speed and curvature at the knots 1..K, and the time of the meeting if it is free.
The cost is a sum of squares: effort, and hinges on the miss, limits and obstacles (`terms`).

The search for a path round the obstacles has no derivative. From its path, least squares lead to a
point of least cost. This point moves smoothly with the case, and the implicit function theorem
gives its derivatives. Only hinges on limits and obstacles that are active contribute to them.
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

_SOONEST = 0.01  # least time of a meeting, as a share of the case's time

# Weights of each stage.
_FOLLOWING = Weights(follow=10.0, obstacle=0.0, early=0.0)
_KEEPING = Weights()
_SETTLING = Weights(effort=10.0)
_HURRYING = Weights(early=1000.0)  # replaces `_SETTLING` for meetings as early as possible
# Weight of an early meeting when the cost is differentiated: so small beside the weight of limits
# that the point of least cost stays within their slack.
_EARLY = 30.0


@struct.dataclass
class Stage:
    """A number of least-squares steps with the same weights."""

    weights: Weights
    steps: Array | int  # at most
    tolerance: Array | float = 1.0  # of `LevenbergConfig`; 1 ends at the first feasible point
    settled: Array | int = 1  # of `LevenbergConfig`
    only_feasible: Array | bool = False  # whether a point that breaks a limit is left unchanged


@struct.dataclass
class Guess:
    """A starting point of least squares, and the positions on a path of cells."""

    point: Array  # (n,), unknowns
    positions: Array  # (K, 2) [m], of the rear axle's middle at the knots 1..K


@dataclasses.dataclass(frozen=True)
class MotionProblem:
    """The least-squares problem of a planner; static.

    `SpacetimeIntercept` describes the fields.
    """

    meet: Literal["given", "early", "least"] = "given"
    pieces: int = 32
    samples: int = 3
    checked: int = 10

    @property
    def is_time_free(self) -> bool:
        """True if the meeting time is an unknown."""
        return self.meet != "given"

    @property
    def weights(self) -> Weights:
        """The cost weights of the last stage of least squares; early meetings weigh the time."""
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
        plan = make_plan(case, time, speed, curvature, samples=self.checked, points=12, steps=steps)
        return dataclasses.replace(plan, cost=time) if self.meet == "early" else plan

    def guess_at(self, point: Array) -> Guess:
        """Return a guess at unknowns (n,) for stages that follow no path of cells."""
        return Guess(point=point, positions=jnp.zeros((self.pieces, 2), point.dtype))

    def guess_along(self, case: InterceptCase, grid: Grid, path: CellPath, layer: Array) -> Guess:
        """Return a guess that follows a path of cells up to a layer () int32."""
        width = 2.0 * np.pi / grid.lattice.headings
        pace = case.limits.speed / (grid.lattice.levels - 1)
        steps = layer.astype(pace.dtype) + 0.5
        at = jnp.arange(1, self.pieces + 1, dtype=steps.dtype) * (steps / self.pieces)  # in steps

        def interpolate(values: Array, first: Array, at: Array) -> Array:
            """Interpolate values on the path: `first` at time 0, then one value at every step."""
            at = jnp.clip(at - 1.0, -1.0, layer.astype(at.dtype) - 1.0)
            below = jnp.floor(at).astype(jnp.int32)
            share, is_first = (
                each.reshape(-1, *[1] * (values.ndim - 1))
                for each in (at - below.astype(at.dtype), below < 0)
            )
            low = jnp.where(is_first, first, values[jnp.maximum(below, 0)])
            return (1.0 - share) * low + share * values[jnp.minimum(below + 1, layer - 1)]

        speed = interpolate(pace * path.level.astype(grid.cell.dtype), case.speed, at)
        bins = width * path.bin.astype(grid.cell.dtype)
        straight = jnp.round(bins[0] / (2.0 * np.pi)) * 2.0 * np.pi  # bin 0 plus whole turns
        after, before = (interpolate(bins, straight, at + half) for half in (0.5, -0.5))
        rate = (after - before) / grid.step
        # The car starts with a rate of its own: the first two rates make up for the lag in heading.
        time = steps * grid.step
        knot = time / self.pieces
        first = case.speed * case.curvature
        turned = 0.5 * knot * (first + 2.0 * rate[0] + rate[1])
        lag = interpolate(bins, straight, at)[1] - straight - turned
        rate = rate.at[:2].add(0.5 * lag / knot)
        curvature = rate / jnp.maximum(speed, 0.3 * case.limits.speed)
        limit = case.limits.curvature
        point = self.pack(speed, jnp.clip(curvature, -limit, limit), time)
        cells = grid.corner[None] + grid.cell * path.cell.astype(grid.cell.dtype)
        return Guess(point=point, positions=interpolate(cells, case.start[:2], at - 0.5))

    def build_model(
        self,
        point: Array,
        case: InterceptCase,
        field: DistanceField,
        weights: Weights,
        positions: Array,
        discs: int = 3,
    ) -> Model:
        """Return the sum of squares at a point (n,) of unknowns, and its quadratic model.

        The cost of following is the distance from positions (K, 2) [m]. A static number of discs
        covers the body.
        """
        speed, curvature, time = self.unpack(case, point)
        drive = motion(case.start, time, speed, curvature, self.samples)
        limits, violation = limit_terms(case, time, speed, curvature, weights, 4)
        end, missed = meeting_terms(case, drive, time, weights)
        squares, close = obstacle_terms(case, field, drive, weights, discs)
        squares = squares.at[:, -1].add(following_terms(drive, positions, weights))
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
            # Penalise a meeting later than the case's time, and weigh an early one.
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
        """List the stages of a guess that is close to a plan."""
        margins = {"margin": attempt.margin, "slack": attempt.slack}
        keeping = Stage(dataclasses.replace(_KEEPING, **margins), attempt.solver.max_steps)
        if self.is_time_free:
            solver = attempt.solver
            keeping = dataclasses.replace(
                keeping, tolerance=solver.tolerance, settled=solver.settled
            )
        steps = attempt.settling
        weights = dataclasses.replace(self.weights, **margins)
        return [keeping, Stage(weights, steps, settled=steps, only_feasible=True)]

    def run_stages(
        self,
        case: InterceptCase,
        field: DistanceField,
        guess: Guess,
        attempt: Search | Warm,
        stages: list[Stage],
    ) -> tuple[Array, Array]:
        """Run S stages of least squares, each from the point at which the previous stage ended.

        Returns:
            points: (S, n), the ends of the stages.
            steps: () int32, of all stages together.
        """

        def run(state: tuple[Array, Array], stage: Stage) -> tuple[tuple, LevenbergState]:
            point, is_feasible = state
            most = jnp.where(stage.only_feasible & ~is_feasible, 0, stage.steps)
            config = dataclasses.replace(
                attempt.solver, max_steps=most, tolerance=stage.tolerance, settled=stage.settled
            )

            def model(x: Array) -> Model:
                return self.build_model(
                    x, case, field, stage.weights, guess.positions, attempt.discs
                )

            end = least_squares(model, point, config)
            return (end.point, end.model.violation <= 0.0), end

        # A loop over stages, so that all stages share one compiled step.
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
        """Return the plan after the last stage, or the plan before it if that is better."""
        points, steps = self.run_stages(case, field, guess, attempt, stages)
        plans = lax.map(lambda point: self.decode(case, point, steps), points[-2:])
        before, after = (jax.tree.map(lambda leaf, k=k: leaf[k], plans) for k in range(2))
        return select(after, before)

    def refine_solved(
        self, case: InterceptCase, field: DistanceField, plan: InterceptPlan, attempt: Search
    ) -> InterceptPlan:
        """Run the last stage from a plan if it is solved, and return the better plan."""
        guess = self.guess_at(self.pack(plan.speed[1:], plan.curvature[1:], plan.time))
        last = self.list_last_stages(attempt)[-1]
        steps = jnp.where(is_solved(plan.status), last.steps, 0)
        stage = dataclasses.replace(last, steps=steps, only_feasible=False)
        points, steps = self.run_stages(case, field, guess, attempt, [stage])
        return select(self.decode(case, points[0], plan.iterations + steps), plan)


@struct.dataclass
class StartedCase(InterceptCase):
    """A case with a starting point for least squares."""

    start_point: Array  # (n,) unknowns of a plan, constant under differentiation


@struct.dataclass
class _Context:
    case: StartedCase
    moving: StartedCase  # the case with its walls among the movers
    field: DistanceField  # without walls


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SmoothIntercept(OptimisedPlanner):
    """Planner that minimises the sum of squares of a `MotionProblem` from another plan."""

    case_type: ClassVar[type] = StartedCase
    adjoint: ClassVar[str] = "whole"
    problem: MotionProblem = MotionProblem()
    solver: LevenbergConfig = LevenbergConfig(2000, settled=12, tolerance=1e-9)
    # No rounds: least squares run until they converge.
    rounds: tuple[Round, ...] = (Round(solver=LbfgsConfig(max_steps=0)),)

    def prepare(self, case: StartedCase) -> _Context:
        """Return the case, and the same case with the walls as movers at standstill.

        Distances from movers are exact. Distances from the field of the walls are interpolated, so
        that their derivatives jump between nodes.
        """
        nowhere = jnp.full((2, 2), 1e3, case.lower.dtype)
        return _Context(
            case=case,
            moving=dataclasses.replace(case, movers=join_obstacles(case.walls, case.movers)),
            field=DistanceField(values=nowhere, corner=case.lower, spacing=case.time),
        )

    def guesses(self, context: _Context, num: int) -> Array:
        """Return the point of least cost, (num, n): the same point for every guess."""
        fixed = lax.stop_gradient(context)
        start = fixed.case.start_point
        end = least_squares(lambda x: self._exact_model(x, fixed), start, self.solver)
        return jnp.broadcast_to(end.point, (num, *end.point.shape))

    def _model(self, point: Array, context: _Context) -> Model:
        """Return the sum of squares and its quadratic model."""
        problem = self.problem
        weights = dataclasses.replace(problem.weights, early=_EARLY)
        positions = problem.guess_at(point).positions
        return problem.build_model(point, context.moving, context.field, weights, positions)

    def _exact_model(self, point: Array, context: _Context) -> Model:
        """Return the model with the exact gradient of the cost.

        The problem's own gradient neglects how the limit on the rate of curvature changes with the
        curvature.
        """
        model = self._model(point, context)
        gradient = jax.grad(lambda x: self.objective(x, context).cost)(point)
        # The `gradient` of a `Model` is half the slope of the cost
        return dataclasses.replace(model, gradient=0.5 * gradient)

    def objective(self, point: Array, context: _Context) -> Evaluation:
        """Return the sum of squares and the largest violation at a point (n,)."""
        model = self._model(point, context)
        return Evaluation(cost=model.cost, violation=model.violation)

    def decode(self, point: Array, context: _Context) -> InterceptPlan:
        """Return the plan of a point."""
        return self.problem.decode(context.case, point, jnp.zeros((), jnp.int32))

    def with_polish(self, solver: NewtonConfig | None = None) -> "SmoothIntercept":
        """Return the planner itself: its plans are optimal already."""
        return self


def add_start(case: InterceptCase, point: Array) -> StartedCase:
    """Return a case, or a batch, with a starting point (n,) or (B, n)."""
    return StartedCase(**vars(case), start_point=lax.stop_gradient(point))
