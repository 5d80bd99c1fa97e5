"""`warm_up`: it compiles all searches of a planner before they are needed."""

from planner_jax.core.checks import require_values
from planner_jax.core.choices import require
from planner_jax.core.planner import CaseT, Kind, Planner, PlanT
from planner_jax.planning.plan import Driver, plan


def warm_up(planner: Planner[CaseT, PlanT], case: CaseT) -> None:
    """Compile all searches of a planner for one case, so that `plan` of later cases never compiles.

    `plan` compiles a search when a case first needs it. Without a warm-up the first case that is
    hard thus waits for seconds. Later cases must have leaves of the same shapes.

    Args:
        planner: a planner whose searches are compiled; planners that work on the host need none.
        case: one case of the planner's task; it is planned by every search.

    Raises:
        ValueError: there is a batch of cases instead of one case.
        TypeError: the case belongs to another task than the planner.
    """
    require(case.batch_shape == (), "case", "one case", shown=f"batch shape {case.batch_shape}")
    require_values("warm_up", planner, case)
    plan(planner, case)
    inner = planner.inner
    if inner.kind is Kind.COMPILED and isinstance(case, inner.case_type):
        for attempt in inner.attempts_for(case):
            Driver()(inner, case, (attempt,))
