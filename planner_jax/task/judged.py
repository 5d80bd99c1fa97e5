"""The way from cases and plans of any kind of arrays to a referee, which takes NumPy batches."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

from planner_jax.protocol import Case, Plan, lane

VerdictT = TypeVar("VerdictT")


def judged(
    referee: Callable[..., VerdictT],
    cases: Any,
    plans: Any,
    kinds: tuple[type[Case], type[Plan]],
    settings: dict[str, Any],
) -> VerdictT:
    """The verdict on one plan, or on a batch.

    Args:
        referee: of batches.
        cases: one case or a batch.
        plans: of them.
        kinds: the classes that cases and plans must be of.
        settings: keyword arguments of the referee.

    Raises:
        TypeError: cases or plans are of another class.
        ValueError: as the referee says.
    """
    for name, tree, kind in zip(("cases", "plans"), (cases, plans), kinds, strict=True):
        if not isinstance(tree, kind):
            raise TypeError(f"{name} must be a {kind.__name__}, got a {type(tree).__name__}")
    tolerance = settings.get("tolerance", 0.0)
    if isinstance(tolerance, str) or np.ndim(tolerance) != 0:
        raise TypeError(f"tolerance must be a number, got {tolerance!r:.60}")
    if not 0.0 <= tolerance < np.inf:
        raise ValueError(f"tolerance must be finite and >= 0, got {tolerance}")
    alone = cases.batch_shape == ()
    if alone:
        cases, plans = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (cases, plans))
    verdict = referee(cases, plans, **settings)
    return lane(verdict, 0) if alone else verdict
