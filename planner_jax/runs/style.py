"""Style of all figures: fonts, lines, and Okabe and Ito's colours for colour-blind readers."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from planner_jax.host.files import replacing

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType  # exists since Matplotlib 3.11

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY, GREY, INK = "#CC79A7", "#56B4E9", "#8A8F98", "#24292F"
PALE = "#C9CDD2"

# Colour of the plans of each planner; planners of one task have different colours.
PLANNER_COLOURS = dict.fromkeys(("exact", "spacetime"), BLUE) | {"constant": SKY}
PLANNER_COLOURS |= dict.fromkeys(("bat", "catch", "paper"), ORANGE)
PLANNER_COLOURS |= dict.fromkeys(("bat-lite", "lattice"), GREEN)
PLANNER_COLOURS |= dict.fromkeys(("juggle", "mpp", "em"), PURPLE)

Look: TypeAlias = dict[str, Any]  # keyword arguments of Matplotlib's drawing functions

_STYLE: "dict[RcKeyType, object]" = {
    "font.size": 10.0,
    "axes.titlesize": 11.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E8EB",
    "grid.linewidth": 0.8,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": INK,
    "legend.frameon": False,
    "figure.dpi": 110.0,
    "savefig.dpi": 150.0,
    "figure.constrained_layout.use": True,
}


def context() -> AbstractContextManager[None]:
    """Return a context in which Matplotlib makes figures in this style."""
    return matplotlib.rc_context(_STYLE)


def draw(
    path: Path, figure: Callable[..., object], size: tuple[float, float], *data: object
) -> None:
    """Draw `figure(canvas, *data)` on a canvas of `size` [inch], and write it as a PNG file."""
    with context():
        canvas = Figure(figsize=size)
        FigureCanvasAgg(canvas)
        figure(canvas, *data)
        with replacing(path) as scratch:
            canvas.savefig(scratch, format="png")


def label(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Set the labels of the x and y axis, and the title of a panel."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title)
