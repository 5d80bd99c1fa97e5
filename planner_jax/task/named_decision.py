"""Decisions by name, for the words of every task whose planners decide first."""

import pkgutil
from collections.abc import Collection, Mapping

from planner_jax.core.errors import ArgumentTypeError
from planner_jax.core.protocol import Decision
from planner_jax.core.registry import split_name


def named_decision(
    names: Mapping[str, str], decide: str | Decision, from_file: Collection[str] = ()
) -> Decision:
    """The decision of a name, or the decision itself.

    Args:
        names: name -> "module:class", those of a task.
        decide: one of these names, with ":" and a file behind it if it may be read from one; or a
            decision.
        from_file: the names that may have a file behind them.

    Raises:
        ValueError: there is no decision of that name, or it takes no file.
        TypeError: it is neither a name nor a decision.
    """
    if not isinstance(decide, str):
        if isinstance(decide, type) or not isinstance(decide, Decision):
            raise ArgumentTypeError("decide", "a name or a decision", decide)
        return decide
    name, file = split_name(names, "decide", decide, from_file)
    return pkgutil.resolve_name(names[name])(*filter(None, [file]))
