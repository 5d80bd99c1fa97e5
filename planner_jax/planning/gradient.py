"""`pj.gradient`: it plans cases and differentiates one number of each plan by parts of its case."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Generic

import jax
import numpy as np
from flax import struct
from jaxtyping import PyTree
from numpy.typing import DTypeLike

from planner_jax.core.arithmetic import float_type
from planner_jax.core.checks import require_kind, require_switch
from planner_jax.core.compiled import with_own_precision
from planner_jax.core.errors import ArgumentTypeError
from planner_jax.core.origin import with_origin
from planner_jax.core.planner import PlanT
from planner_jax.core.rules import fields_of
from planner_jax.optimise.sensitivity import Differentiated, Gradient, Quantity, part_of
from planner_jax.optimise.settings import LbfgsConfig, NewtonConfig, Solver
from planner_jax.planning.plan import plan, require_fit
from planner_jax.planning.programs import Device


@struct.dataclass
class PlanGradient(Gradient, Generic[PlanT]):
    """Plans, and the value and gradient of one number of each plan, for one case or a batch."""

    plans: PlanT


@with_own_precision
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
    devices: Sequence[Device] | None = None,
) -> PlanGradient:
    """Plan cases, and differentiate one number of every plan by parts of its case.

    The gradient follows from the implicit function theorem, which holds at an optimum. Newton's
    method therefore continues from the planner's first search, and the plans cost less than the
    plans of `plan`. If the solver stops before the optimum, the theorem's formula is evaluated
    where it stopped; `by` is NaN if the field `stationarity` shows that this is no optimum.

    In float32 the gradients of the contact times of 1,024 hits have a median relative error of
    0.01 %, and at most 0.7 % in 99 of 100 cases. For catches these errors are 0.02 % and 3.1 %. The
    reference is the optimum in float64, where `optimal_plan` is exact but slow. Plans of blocks are
    optimised and differentiated in float64; "cost" is then the sum of squares that least squares
    minimise, not the cost of `pj.plan`.

    Args:
        planner: a planner that minimises, such as `pj.hit.planner("exact")`. Decisions that it
            takes before, such as an order or a side of an obstacle, are kept fixed.
        cases: one case or a batch.
        of: the number: a dotted name in the plan, such as "stroke.time", "cost" or "violation", or
            a function of one plan. Every new function object compiles a new program.
        by: a dotted name in the case, or several, such as "limits" or "extras.0.radius".
        steps: iterations of conjugate gradients for the adjoint; the default depends on
            `curvature`. 0 is exact for "cost", by the envelope theorem.
        curvature: "products", the default, solves with products of the Hessian, which are exact
            even where limits are active. "whole" uses the inverse Hessian as preconditioner, which
            costs as much as n solver iterations for n decision variables; planners that search for
            a path first, such as `pj.intercept.planner("spacetime")`, use it by default.
        solver: settings of one search that replaces the planner's attempts.
        polish: whether the first attempt continues to the optimum; ignored if there is a `solver`.
            Planners that search for a path first reach the optimum in any case.
        chunk: as for `plan`.
        devices: as for `plan`.

    Raises:
        TypeError: the planner does not minimise, or the cases or an argument have a wrong type.
        ValueError: a name is not in the plan or the case, `steps` < 0, or `curvature` is unknown.
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
    minimiser, cases = planner.settle(cases, functools.partial(plan, chunk=chunk, devices=devices))
    if solver is not None:
        minimiser = minimiser.with_solver(solver)
    elif polish:
        minimiser = minimiser.with_polish()
    inner = minimiser.problem
    problem = Differentiated(inner, of, by, steps, curvature or inner.adjoint)
    minimiser = dataclasses.replace(minimiser, problem=problem)
    if inner.needs_double:
        with jax.enable_x64(True):
            found = plan(minimiser, with_type(cases, np.float64), chunk=chunk, devices=devices)
        plans = with_type(found, float_type(cases))
    else:
        plans = plan(minimiser, cases, chunk=chunk, devices=devices)
    return PlanGradient(plans=with_origin(plans.whole_plan(), cases), **fields_of(plans.gradient))


def with_type(tree: PyTree, dtype: DTypeLike) -> PyTree:
    """Return a pytree in NumPy arrays, whose floating numbers have another type."""

    def convert(leaf: np.ndarray) -> np.ndarray:
        return leaf.astype(dtype) if np.issubdtype(leaf.dtype, np.floating) else leaf

    return jax.tree.map(lambda leaf: convert(np.asarray(leaf)), tree)
