"""Planners by name, looked up in a task's table; a list of names imports none of them."""

import pkgutil
from collections.abc import Mapping
from typing import Any


def make_planner(planners: Mapping[str, str], name: str, options: Mapping[str, Any]) -> Any:
    """The planner of a name, as `planner_jax.task.solve.plan` takes it.

    Args:
        planners: name -> what makes the planner, as "module:attribute".
        name: a key of it.
        options: fields of that planner's dataclass.

    Raises:
        ValueError: there is no planner of that name.
    """
    require_planner(planners, name)
    return pkgutil.resolve_name(planners[name])(**options)


def require_planner(planners: Mapping[str, str], name: str) -> None:
    """Raise ValueError unless `name` is a planner's; imports none of them."""
    if name not in planners:
        raise ValueError(f"planner must be one of {', '.join(planners)}, got {name!r}")
