"""The smooth cost of blocks near known plans, which `pj.gradient` and `pj.optimal_plan` minimise.

Straight motions, learned starts and detours only determine where least squares start. The minimum
of the cost moves smoothly with the numbers of the case, and the implicit function theorem gives its
derivatives. Penalties that are zero at the minimum contribute nothing to the derivatives.
"""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.optimise.levenberg import LevenbergConfig, Model, least_squares
from planner_jax.optimise.near import Known, NearPlan
from planner_jax.optimise.preconditioner import positive_inverse
from planner_jax.optimise.settings import Curvature, Evaluation
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.problem.flight import Flight, flight_of
from planner_jax.task.block.search.least_squares import encode

if TYPE_CHECKING:
    from planner_jax.task.block.default_planner import OnlineBlock


@struct.dataclass
class StartedBlock(BlockCase, Known):
    """A block to plan, and the unknowns (n,) of a known plan, from which least squares start."""


class _Context(NamedTuple):
    case: StartedBlock
    flight: Flight


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SmoothBlock(NearPlan):
    """The cost that the planner `online` minimises by least squares, from a known plan.

    All samples of a motion contribute to the cost. The planner itself neglects all samples but the
    `worst` ones, so that its cost changes by steps.
    """

    case_type: ClassVar[type] = StartedBlock
    needs_double: ClassVar[bool] = True
    own: "OnlineBlock"
    solver: LevenbergConfig = LevenbergConfig(200, ease=0.1, settled=6, tolerance=0.0)

    def prepare(self, case: StartedBlock) -> _Context:
        """Return a case, and the times at which the ball may be met."""
        return _Context(case, flight_of(case))

    def known_of(self, cases: BlockCase, plans: BlockPlan) -> Array:
        """Return the unknowns (n,) of a plan, or (B, n) of a batch."""
        return (encode if cases.batch_shape == () else jax.vmap(encode))(plans)

    def find_minimum(self, context: _Context) -> Array:
        """Minimise the cost, from the plan stored in the case; return the n unknowns, (n,)."""
        model = lambda x: self._model(x, context)  # noqa: E731
        return least_squares(model, context.case.known, self.solver).point

    def _model(self, point: Array, context: _Context) -> Model:
        return self.own.model(point, context.case, context.flight)

    def objective(self, point: Array, context: _Context) -> Evaluation:
        """Return the cost at the unknowns `point`, and the largest relative excess over a limit."""
        model = self._model(point, context)
        return Evaluation(model.cost, model.violation)

    def slopes_along(self, x: Array, context_of: Callable, parts: PyTree, along: Array) -> PyTree:
        """Return the gradient, by parts of the context, of the slope at `x` (n,) along a vector.

        The slope follows from the residuals' derivatives, which compile faster than automatic
        differentiation of the cost.
        """

        def slope(parts: PyTree) -> Array:
            return jnp.sum(2.0 * self._model(x, context_of(parts)).gradient * along)

        return jax.grad(slope)(parts)

    def curvature_at(self, point: Array, context: _Context) -> Curvature:
        """Return gradient, products with the Hessian, and the inverse of the residuals' J'J."""
        model = self._model(point, context)

        def products(direction: Array) -> Array:
            slope = lambda x: 2.0 * self._model(x, context).gradient  # noqa: E731
            return jax.jvp(slope, (point,), (direction,))[1]

        def near_inverse(damping: Array):
            is_held = jnp.diagonal(model.curvature) == 0.0
            added = damping + jnp.where(is_held, 1.0, 0.0)
            inverse = positive_inverse(2.0 * model.curvature + jnp.diag(added))
            return lambda right: jnp.sum(inverse * jnp.where(is_held, 0.0, right)[None], axis=1)

        evaluation = Evaluation(model.cost, model.violation)
        return Curvature(evaluation, 2.0 * model.gradient, lambda: products, near_inverse)

    def decode(self, point: Array, context: _Context) -> BlockPlan:
        """Return the plan of the unknowns `point`: joint rates and time of contact."""
        return self.own.finish(context.case, context.flight, point, jnp.zeros((), jnp.int32))
