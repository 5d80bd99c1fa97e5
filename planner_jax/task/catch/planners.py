"""The catch planners by name: one signature, chosen on the command line or by a benchmark."""

import pkgutil
from typing import Any

# Name -> what makes the planner, as "module:attribute", so that a list of names imports none.
PLANNERS = {
    "exact": "planner_jax.task.catch.exact:ExactCatch",
    "catch": "planner_jax.task.catch.paper:PaperCatch",
    "mpp": "planner_jax.task.catch.mpp:MppCatch",
}


def catch_planner(name: str, **options: Any) -> Any:
    """The planner of a name, as `planner_jax.task.solve.plan` takes it.

    Args:
        name: a key of `PLANNERS`.
        **options: fields of that planner's dataclass.

    Raises:
        ValueError: there is no planner of that name.
    """
    require_planner(name)
    return pkgutil.resolve_name(PLANNERS[name])(**options)


def require_planner(name: str) -> None:
    """Raise ValueError unless `name` is a planner's; imports none of them."""
    if name not in PLANNERS:
        raise ValueError(f"planner must be one of {', '.join(PLANNERS)}, got {name!r}")
