"""What stands and moves in the plane, drawn alike in all figures of interceptions."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.typing import ColorType

from planner_jax.runs import style
from planner_jax.runs.manifest import Entries
from planner_jax.runs.style import Look

# Viridis without its light end, which paper does not show.
_STOPS = ("#440154", "#443983", "#31688E", "#21918C", "#35B779", "#90D743")


def colours_of_time(num: int = 256) -> ListedColormap:
    """Return the colours of times, early ones dark."""
    stops = np.array([[int(stop[k : k + 2], 16) for k in (1, 3, 5)] for stop in _STOPS]) / 255.0
    at = np.linspace(0.0, len(stops) - 1.0, num)
    each = [np.interp(at, np.arange(len(stops)), stops[:, k]) for k in range(3)]
    return ListedColormap(np.stack(each, axis=1))


def instants(end: float, most: int) -> np.ndarray:
    """Return at most so many round times [s] from 0 up to an end."""
    steps = [mantissa * 10.0**power for power in range(-3, 9) for mantissa in (1.0, 2.0, 2.5, 5.0)]
    num, step = next((n, step) for step in steps if (n := int(end / step + 1e-6)) < most)
    return step * np.arange(num + 1)


def draw_map(axes: Axes, setting: Entries, walls: list[np.ndarray]) -> None:
    """Draw the map's bounds and what stands on it."""
    look: Look = {"facecolor": style.PALE, "edgecolor": style.GREY, "linewidth": 0.8}
    axes.add_collection(PolyCollection(walls, zorder=1, **look))
    (left, low), (right, high) = setting["lower"], setting["upper"]
    axes.set(xlim=(left, right), ylim=(low, high), aspect="equal")
    axes.grid(visible=False)
    axes.spines[["top", "right"]].set_visible(True)


def draw_polygons(
    axes: Axes, polygons: list[np.ndarray], colour: ColorType, **look: object
) -> None:
    """Draw polygons (V, 2) [m] in a colour, pale inside."""
    look = {"alpha": 0.25, "linewidth": 0.0, "zorder": 2, **look}
    axes.add_collection(PolyCollection(polygons, facecolor=colour, **look))
    edge = {"facecolor": "none", "edgecolor": colour, "linewidth": 1.0, "zorder": look["zorder"]}
    axes.add_collection(PolyCollection(polygons, **edge))
