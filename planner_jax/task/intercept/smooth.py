"""The smooth problem about an interception: what its derivatives follow.

Which way round the obstacles a car goes is searched for, and the search has no derivative. From
there least squares lead to a point of least cost, and that point moves smoothly with the case: its
derivatives are those of the implicit function theorem. Obstacles and limits are hinges in the cost,
so that those which bind pull, and the others say nothing.
"""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.optimise.evaluation import Evaluation
from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.levenberg import LevenbergConfig, Model, least_squares
from planner_jax.optimise.newton import NewtonConfig
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.problem import Round
from planner_jax.plane.distance_field import DistanceField
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.terms import together

if TYPE_CHECKING:
    from planner_jax.task.intercept.default_planner import SpacetimeIntercept


# What being early weighs: so little beside the limits that the least cost lies within their slack.
_EARLY = 30.0


@struct.dataclass
class BegunCase(InterceptCase):
    """A case of which the way round the obstacles is settled."""

    begun: Array  # (n,) unknowns of a plan, constant to derivatives


@struct.dataclass
class _Context:
    case: BegunCase
    moving: BegunCase
    field: DistanceField  # of nothing


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SmoothIntercept(OptimisedPlanner):
    """Least squares from a plan of `SpacetimeIntercept` to where its cost is stationary.

    The cost of its plans is the sum of squares that `SpacetimeIntercept` takes steps by: effort,
    and hinges on the miss, limits and obstacles.
    """

    case_type: ClassVar[type] = BegunCase
    adjoint: ClassVar[str] = "whole"
    planner: "SpacetimeIntercept"
    solver: LevenbergConfig = LevenbergConfig(2000, settled=12, tolerance=1e-9)
    # None of its own: least squares have been to the end.
    rounds: tuple[Round, ...] = (Round(solver=LbfgsConfig(max_steps=0)),)

    def prepare(self, case: BegunCase) -> _Context:
        """The case, and the same with walls that are movers at rest.

        From these distances are exact. The planner's own from what stands are interpolated, and
        their slope jumps from place to place.
        """
        nowhere = jnp.full((2, 2), 1e3, case.lower.dtype)
        return _Context(
            case=case,
            moving=dataclasses.replace(case, movers=together(case.walls, case.movers)),
            field=DistanceField(values=nowhere, corner=case.lower, spacing=case.time),
        )

    def guesses(self, context: _Context, num: int) -> Array:
        """Where least squares end, (1, n); there is one such place."""
        fixed = lax.stop_gradient(context)
        end = least_squares(lambda x: self.exact_model(x, fixed), fixed.case.begun, self.solver)
        return jnp.broadcast_to(end.point, (num, *end.point.shape))

    def model(self, point: Array, context: _Context) -> Model:
        """The sum of squares and its quadratic model."""
        planner = self.planner
        weights = dataclasses.replace(planner.weights, early=_EARLY)
        places = planner.guess_at(point).places
        return planner.model(point, context.moving, context.field, weights, places)

    def exact_model(self, point: Array, context: _Context) -> Model:
        """The same with the gradient of the cost itself.

        The planner's own leaves out how the greatest rate of curvature changes with the curvature.
        """
        model = self.model(point, context)
        gradient = jax.grad(lambda x: self.objective(x, context).cost)(point)
        return dataclasses.replace(model, gradient=0.5 * gradient)  # halved as the planner's own

    def objective(self, point: Array, context: _Context) -> Evaluation:
        """The sum of squares and the largest violation at a point (n,)."""
        model = self.model(point, context)
        return Evaluation(cost=model.cost, violation=model.violation)

    def decode(self, point: Array, context: _Context) -> InterceptPlan:
        """The plan of a point."""
        return self.planner.plan_at(context.case, point, jnp.zeros((), jnp.int32))

    def polished(self, solver: NewtonConfig | None = None) -> "SmoothIntercept":
        """Return the planner: its plans are optimal already."""
        return self


def begun_case(case: InterceptCase, begun: Array) -> BegunCase:
    """A case, or a batch, with the unknowns (n,) or (B, n) of a plan."""
    fields = {field.name: getattr(case, field.name) for field in dataclasses.fields(case)}
    return BegunCase(**fields, begun=lax.stop_gradient(begun))
