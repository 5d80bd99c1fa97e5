"""Plans of files that `plan.save` wrote, whatever task they are of."""

import os

import numpy as np

from planner_jax.core.errors import ArgumentError
from planner_jax.core.plan_files import PlanFileError, load_fitting, named_leaves
from planner_jax.core.protocol import Plan, lane
from planner_jax.export.setpoints import ROBOTS


def saved_plan(path: str | os.PathLike, row: int | None = None) -> Plan:
    """One plan of a file, as far as a robot knows it: what a task adds is left out.

    Args:
        path: of the file.
        row: place in the batch that it holds; None where it holds one plan.

    Raises:
        PlanFileError: the file holds no plans of a quadrotor, a car or an arm.
        ArgumentError: there is no such row.
    """
    plans: Plan = load_fitting(path, [robot.plan for robot in ROBOTS])
    shape = np.shape(plans.status)
    if shape == ():
        if row is not None:
            raise ArgumentError("row", "given for a file of one plan", row, verb="not be")
        return plans
    require_row(row, shape[0])
    sizes = {np.shape(leaf)[:1] for leaf in named_leaves(plans).values()}
    if len(shape) != 1 or len(sizes) != 1:
        raise PlanFileError("path", "as much of every plan", str(path), verb="hold")
    return lane(plans, row)


def require_row(row: int | None, num: int) -> None:
    """Raise `ArgumentError` unless a row is one of so many."""
    if row is None or not 0 <= row < num:
        shown = "nothing" if row is None else row
        raise ArgumentError("row", f"from 0 to {num - 1}", shown=shown)
