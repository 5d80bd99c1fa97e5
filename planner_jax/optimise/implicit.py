"""Optima that are differentiable by the implicit function theorem, such as `pj.optimal_plan`.

Let theta be the numbers of the case, and u* the variables that minimise the objective J(u, theta).
There the gradient J_u vanishes, so du*/dtheta = -J_uu^-1 J_utheta. This takes one linear solve with
the Hessian J_uu. The solver's iterations are not differentiated.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.checks import require_kind
from planner_jax.core.compiled import with_own_precision
from planner_jax.core.errors import ArgumentError
from planner_jax.core.origin import with_origin
from planner_jax.core.planner import Planner, require_fit
from planner_jax.core.protocol import mark_bad_input, status_of
from planner_jax.optimise.multistart import minimise
from planner_jax.optimise.planner import Problem
from planner_jax.optimise.sensitivity import is_optimum, solve_adjoint, split_smooth
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, Objective


@struct.dataclass
class _Newton:
    """The state of Newton's method: the best point so far, and the next point to evaluate."""

    point: Array  # (n,)
    cost: Array  # ()
    slope: Array  # () norm of the gradient at `point`
    gradient: Array  # (n,)
    hessian: Array  # (n, n)
    damping: Array  # ()
    trial: Array  # (n,)
    iteration: Array  # () int32


def newton_refine(
    objective: Objective, point: Array, *, max_steps: int, stationarity: Array | float
) -> tuple[Array, Array]:
    """Move a nearly stationary point (n,) to the local optimum near it, by damped Newton steps.

    Negative eigenvalues of the Hessian are replaced by their absolute values. A step is accepted if
    it lowers the cost, or if it lowers the gradient's norm at a cost that is equal up to rounding.
    Otherwise the damping grows. The refinement ends after `max_steps` steps, or when the norm of
    the gradient is at most `stationarity`. This norm () is the second result.
    """

    def gradient(x: Array) -> tuple[Array, tuple[Array, Array]]:
        cost, slope = jax.value_and_grad(lambda y: objective(y).cost)(x)
        return slope, (cost, slope)

    def step(state: _Newton) -> _Newton:
        hessian, (cost, slope_vector) = jax.jacfwd(gradient, has_aux=True)(state.trial)
        slope = jnp.linalg.norm(slope_vector)
        rounding = 10.0 * jnp.finfo(cost.dtype).eps * jnp.abs(cost)
        better = (cost < state.cost) | ((cost <= state.cost + rounding) & (slope < state.slope))
        point, cost, slope, slope_vector, hessian = jax.tree.map(
            lambda new, old: jnp.where(better, new, old),
            (state.trial, cost, slope, slope_vector, hessian),
            (state.point, state.cost, state.slope, state.gradient, state.hessian),
        )
        damping = jnp.where(better, state.damping / 4.0, state.damping * 8.0)
        values, vectors = jnp.linalg.eigh(hessian)
        floor = jnp.max(jnp.abs(values)) * jnp.finfo(point.dtype).eps
        product = functools.partial(jnp.matmul, precision=lax.Precision.HIGHEST)
        along = product(slope_vector, vectors)
        newton = product(vectors, along / (jnp.maximum(jnp.abs(values), floor) + damping * slope))
        return _Newton(
            point, cost, slope, slope_vector, hessian, damping, point - newton, state.iteration + 1
        )

    def is_open(state: _Newton) -> Array:
        return (state.iteration < max_steps) & (state.slope > stationarity)

    n = point.shape[0]
    state = _Newton(
        point=point,
        cost=jnp.full((), jnp.inf, point.dtype),
        slope=jnp.full((), jnp.inf, point.dtype),
        gradient=jnp.zeros_like(point),
        hessian=jnp.zeros((n, n), point.dtype),
        damping=jnp.full((), 1e-3, point.dtype),
        trial=point,
        iteration=jnp.zeros((), jnp.int32),
    )
    state = lax.while_loop(is_open, step, state)
    return state.point, state.slope


@with_own_precision
def optimal_plan(planner: Planner, case: PyTree, *, solver: LbfgsConfig | None = None) -> PyTree:
    """Return the plan at the local optimum near the planner's guess, differentiable by the case.

    `jax.grad` and `jax.jacobian` of any number in the plan, by any leaf of the case, use the
    implicit function theorem. Use float64 (`jax.enable_x64`) for more than two correct digits.

    Args:
        planner: a planner that minimises. If it first chooses an order of the targets or finds a
            path around obstacles, derivatives treat this order or path as a constant.
        case: one case; derivatives are by its leaves.
        solver: settings of the search before the refinement; 200 iterations by default.

    Returns:
        The planner's plan. If its status is not CONVERGED, the point is not stationary or breaks a
        limit, and its gradients are meaningless.

    Raises:
        TypeError: the planner does not minimise, or the case is of another task.
        ValueError: the case is a batch.
    """
    require_fit(planner, case)
    if solver is not None:
        require_kind("solver", solver, LbfgsConfig)
    if case.batch_shape != ():
        shown = f"batch shape {case.batch_shape}; for batches use pj.gradient or jax.vmap"
        raise ArgumentError("case", "one case", shown=shown)
    minimiser, case = planner.settle(case)
    problem = minimiser.problem
    solver = solver or LbfgsConfig(max_steps=200, tolerance=1e-7, patience=6)
    context = problem.prepare(case)
    start = lax.stop_gradient(problem.first_guess(context))
    # A gradient with a norm below this multiple of the cost can be due to rounding errors alone.
    stationarity = 1e2 * float(jnp.finfo(start.dtype).eps)

    def cost(point: Array) -> Array:
        return problem.objective(point, context)[0]

    def solve(_: Callable, start: Array) -> tuple[Array, Array]:
        def objective(point: Array):
            return Evaluation(*problem.objective(point, context))

        found = minimise(objective, start, solver)
        tolerance = stationarity * jnp.abs(found.evaluation.cost)
        point, slope = newton_refine(objective, found.point, max_steps=100, stationarity=tolerance)
        return point, slope / tolerance

    def tangent_solve(hessian_product: Callable[[Array], Array], rhs: Array) -> Array:
        return jnp.linalg.solve(jax.jacobian(hessian_product)(rhs), rhs)

    point, excess = lax.custom_root(jax.grad(cost), start, solve, tangent_solve, has_aux=True)
    plan = problem.decode(point, context).replace(cost=cost(point))
    plan = plan.replace(status=status_of(plan.cost, plan.violation, excess <= 1e3))
    return with_origin(mark_bad_input(plan, case), case)


@functools.partial(jax.custom_vjp, nondiff_argnums=(4, 5))
def implicit_point(
    problem: Problem,
    case: PyTree,
    point: Array,
    meter: Array | None = None,
    steps: int | None = None,
    curvature: str | None = None,
) -> Array:
    """Return a stationary point (n,) unchanged, with the derivative of the optimum by the case.

    Reverse mode uses the implicit function theorem: the optimum of one problem may enter the case
    of another one. The function is pure, for use under `jax.jit`, `jax.vmap` and `jax.grad`.

    The derivative is NaN if the point is not stationary, or if the Hessian is not positive there,
    unless nothing depends on the point. It is correct to first order only at a stationary point.

    Args:
        problem: the problem whose objective the point minimises; its numbers are constants.
        case: one case.
        point: (n,) minimiser of the objective, such as an entry of `problem.guesses` if the guesses
            are minima. It is a constant.
        meter: (2,) zeros. The gradient by `meter` is no derivative: its entries are `stationarity`
            and `residual` of the reverse pass, as in `sensitivity.Gradient`, or 0 if unused.
        steps: as in `sensitivity.gradient_at`.
        curvature: as in `sensitivity.gradient_at`; None: the problem's own setting `adjoint`.
    """
    return point


def _keep(
    problem: Problem,
    case: PyTree,
    point: Array,
    meter: Array | None,
    steps: int | None,
    curvature: str | None,
) -> tuple[Array, tuple]:
    return point, (problem, case, point, meter)


def _differentiate(
    steps: int | None, curvature: str | None, kept: tuple, along_point: Array
) -> tuple[PyTree, PyTree, Array, Array | None]:
    problem, case, point, meter = kept
    context, pull = jax.vjp(problem.prepare, case)
    smooth, context_of, cotangent_of = split_smooth(context)
    adjoint, stationarity, residual = solve_adjoint(
        problem, context, point, along_point, steps, curvature or problem.adjoint
    )
    mixed = problem.slopes_along(point, context_of, smooth, adjoint)
    (by_case,) = pull(cotangent_of([-each for each in mixed]))
    is_used, holds = jnp.any(along_point != 0.0), is_optimum(stationarity, residual)

    def mask(leaf: Array) -> Array:
        if leaf.dtype == jax.dtypes.float0:
            return leaf
        return jnp.where(is_used, jnp.where(holds, leaf, jnp.nan), 0.0)

    by_problem = jax.tree.map(_no_derivative, problem)
    measured = jnp.where(is_used, jnp.stack([stationarity, residual]), 0.0)
    by_meter = None if meter is None else measured
    return by_problem, jax.tree.map(mask, by_case), jnp.zeros_like(point), by_meter


def _no_derivative(leaf: Array) -> np.ndarray:
    is_smooth = jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
    return np.zeros(np.shape(leaf), jnp.result_type(leaf) if is_smooth else jax.dtypes.float0)


implicit_point.defvjp(_keep, _differentiate)
