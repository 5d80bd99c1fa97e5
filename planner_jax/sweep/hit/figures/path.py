"""One hit in space: the ball, the quadrotor, and the way back to the target."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from planner_jax.runs import style
from planner_jax.sweep.hit.figures.court import draw_case
from planner_jax.sweep.report import RunRows

_SHORTEST = 0.12  # half of a panel's height, in its width


def path_figure(figure: Figure, run: RunRows) -> None:
    """The example from above and from the side, wherever it is."""
    (_, row), setting = run.same_case()[0], run.manifest["setting"]
    drag_after = run.manifest["parameters"].get("drag_after_impact", False)
    above, side = figure.subplots(2, 1, sharex=True)
    target: dict[str, Any] = {"marker": "o", "mfc": "none", "mec": style.INK, "markersize": 11}
    for axes, second in ((above, 1), (side, 2)):
        draw_case(axes, row, second, setting, drag_after)
        axes.plot(row["start"][0], row["start"][second], "s", color=style.BLUE, markersize=5)
        axes.plot(row["target"][0], row["target"][second], zorder=6, **target)
        low, high = axes.get_ylim()
        wide = np.ptp(axes.get_xlim())
        # No side is so short that its panel cannot be read.
        middle, half = 0.5 * (low + high), max(0.5 * (high - low), _SHORTEST * wide)
        axes.set(ylim=(middle - half, middle + half), aspect="equal")
    side.axhline(0.0, color=style.GREY, linewidth=1.5)
    end = "success" if row["success"] else row["sentence"]
    style.label(above, "", "y [m]", f"From above ({end})")
    words = "orange: ball, blue: quadrotor, green: returned ball, ring: target; red: what fails"
    style.label(side, "x [m]", "z [m]", f"From the side ({words})")
