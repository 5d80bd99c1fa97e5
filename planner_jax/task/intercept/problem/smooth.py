"""The cost of an interception as a `Problem`, whose minimum `pj.gradient` differentiates."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.optimise.efforts import NO_SEARCH
from planner_jax.optimise.levenberg import LevenbergConfig, Model, least_squares
from planner_jax.optimise.planner import Problem
from planner_jax.optimise.settings import Attempts, Evaluation
from planner_jax.plane.distance_field import DistanceField
from planner_jax.plane.obstacles import join_obstacles
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.problem.motion_problem import MotionProblem
from planner_jax.task.intercept.units import Units, enter_units, leave_units, units_of

# Weight of the meeting time in the cost that `pj.gradient` differentiates. It is small, so that the
# minimum exceeds no limit: penalties on limits start before a limit is reached.
_EARLY = 80.0


@struct.dataclass
class StartedCase(InterceptCase):
    """An interception to plan, and the unknowns of a known plan, from which least squares start."""

    start_point: Array  # (n,) unknowns, treated as constant when the case is differentiated


@struct.dataclass
class _Context:
    case: StartedCase
    units: Units
    moving: InterceptCase  # the case in its units, with its walls added to the movers, at speed 0
    field: DistanceField  # distances of a map without walls


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SmoothIntercept(Problem):
    """The cost of a `MotionProblem`, minimised from a plan; used by `pj.gradient`."""

    case_type: ClassVar[type] = StartedCase
    adjoint: ClassVar[str] = "whole"
    guesses_minima: ClassVar[bool] = True
    attempts: ClassVar[Attempts] = NO_SEARCH
    problem: MotionProblem = MotionProblem()
    solver: LevenbergConfig = LevenbergConfig(2000, settled=12, tolerance=0.0)

    def prepare(self, case: StartedCase) -> _Context:
        """Return the case, and a copy in which the walls are moving obstacles with speed 0.

        Distances from moving obstacles are computed exactly. Distances from walls are usually
        interpolated on a grid, so that their derivatives are discontinuous.
        """
        units = units_of(case)
        local = enter_units(case, units)
        none = jnp.zeros_like(local.start[:2])
        return _Context(
            case=case,
            units=units,
            moving=dataclasses.replace(local, movers=join_obstacles(local.walls, local.movers)),
            field=DistanceField(
                values=jnp.full((2, 2), 1e3, none.dtype), corner=none, spacing=none + 1.0
            ),
        )

    def guesses(self, context: _Context, num: int) -> Array:
        """Minimise the cost, from the plan stored in the case; return the n unknowns, (num, n).

        All rows are equal, because there is only one stored plan.
        """
        fixed = lax.stop_gradient(context)
        start = self.problem.enter_units(fixed.case.start_point, fixed.units)
        end = least_squares(lambda x: self._exact_model(x, fixed), start, self.solver)
        return jnp.broadcast_to(end.point, (num, *end.point.shape))

    def _model(self, point: Array, context: _Context) -> Model:
        problem = self.problem
        weights = dataclasses.replace(problem.weights, early=_EARLY)
        positions = problem.guess_at(point).positions
        return problem.build_model(point, context.moving, context.field, weights, positions)

    def _exact_model(self, point: Array, context: _Context) -> Model:
        # The gradient of `build_model` neglects that the ratio of steering rate to rate of
        # curvature depends on the curvature. Automatic differentiation is exact.
        model = self._model(point, context)
        gradient = jax.grad(lambda x: self.objective(x, context).cost)(point)
        return dataclasses.replace(model, gradient=0.5 * gradient)

    def objective(self, point: Array, context: _Context) -> Evaluation:
        """Return the cost at the unknowns `point`, and the largest relative excess over a limit."""
        model = self._model(point, context)
        return Evaluation(cost=model.cost, violation=model.violation)

    def decode(self, point: Array, context: _Context) -> InterceptPlan:
        """Return the plan of the unknowns `point`: speeds, curvatures and, if free, the time."""
        problem = self.problem
        plan = problem.decode(context.moving, point, jnp.zeros((), jnp.int32))
        return leave_units(plan, context.case, context.units, is_early=problem.meet == "early")


def add_start(case: InterceptCase, point: Array) -> StartedCase:
    """Add to a case, or a batch, the unknowns `point` from which least squares start."""
    return StartedCase(**vars(case), start_point=lax.stop_gradient(point))
