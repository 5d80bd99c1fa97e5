"""Draw the learning curves of one training run, or the mean curves of several runs.

    python -m planner_jax.policies.curves RUN [RUN ...] [--out curves.png]

The runs must have equal settings except for the seed. Each line shows the mean over the runs, and
the shaded band is one standard deviation wide to each side. Curves end with the shortest run.
"""

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from planner_jax.core.errors import ArgumentError
from planner_jax.policies.progress import read_rows, read_settings
from planner_jax.runs import style

_TERMS = {
    "reward": ("Reward", "mean", 1.0),
    "solved": ("Solved in training", "share [%]", 100.0),
    "last": ("Last catch, solved cases", "earlier than greedy's [%]", 100.0),
    "ratio": ("Optimal time ratio", "mean of solved cases", 1.0),
    "violation": ("Violation", "mean of other cases", 1.0),
}
_OF_RUN = ("digest", "code", "version")  # entries of `training.json` in which runs may differ
_COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.SKY, style.GREY)
Rows = list[dict[str, Any]]


def draw_curves(folders: Sequence[str | os.PathLike], path: str | os.PathLike) -> None:
    """Draw the learning curves of training runs, and write the picture atomically.

    Args:
        folders: folders of training runs, at least one.
        path: path of the PNG file.

    Raises:
        ArgumentError: a folder does not hold a training, or runs differ in more than their seed.
    """
    _require_alike([Path(folder) for folder in folders])
    runs = [read_rows(Path(folder)) for folder in folders]
    style.draw(Path(path), curves_figure, (13.0, 6.0), runs)


def curves_figure(figure: Figure, runs: Sequence[Rows]) -> None:
    """Draw learning curves: a panel for the mean reward, and one for each of five quantities.

    The x axis is the number of cases for which the policy has decided the order and times of
    catches. `runs` has the rows of `progress.jsonl` of each training run. If they contain
    evaluations, further panels show results on each suite (family of cases) after each call of PPO.
    """
    curve = [[row for row in rows if "reward" in row] for rows in runs]
    evaluated = [[row for row in rows if "suites" in row] for rows in runs]
    evaluations = all(evaluated)
    panels = list(figure.subplots(2, 4 if evaluations else 3, sharex=True).flat)
    shown = len(_TERMS) + 3 * evaluations
    for axes in panels[shown:]:
        axes.remove()
    for axes, (name, (title, unit, scale)) in zip(panels, _TERMS.items(), strict=False):
        _line(axes, curve, lambda row, name=name: row[name], scale, color=style.BLUE)
        style.label(axes, "decisions", unit, title)
    if evaluations:
        _draw_evaluations(panels[len(_TERMS) :], evaluated)
    ends = [row["decisions"] for row in evaluated[0]][1:-1]
    for axes in panels[:shown]:
        axes.ticklabel_format(axis="x", style="sci", scilimits=(0, 3))
        axes.tick_params(labelbottom=True)
        for end in ends:
            axes.axvline(end, color=style.PALE, linewidth=1.0)


def _draw_evaluations(panels: Sequence[Axes], evaluated: Sequence[Rows]) -> None:
    def value_of(suite: str, name: str) -> Any:
        return lambda row: row["suites"][suite][name]

    for k, suite in enumerate(evaluated[0][0]["suites"]):
        look: Any = {"color": _COLOURS[k % len(_COLOURS)], "label": suite, "marker": "."}
        _line(panels[0], evaluated, value_of(suite, "success"), 100.0, **look)
        _line(panels[1], evaluated, value_of(suite, "last"), 100.0, relative=True, **look)
        _line(panels[2], evaluated, value_of(suite, "ratio"), **look)
    style.label(panels[0], "decisions", "share [%]", "Success, by suite")
    style.label(panels[1], "decisions", "share of the first value [%]", "Last catch, by suite")
    style.label(panels[2], "decisions", "mean of solved cases", "Optimal time ratio, by suite")
    panels[0].legend(fontsize=8.0)


def _line(
    axes: Axes,
    runs: Sequence[Rows],
    value: Callable[[dict[str, Any]], float | None],
    scale: float = 1.0,
    relative: bool = False,
    **look: Any,
) -> None:
    num = min(len(rows) for rows in runs)
    values = scale * np.array([[value(row) for row in rows[:num]] for rows in runs], float)
    if relative:
        values *= scale / values[:, :1]
    at, mean = [row["decisions"] for row in runs[0][:num]], values.mean(axis=0)
    axes.plot(at, mean, linewidth=1.6, **look)
    if len(runs) > 1:
        spread = values.std(axis=0)
        band: Any = {"color": look["color"], "alpha": 0.2, "linewidth": 0.0}
        axes.fill_between(at, mean - spread, mean + spread, **band)


def _require_alike(folders: Sequence[Path]) -> None:
    first: dict[str, Any] = {}
    for folder in folders:
        found = read_settings(folder)
        asked = {name: value for name, value in found.items() if name not in _OF_RUN}
        first = first or asked
        for name in (name for name in first if name != "seed" and asked.get(name) != first[name]):
            raise ArgumentError(
                "run",
                f"of the same {name} as {str(folders[0])!r}, {first[name]}",
                shown=f"{asked.get(name)} in {str(folder)!r}",
            )


def main() -> None:
    """Draw the learning curves of the runs whose folders are given on the command line."""
    parser = argparse.ArgumentParser("python -m planner_jax.policies.curves", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="folder of a training")
    parser.add_argument("--out", type=Path, default=Path("curves.png"), help="path of the picture")
    options = parser.parse_args()
    try:
        draw_curves(options.runs, options.out)
    except ArgumentError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
