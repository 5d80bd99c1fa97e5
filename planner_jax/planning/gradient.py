"""`gradient`: plans, and how one of their numbers changes with the case."""

import functools
from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import jax
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.checks import require_kind, require_switch
from planner_jax.core.errors import ArgumentTypeError
from planner_jax.core.protocol import Plan
from planner_jax.core.rules import fields_of
from planner_jax.optimise.sensitivity import Differentiated, Quantity, part_of
from planner_jax.optimise.settings import LbfgsConfig, NewtonConfig, Solver
from planner_jax.planning.plan import plan, require_fit

PlanT = TypeVar("PlanT", bound=Plan)


@struct.dataclass
class PlanGradient(Generic[PlanT]):
    """Plans, a number of each, and its gradient; leaves with the batch shape of the cases."""

    plans: PlanT
    value: Array  # ()
    by: dict[str, Any]  # name -> what the case has there, of d value / d leaf
    # () how exact the adjoint is, 0 if it is; NaN, and so is `by`, where the cost of the plan does
    # not curve upward, so that there is no minimum to follow.
    residual: Array


def gradient(
    planner: PyTree,
    cases: PyTree,
    *,
    of: Quantity,
    by: str | Sequence[str],
    steps: int | None = None,
    curvature: str | None = None,
    solver: Solver | None = None,
    polish: bool = True,
    chunk: int | None = None,
    devices: Sequence[jax.Device] | None = None,  # pyright: ignore[reportInvalidTypeForm]
) -> PlanGradient:
    """`plan`, and the gradient of one number of every plan by parts of its case.

    The gradient is that of an optimum, by the implicit function theorem. A plan that the solver
    left before its optimum has none: what comes back there is the theorem's formula at the
    plan's point, which need not even have the right sign, or NaN where the cost does not curve
    upward. So Newton's method goes on from the planner's first search, and plans are better than
    those of `plan`. For contact times of 1,024 serves in float32 the relative error to the gradient
    of the optimum in float64 is 0.01 % at the median and 0.7 % or less for 99 of 100; for catches
    it is 0.02 and 3.1 %. `optimal_plan` in float64 is the exact and slow way.

    Args:
        planner: one that minimises, such as `pj.hit.planner("exact")`. What it decides on first,
            such as an order or the way round obstacles, is kept fixed.
        cases: one case or a batch.
        of: the number: names joined by dots, such as "stroke.time", "cost" or "violation", or a
            function of one plan. A function is compiled for anew with every new function object.
        by: a place in the case, or some, such as "racket_height", "limits", "net.radius" or
            "extras.0.radius".
        steps: of the conjugate gradients for the adjoint, by default as many as suit the
            curvature; 0 is exact for "cost", by the envelope theorem.
        curvature: "products", the default, takes those of the whole Hessian, exact where limits
            bind too; "whole" is preconditioned by the Hessian itself, at the cost of some n solver
            iterations, and the default of planners that search for a way first, such as
            `pj.intercept.planner("spacetime")`.
        solver: one search with this in the place of the planner's rounds.
        polish: whether the first round goes on to the optimum, unless there is a `solver`; plans
            of a planner that searches for a way first are there already.
        chunk: as for `plan`.
        devices: as for `plan`.

    Raises:
        TypeError: the planner does not minimise, the cases are of another task, or an argument is
            of another kind.
        ValueError: a name is not of the plan or the case, `steps` < 0, or `curvature` is unknown.
    """
    require_fit(planner, cases)
    if not isinstance(by, str | Sequence):
        raise ArgumentTypeError("by", "a name or some", by)
    if solver is not None:
        require_kind("solver", solver, LbfgsConfig, NewtonConfig)
    require_switch("polish", polish)
    by = (by,) if isinstance(by, str) else tuple(by)
    for name in by:
        part_of(cases, name)
    plan_of = functools.partial(plan, chunk=chunk, devices=devices)
    minimiser, cases = planner.settle(cases, plan_of)
    if solver is not None:
        minimiser = minimiser.with_solver(solver)
    elif polish:
        minimiser = minimiser.polished()
    differentiated = Differentiated(minimiser, of, by, steps, curvature or minimiser.adjoint)
    plans = plan(differentiated, cases, chunk=chunk, devices=devices)
    return PlanGradient(plans=plans.whole_plan(), **fields_of(plans.gradient))
