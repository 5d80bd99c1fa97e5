"""Serves for hits, read from the files published with [Yu2023bat]."""

import os
import pkgutil

from planner_jax.task.hit.suites import Serves


def read_serves(folder: str | os.PathLike) -> Serves:
    """Read the serves of the trial files that are published with [Yu2023bat], in a folder.

    A file is named "S_L_T_M.csv". S, L and T are serve, landing and target region (1 near, 2 far,
    3 left, 4 right), and M is the planner (p Bat, l Bat-Lite, b Juggle). Files with equal S_L_T
    contain the same serves in the same order; some may be missing. Other files are ignored.

    Returns:
        The serves: row 1 of every scenario, then row 2 of every scenario and so on. The field
        `published` tells whether each of the three planners solved the serve; NaN without a file.

    Raises:
        ArgumentError: the folder does not exist or contains no such file, or a row does not parse,
            is not finite, does not land in the quadrotor's half court, or differs between the files
            of a scenario. The error's `value` lists all such rows.
    """
    return pkgutil.resolve_name("planner_jax.baselines.hit.published:read_serves")(folder)
