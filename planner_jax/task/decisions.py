"""Decisions by name, and checks of the orders of targets that they choose."""

import pkgutil
from collections.abc import Collection, Mapping

import numpy as np
from jax.typing import ArrayLike

from planner_jax.core.decision import Decision
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.registry import split_name


def find_decision(
    names: Mapping[str, str], decide: str | Decision, from_file: Collection[str] = ()
) -> Decision:
    """Return the decision that `decide` names, or `decide` itself if it is a decision.

    A decision is an object that chooses what a case leaves open, such as the order of its targets.

    Args:
        names: "module:class" of each decision, by name.
        decide: a decision, its name, or "NAME:FILE" for a name in `from_file`.
        from_file: names of the decisions that can be read from a file.

    Raises:
        ValueError: there is no decision of that name, or the decision takes no file.
        TypeError: the argument is neither a name nor a decision.
    """
    if not isinstance(decide, str):
        if isinstance(decide, type) or not isinstance(decide, Decision):
            raise ArgumentTypeError("decide", "a name or a decision", decide)
        return decide
    name, file = split_name(names, "decide", decide, from_file)
    return pkgutil.resolve_name(names[name])(*filter(None, [file]))


def require_orders(orders: ArrayLike) -> None:
    """Raise `ValueError` unless every order (..., N) of N targets is a permutation of 0..N-1."""
    flat = np.asarray(orders).reshape(-1, np.shape(orders)[-1])
    wrong = np.flatnonzero((np.sort(flat, axis=1) != np.arange(flat.shape[1])).any(axis=1))
    if wrong.size:
        shown = f"{flat[wrong[0]].tolist()} in case {wrong[0]}"
        raise ArgumentError("order", f"a permutation of 0..{flat.shape[1] - 1}", shown=shown)
