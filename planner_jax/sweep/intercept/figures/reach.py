"""The reach set of a case in space and time, in slices: where the car can be, and when."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from planner_jax.runs import style
from planner_jax.sweep.intercept.drive import case_of, sampled_drive
from planner_jax.sweep.intercept.figures.scene import draw_map, draw_polygons
from planner_jax.sweep.report import RunRows
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.searches import SEARCHES, search_reach

_SLICES = 6
_SAMPLES = 241
_SHADES = LinearSegmentedColormap.from_list("reach", ["#DCEBF5", style.SKY, style.BLUE, "#002B49"])


def reach_figure(figure: Figure, run: RunRows) -> None:
    """The cells that the run's example can reach at some times."""
    setting, (name, row) = run.manifest["setting"], run.same_case()[0]
    drive = sampled_drive(row, setting, _SAMPLES)
    layers = jax.tree.map(np.array, _layers(case_of(row, setting)))
    last, step, (left, low), cell = (layers[key] for key in ("num", "step", "corner", "cell"))
    held = layers["held"]
    ends = cell * np.array([-0.5, held.shape[-1] - 0.5])
    extent: Any = [*(left + ends), *(low + ends)]
    shown = np.unique(np.round(np.linspace(0, last, _SLICES + 1)[1:]).astype(int))
    panels = figure.subplots(2, 3, sharex=True, sharey=True)
    shades: Any = None
    for axes, layer in zip(panels.flat, shown, strict=False):
        time = (layer + 0.5) * step
        draw_map(axes, setting, drive.walls)
        limits = axes.get_xlim(), axes.get_ylim()
        cells = np.ma.masked_equal(100.0 * held[layer], 0.0)
        shades = axes.imshow(
            cells, cmap=_SHADES, vmin=0.0, vmax=100.0, extent=extent, origin="lower", zorder=0
        )
        axes.set(xlim=limits[0], ylim=limits[1])
        moved = [m + time * v for m, v in zip(drive.movers, drive.velocities, strict=True)]
        draw_polygons(axes, moved, style.ORANGE, alpha=0.6, zorder=3)
        if time <= drive.time[-1] * (1.0 + 1e-6):
            way = drive.middle[drive.time <= time]
            axes.plot(*way.T, color=style.RED, linewidth=1.5, zorder=4)
            body = [drive.footprint(drive.pose_at(time))]
            draw_polygons(axes, body, style.RED, alpha=0.7, zorder=5)
        axes.plot(*drive.target_at(time), "*", color=style.GREEN, mec="white", ms=13, zorder=6)
        area = np.count_nonzero(held[layer]) * cell**2
        style.label(axes, "", "", f"{time:.1f} s: {area:.1f} m²")
    for axes in panels.flat[len(shown) :]:
        axes.axis("off")
    for axes in panels[-1]:
        axes.set_xlabel("x [m]")
    for axes in panels[:, 0]:
        axes.set_ylabel("y [m]")
    words = "of all speeds and headings, those with which\nthe rear axle can be in a cell [%]"
    figure.colorbar(shades, ax=panels, label=words, aspect=40)
    look: dict[str, Any] = {"linestyle": "", "marker": "*", "mec": "white", "markersize": 13}
    entries = [
        Patch(facecolor=style.PALE, edgecolor=style.GREY, label="wall"),
        Patch(facecolor=style.ORANGE, alpha=0.7, label="mover"),
        Line2D([], [], color=style.GREEN, label="target", **look),
        Line2D([], [], color=style.RED, marker="s", label=f"{name}'s plan for case {row['index']}"),
        Patch(facecolor=style.SKY, label="within reach"),
    ]
    figure.legend(handles=entries, loc="outside upper center", ncols=len(entries))


@jax.jit
def _layers(case: InterceptCase) -> dict[str, Array]:
    """Grid of a case, and what share of speeds and headings every cell of every layer holds."""
    found = search_reach(case, SEARCHES["given"][0], is_time_free=False)
    bits = found.reach.bits  # (layers + 1, words, levels, headings, cells)
    every = (bits[..., None] >> jnp.arange(32, dtype=bits.dtype)) & 1
    share = jnp.mean(every.astype(jnp.float32), axis=(2, 3))  # (layers + 1, words, y, 32)
    cells = bits.shape[-1]
    held = jnp.moveaxis(share, 1, 2).reshape(-1, cells, cells)
    grid = found.grid
    rest = {"num": grid.num, "step": grid.step, "corner": grid.corner, "cell": grid.cell}
    return {"held": held, **rest}
