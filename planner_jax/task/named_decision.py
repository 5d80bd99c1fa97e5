"""Decisions by name, for the words of every task whose planners decide first."""

import pkgutil
from collections.abc import Mapping

from planner_jax.protocol import Decision
from planner_jax.registry import require_name


def named_decision(names: Mapping[str, str], decide: str | Decision) -> Decision:
    """The decision of a name, or the decision itself.

    Args:
        names: name -> "module:class", those of a task.
        decide: one of these names, or a decision.

    Raises:
        ValueError: there is no decision of that name.
    """
    if not isinstance(decide, str):
        return decide
    require_name(names, "decide", decide)
    return pkgutil.resolve_name(names[decide])()
