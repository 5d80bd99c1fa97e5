"""Cases and plans of any kind of arrays, passed to a referee of NumPy batches."""

import inspect
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np

from planner_jax.core.checks import numeric, require_number, require_switch
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.protocol import Case, Plan, lane

VerdictT = TypeVar("VerdictT")


def judge_by(
    referee: Callable[..., VerdictT],
    cases: Case,
    plans: Plan,
    kinds: tuple[type[Case], type[Plan]],
    settings: dict[str, object],
) -> VerdictT:
    """Return the verdict on one plan, or on a batch.

    Args:
        referee: of batches.
        cases: one case or a batch.
        plans: of them.
        kinds: the classes that cases and plans must be of.
        settings: keyword arguments of the referee.

    Raises:
        TypeError: cases or plans are of another class, or a setting is none of the referee's or
            of another kind.
        ValueError: shapes that do not fit, or as the referee says.
    """
    for name, tree, kind in zip(("cases", "plans"), (cases, plans), kinds, strict=True):
        if not isinstance(tree, kind):
            raise ArgumentTypeError(name, f"a {kind.__name__}", shown=f"a {type(tree).__name__}")
    require_settings(referee, settings)
    for leaf in jax.tree.leaves((cases, plans)):
        if numeric(leaf) is None:
            raise ArgumentTypeError("cases and plans", "numbers", leaf, verb="hold")
    num = np.shape(plans.status)
    if num != cases.batch_shape:
        raise ArgumentError(
            "plans", f"the batch shape of the cases, {cases.batch_shape}", num, verb="have"
        )
    alone = cases.batch_shape == ()
    if alone:
        cases, plans = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (cases, plans))
    verdict = referee(cases, plans, **settings)
    return lane(verdict, 0) if alone else verdict


def require_settings(referee: Callable[..., object], settings: dict[str, object]) -> None:
    """Raise unless settings are a referee's, each of the kind that its default is.

    Those that a referee hands on to another are looked at for that one.
    """
    known = inspect.signature(referee).parameters
    hands_on = any(each.kind is each.VAR_KEYWORD for each in known.values())
    for name, value in settings.items():
        if name not in known and hands_on:
            continue
        if name not in known:
            raise ArgumentTypeError(name, "a setting of the referee's", value)
        usual = known[name].default
        if isinstance(usual, bool):
            require_switch(name, value)
        elif isinstance(usual, int):
            require_size(name, value)
        elif isinstance(usual, float):
            require_number(name, value, "finite and >= 0", lambda x: x >= 0.0)
