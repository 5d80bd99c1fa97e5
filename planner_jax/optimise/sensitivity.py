"""Gradients of many plans at once: one adjoint solve for each plan.

For a number q(u, theta) of a plan, where u minimises cost(u, theta) and theta is the case,

    dq/dtheta = q_theta - lambda^T cost_utheta,   cost_uu lambda = q_u,

where indices denote derivatives. This is the adjoint form of the implicit function theorem, and
lambda is the adjoint vector. Conjugate gradients [Hestenes1952] solve for lambda in a few steps.
They use the problem's products with the Hessian (`Problem.curvature_at`), or the whole
Hessian. lambda^T cost_utheta is a part of the derivative of the cost's gradient along lambda.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.checks import numeric
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.protocol import Plan
from planner_jax.optimise.around import ProblemAround
from planner_jax.optimise.composed import Composed
from planner_jax.optimise.planner import Problem, pending
from planner_jax.optimise.preconditioner import positive_inverse
from planner_jax.optimise.settings import Curvature


@dataclasses.dataclass(frozen=True)
class Numbers:
    """K numbers of a plan, which depend on the plan and also directly on its case."""

    function: Callable[[PyTree, PyTree], Array]  # takes plan and case; returns (K,)


Quantity = str | Numbers | Callable[[PyTree], Array]
Product = Callable[[Array], Array]  # product of a matrix with a vector (n,)
_CURVATURES = ("products", "whole")
# Number of iterations of conjugate gradients, by the setting `curvature`, for about 40 unknowns.
_STEPS = {"products": 40, "whole": 1}
_DAMPING = 1e-9  # damping of the preconditioner for products; negligible beside the Hessian
# Greatest relative decrease of the cost that a Newton step from an optimum predicts, by the
# precision of the numbers.
_STATIONARY = {np.dtype(np.float32): 1e-4, np.dtype(np.float64): 1e-6}
_SMALL = 1e-11  # squared relative residual at which conjugate gradients stop


@struct.dataclass
class Gradient:
    """The value of one number of a plan, and its gradient by parts of the case.

    For K `Numbers`, value, residual and the leaves of `by` have a leading axis K.
    """

    value: Array  # ()
    by: dict[str, PyTree]  # for each name a part of the case, whose leaves are d value / d leaf
    # () Relative decrease of the cost that a Newton step from the plan predicts; 0 at an optimum.
    # Above 1e-4 (1e-6 in float64) the plan is no optimum, and `by` is NaN.
    stationarity: Array
    # () Relative residual of the linear equation for the adjoint vector, in the preconditioner's
    # norm; 0 if its solution is exact. It does not measure the distance to the optimum. The
    # residual and `by` are NaN if the Hessian is not positive along the first direction of
    # conjugate gradients, because the point is then no minimum.
    residual: Array


@struct.dataclass
class DifferentiatedPlan(Plan):
    """A planner's plan, together with the gradient of one of its numbers."""

    plan: PyTree
    gradient: Gradient

    def whole_plan(self) -> PyTree:
        """Return the inner plan with the cost, iterations and status that the solver found."""
        return self.plan.replace(cost=self.cost, iterations=self.iterations, status=self.status)


@struct.dataclass
class _Context:
    case: PyTree
    inner: PyTree


@struct.dataclass
class Differentiated(ProblemAround):
    """A problem that adds the gradient of one number to the plans of the inner problem."""

    problem: Problem
    # The differentiated number: a dotted name in the plan, such as "stroke.time", or a function.
    quantity: Quantity = struct.field(pytree_node=False)
    by: tuple[str, ...] = struct.field(pytree_node=False)  # dotted names in the case
    # Number of iterations of conjugate gradients; None: 40, or 1 if `curvature` is "whole".
    steps: int | None = struct.field(pytree_node=False, default=None)
    curvature: str = struct.field(pytree_node=False, default="products")  # see `gradient_at`

    def __post_init__(self) -> None:
        if not isinstance(self.curvature, str) or self.curvature not in _CURVATURES:
            known = ", ".join(_CURVATURES)
            raise ArgumentError("curvature", f"one of {known}", self.curvature)
        if self.steps is not None:
            require_size("steps", self.steps, 0)
        if not callable(self.quantity) and not isinstance(self.quantity, str | Numbers):
            raise ArgumentTypeError("of", "a name or a function of a plan", self.quantity)
        if not self.by:
            raise ArgumentError("by", "something in the case", verb="name", shown="nothing")

    def prepare(self, case: PyTree) -> _Context:
        """Return a case, and the data that the inner problem prepares for it."""
        return _Context(case=case, inner=self.problem.prepare(case))

    def guesses(self, context: _Context, num: int) -> Array:
        """Return the first `num` starting points (num, n) of the inner problem."""
        return self.problem.guesses(context.inner, num)

    @property
    def held(self) -> np.ndarray | None:
        """Mask (n,) of variables that searches with `Stage.frozen` keep constant; None if none."""
        return self.problem.held

    def network_inputs(self, context: _Context) -> Array:
        """Return the features (F,) of a case for the inner problem's network."""
        return self.problem.network_inputs(context.inner)

    def first_start(self, guess: Array, features: Array, context: _Context) -> Array:
        """Return the first starting point (n,) of the inner problem."""
        return self.problem.first_start(guess, features, context.inner)

    def objective(self, point: Array, context: _Context) -> tuple[Array, Array]:
        """Evaluate the objective of the inner problem at a point (n,)."""
        return self.problem.objective(point, context.inner)

    def curvature_at(self, point: Array, context: _Context) -> Curvature:
        """Return the derivatives of the inner problem's objective at a point (n,)."""
        return self.problem.curvature_at(point, context.inner)

    def rules_out(self, context: _Context) -> Array:
        """Return whether the inner problem proves that no plan exists."""
        return self.problem.rules_out(context.inner)

    def decode(self, point: Array, context: _Context) -> DifferentiatedPlan:
        """Return the inner plan at a point (n,), with the gradient of its number `quantity`."""
        plan = self.problem.decode(point, context.inner)
        return DifferentiatedPlan(
            plan=plan,
            gradient=gradient_at(
                self.problem,
                context.case,
                point,
                self.quantity,
                self.by,
                self.steps,
                self.curvature,
            ),
            **pending(plan.violation),
        )


def gradient_at(
    problem: Problem,
    case: PyTree,
    point: Array,
    quantity: Quantity,
    by: tuple[str, ...],
    steps: int | None = None,
    curvature: str = "products",
) -> Gradient:
    """Return the gradient of one number of a plan by parts of its case, at a point; pure.

    Args:
        problem: the problem whose objective the point minimises.
        case: one case.
        point: (n,) minimiser of the problem's objective. At another point the result
            is not the gradient at the optimum.
        quantity: dotted name of a number in the plan, a function of the plan, or `Numbers`.
        by: dotted names of parts of the case, such as "limits.speed".
        steps: iterations of conjugate gradients, each with one product with the Hessian. They stop
            early if the Hessian is not positive. 0 sets the adjoint vector to zero, which is
            correct for "cost": its derivative at an optimum is the derivative at a fixed point
            (envelope theorem). None: 40 for "products", 1 for "whole".
        curvature: "products" uses the products with the Hessian, and the preconditioner, that the
            problem's `curvature_at` returns. "whole" uses the inverse of the full Hessian as
            preconditioner, which takes one product for each of n variables.

    Raises:
        ValueError: a name does not exist, or is not of floating-point numbers.
    """
    number = _quantity(quantity)
    parts = {name: part_of(case, name) for name in by}

    def change_case(parts: dict) -> PyTree:
        return functools.reduce(lambda s, name: replace_part(s, name, parts[name]), parts, case)

    if isinstance(problem, Composed):
        return _of_composed(problem, point, number, change_case, parts)
    context, pull = jax.vjp(lambda parts: problem.prepare(change_case(parts)), parts)
    smooth, context_of, cotangent_of = split_smooth(context)

    def cost(x: Array, smooth: list) -> Array:
        return problem.objective(x, context_of(smooth))[0]

    def value_of(x: Array, smooth: list, parts: dict) -> Array:
        plan = problem.decode(x, context_of(smooth)).replace(cost=cost(x, smooth))
        return number(plan, change_case(parts))

    value, pull_value = jax.vjp(value_of, point, smooth, parts)

    def differentiate(cotangent: Array) -> tuple[dict, Array, Array]:
        along_point, by_context, direct = pull_value(cotangent)
        adjoint, stationarity, residual = solve_adjoint(
            problem, context, point, along_point, steps, curvature
        )
        if steps != 0:
            mixed = problem.slopes_along(point, context_of, smooth, adjoint)
            by_context = [b - m for b, m in zip(by_context, mixed, strict=True)]
        (by_parts,) = pull(cotangent_of(by_context))
        by_parts = jax.tree.map(jnp.add, by_parts, direct)
        return by_parts, stationarity, residual

    by_parts, stationarity, residual = _for_each(differentiate, value)
    holds = jnp.isfinite(value) & is_optimum(stationarity, residual)
    return Gradient(value, _where(holds, by_parts), stationarity, residual)


def _for_each(differentiate: Callable, value: Array) -> tuple[dict, Array, Array]:
    """Differentiate one number (), or K numbers (K,), by their unit cotangents."""
    if not value.shape:
        return differentiate(jnp.ones_like(value))
    units = jnp.eye(len(value), dtype=value.dtype)
    by_parts, stationarity, residual = jax.lax.map(differentiate, units)
    return by_parts, jnp.max(stationarity), residual


def _where(holds: Array, by_parts: dict) -> dict:
    """Replace the derivatives of the numbers by NaN where they do not hold, () or (K,) bool."""

    def mask(leaf: Array) -> Array:
        return jnp.where(
            holds.reshape(holds.shape + (1,) * (leaf.ndim - holds.ndim)), leaf, jnp.nan
        )

    return jax.tree.map(mask, by_parts)


def _of_composed(
    problem: Composed, point: Array, number: Callable, change_case: Callable, parts: dict
) -> Gradient:
    """Return the gradient of one number of a plan that is composed of minima; see `gradient_at`."""

    def value_of(parts: dict, meters: Array) -> tuple[Array, Array]:
        case = change_case(parts)
        plan = problem.compose(point, case, meters)
        return number(plan, case), problem.is_kept(plan)

    meters = jnp.zeros((problem.num_minima(change_case(parts)), 2), point.dtype)
    value, pull, is_kept = jax.vjp(value_of, parts, meters, has_aux=True)

    def differentiate(cotangent: Array) -> tuple[dict, Array, Array]:
        by_parts, measured = pull(cotangent)
        stationarity, residual = jnp.max(measured, axis=0)
        return by_parts, stationarity, residual

    by_parts, stationarity, residual = _for_each(differentiate, value)
    holds = jnp.isfinite(value) & is_kept
    return Gradient(value, _where(holds, by_parts), stationarity, residual)


def split_smooth(context: PyTree) -> tuple[list[Array], Callable, Callable]:
    """Return the floating leaves of a problem's data, and two functions of a list of such leaves.

    The first function returns the data with these leaves; the second one returns the data's
    cotangent, which has no derivative by the other leaves.
    """
    leaves, treedef = jax.tree.flatten(context)
    is_smooth = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]

    def merge(smooth: list, others: list) -> PyTree:
        taken = iter(smooth)
        both = zip(others, is_smooth, strict=True)
        return jax.tree.unflatten(treedef, [next(taken) if flag else leaf for leaf, flag in both])

    def cotangent_of(smooth: list) -> PyTree:
        return merge(smooth, [np.zeros(leaf.shape, jax.dtypes.float0) for leaf in leaves])

    smooth = [leaf for leaf, flag in zip(leaves, is_smooth, strict=True) if flag]
    return smooth, lambda smooth: merge(smooth, leaves), cotangent_of


def solve_adjoint(
    problem: Problem, context: PyTree, point: Array, rhs: Array, steps: int | None, curvature: str
) -> tuple[Array, Array, Array]:
    """Solve cost_uu lambda = rhs at a point (n,), as `gradient_at` explains.

    Returns:
        The adjoint vector lambda (n,), and the fields `stationarity` and `residual` of `Gradient`.
    """
    steps = _STEPS[curvature] if steps is None else steps
    here = problem.curvature_at(point, context)
    if curvature == "products":
        solve = here.preconditioner(jnp.asarray(_DAMPING, point.dtype))
        product = here.products()
    else:
        solve, product = _by_whole_hessian(here.products(), point)
    decrease = 0.5 * jnp.sum(here.gradient * solve(here.gradient))
    stationarity = decrease / jnp.maximum(jnp.abs(here.evaluation.cost), 1e-30)
    if steps == 0:
        residual = jnp.where(jnp.any(rhs != 0.0), jnp.ones_like(stationarity), 0.0)
        return jnp.zeros_like(rhs), stationarity, residual
    # The unit prevents that squares of small numbers vanish, as in derivatives that are rounding.
    largest = jnp.max(jnp.abs(rhs))
    unit = jnp.where(largest > 0.0, largest, 1.0)
    adjoint, residual = _adjoint(solve, product, rhs / unit, steps)
    return unit * adjoint, stationarity, residual


def is_optimum(stationarity: Array, residual: Array) -> Array:
    """Return whether the implicit function theorem holds, () bool, by two fields of `Gradient`."""
    return jnp.isfinite(residual) & (stationarity <= _STATIONARY[stationarity.dtype])


def _by_whole_hessian(product: Product, point: Array) -> tuple[Product, Product]:
    inverse = positive_inverse(jax.vmap(product)(jnp.eye(point.shape[0], dtype=point.dtype)))
    return lambda right: jnp.sum(inverse * right[None], axis=1), product


def _adjoint(solve: Product, product: Product, rhs: Array, steps: int) -> tuple[Array, Array]:
    """Solve H x = rhs by conjugate gradients; return x (n,) and the relative residual ().

    `product` multiplies by the Hessian H, and `solve` is the preconditioner. The residual is NaN if
    H is not positive along the first direction.
    """

    def going(state: tuple) -> Array:
        num, _, _, _, size, curved = state
        return (num < steps) & (size > _SMALL * first) & curved

    def step(state: tuple) -> tuple:
        num, found, left, direction, size, _ = state
        image = product(direction)
        curvature = jnp.sum(direction * image)
        curved = curvature > 0.0
        length = jnp.where(curved, size / jnp.where(curved, curvature, 1.0), 0.0)
        found, left = found + length * direction, left - length * image
        turned = solve(left)
        after = jnp.sum(left * turned)
        direction = turned + after / jnp.where(size > 0.0, size, 1.0) * direction
        return num + 1, found, left, direction, jnp.where(curved, after, size), curved

    turned = solve(rhs)
    first = jnp.sum(rhs * turned)
    start = 0, jnp.zeros_like(rhs), rhs, turned, first, jnp.ones((), bool)
    num, found, _, _, size, curved = jax.lax.while_loop(going, step, start)
    defined = curved | (num > 1)
    ratio = size / jnp.where(first > 0.0, first, 1.0)
    return found, jnp.where(defined, jnp.sqrt(jnp.maximum(ratio, 0.0)), jnp.nan)


def part_of(tree: PyTree, name: str) -> PyTree:
    """Return the part of a case that a dotted name selects; tuple entries are named by index.

    Raises:
        ValueError: there is no such part, or it is not of floating-point numbers.
    """
    part = _find_part(tree, name, "by")
    for leaf in jax.tree.leaves(part):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ArgumentError("by", "floating numbers", name, verb="name")
    return jax.tree.map(jnp.asarray, part)


def _find_part(tree: PyTree, name: str, argument: str) -> PyTree:
    if not isinstance(name, str):
        raise ArgumentTypeError(argument, "a name or some", name)
    part = tree
    for field in name.split("."):
        known = members_of(part)
        if field not in known:
            raise ArgumentError(
                argument,
                f"a place in {type(tree).__name__}",
                verb="name",
                shown=f"{name!r}: {type(part).__name__} has {', '.join(known) or 'no fields'}",
            )
        part = known[field]
    return part


def members_of(tree: PyTree) -> dict[str, PyTree]:
    """Return parts by name: fields of a dataclass, entries of a tuple; other values have none."""
    if isinstance(tree, tuple):
        return {str(k): member for k, member in enumerate(tree)}
    return vars(tree) if dataclasses.is_dataclass(tree) else {}


def replace_part(tree: PyTree, name: str, part: PyTree) -> PyTree:
    """Return a case with another value of the part that a dotted name selects."""
    first, _, rest = name.partition(".")
    inner = replace_part(members_of(tree)[first], rest, part) if rest else part
    if isinstance(tree, tuple):
        return tuple((members_of(tree) | {first: inner}).values())
    return dataclasses.replace(tree, **{first: inner})


def _quantity(quantity: Quantity) -> Callable[[PyTree, PyTree], Array]:
    if isinstance(quantity, Numbers):
        return quantity.function

    def number(plan: PyTree, _: PyTree) -> Array:
        value = quantity(plan) if callable(quantity) else _find_part(plan, quantity, "of")
        if numeric(value) is None:
            raise ArgumentTypeError("of", "one number", value)
        if value.shape:
            raise ArgumentError("of", "one number", shown=f"shape {value.shape}")
        return value

    return number
