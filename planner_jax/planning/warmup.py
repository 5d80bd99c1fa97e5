"""Programs that are compiled before they are needed, all at the same time."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from planner_jax.core.planner import Kind, Planner
from planner_jax.core.protocol import Attempt
from planner_jax.planning.host_batch import plan_on_host
from planner_jax.planning.programs import compile_at_once
from planner_jax.planning.progress import Watch


class _Ahead:
    """The `Drive` that compiles: of every planner all attempts, whether or not they are needed."""

    is_pure = False
    is_over = True  # nothing is tried again

    def __call__(
        self, planner: Any, cases: Any, attempts: Sequence[Attempt] | None = None
    ) -> tuple[Any, Any]:
        """What the first attempt makes of a batch, said to leave nothing unsolved."""
        if planner.kind is Kind.COMPOSITE:
            return planner.plan_by(self, cases), np.zeros(1, bool)
        tried: Sequence[Attempt] = attempts or planner.attempts
        if planner.kind is Kind.HOST:  # nothing is compiled of it
            return plan_on_host(planner, tried[:1], cases, Watch())
        return compile_at_once(planner, tried, cases), np.zeros(1, bool)


def compile_attempts(planner: Planner, cases: Any) -> None:
    """Compile what planning a few cases may take, with a thread for each attempt of the planner.

    Otherwise an attempt is compiled when the one before has left something unsolved. That is right
    where the first ones solve most cases; where later ones will be needed, too, and there are
    cores for all, it is to wait several times as long.

    Args:
        planner: as for `pj.plan`.
        cases: a batch like the ones to come, NumPy leaves; its plans are made and dropped.
    """
    _Ahead()(planner, cases)
