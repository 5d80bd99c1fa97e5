"""The cost of an interception as a `Problem`, whose minimum `pj.gradient` differentiates."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.optimise.levenberg import LevenbergConfig, Model, least_squares
from planner_jax.optimise.near import Known, NearPlan
from planner_jax.optimise.settings import Evaluation
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
class StartedCase(InterceptCase, Known):
    """An interception to plan, and the unknowns (n,) from which least squares start."""


@struct.dataclass
class _Context:
    case: StartedCase
    units: Units
    moving: InterceptCase  # the case in its units, with its walls added to the movers, at speed 0
    field: DistanceField  # distances of a map without walls


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SmoothIntercept(NearPlan):
    """The cost of a `MotionProblem`, minimised from a plan; used by `pj.gradient`."""

    case_type: ClassVar[type] = StartedCase
    adjoint: ClassVar[str] = "whole"
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

    def known_of(self, cases: InterceptCase, plans: InterceptPlan) -> Array:  # noqa: ARG002
        """Return the unknowns (n,) of a plan, or (B, n) of a batch."""
        return self.problem.pack(plans.speed[..., 1:], plans.curvature[..., 1:], plans.time)

    def find_minimum(self, context: _Context) -> Array:
        """Minimise the cost, from the plan stored in the case; return the n unknowns, (n,)."""
        start = self.problem.enter_units(context.case.known, context.units)
        return least_squares(lambda x: self._exact_model(x, context), start, self.solver).point

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
