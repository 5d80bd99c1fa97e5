"""`solve`, the pure counterpart of `plan`."""

import jax
from jaxtyping import PyTree

from planner_jax.core.errors import NotOffered
from planner_jax.core.origin import with_origin, without_origin
from planner_jax.core.planner import CaseT, Kind, Planner, PlanT, require_fit
from planner_jax.core.rules import require_shapes
from planner_jax.host.compile_cache import keep_compiled_programs
from planner_jax.planning.plan import Driver, require_pure
from planner_jax.planning.pure import plan_mapped


def solve(planner: Planner[CaseT, PlanT], cases: CaseT) -> PlanT:
    """Plan cases as a pure function, for compiled functions, `vmap` and `scan`.

    After the first attempt (search) only unsolved cases are searched again. This holds for hits,
    catches, rallies, and every `SearchPlanner`; other planners repeat each attempt for all cases
    while one case is unsolved. `vmap` of this function plans its lanes as one batch. As for `plan`,
    compiled programs are stored on the disk.

    Args:
        planner: as for `plan`.
        cases: one case or a batch, as for `plan`.

    Returns:
        The plans, with jax arrays as leaves.

    Raises:
        TypeError: the planner works on the host, or the result is differentiated: the derivative of
            a solver's iterations is not the derivative of the optimum.
    """
    keep_compiled_programs()
    require_fit(planner, cases)
    require_pure(planner)
    require_shapes(cases)
    if cases.batch_shape == () and planner.kind is Kind.COMPOSITE:
        plans = solve(planner, jax.tree.map(lambda leaf: leaf[None], cases))
        return jax.tree.map(lambda leaf: leaf[0], plans)
    return with_origin(_solve(planner, without_origin(cases)), cases)


@jax.custom_jvp
def _solve(planner: PyTree, cases: PyTree) -> PyTree:
    """Return plans; a derivative of this function raises `TypeError`."""
    return plan_mapped(Driver(is_pure=True), planner, cases)


@_solve.defjvp
def _raise(primals: tuple, tangents: tuple) -> tuple:
    raise NotOffered(
        "plan and solve cannot be differentiated: for gradients of plans there are pj.gradient, "
        "and pj.optimal_plan inside a loss"
    )
