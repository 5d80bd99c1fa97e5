"""Plans of those cases of a batch that are wanted, and of two batches the better entries."""

import dataclasses
from typing import Any, TypeVar

import jax
import numpy as np

from planner_jax.core.protocol import Status, lane
from planner_jax.planning.plan import plan
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan

TreeT = TypeVar("TreeT")


def plans_where(planner: Any, cases: BlockCase, wanted: np.ndarray) -> BlockPlan:
    """Plans of those of B cases that are wanted (B,), at least one; the others are unsolved.

    NumPy leaves (B, ...), as those of the cases have to be.
    """
    plans = plan(planner, lane(cases, np.flatnonzero(wanted)))
    places = np.maximum(np.cumsum(wanted) - 1, 0)
    plans = jax.tree.map(lambda leaf: np.asarray(leaf)[places], plans)
    status: Any = np.where(wanted, plans.status, Status.INFEASIBLE).astype(np.int32)
    return dataclasses.replace(plans, status=status)


def chosen(better: np.ndarray, one: TreeT, other: TreeT) -> TreeT:
    """Of two batches the entries of the first one where that is better (B,), else the second's."""
    return jax.tree.map(
        lambda a, b: np.where(better.reshape(-1, *(1,) * (np.ndim(a) - 1)), a, b), one, other
    )
