"""Draw figures of the papers from runs of this library: the data as CSV, and a PNG.

    python -m benchmarks.paper_figures [qu-2] [qu-4] [bat-7] [--out DIR]

* qu-2: predicted paths of a straight and a curved target [Qu2022, Fig. 2].
* qu-4: station, speed and acceleration of a uniform drive, of EM and of the lines of [Qu2022], past
  moving obstacles [Qu2022, Fig. 4], on the first of `--num` own problems where the uniform drive
  hits an obstacle and the other two plans are good.
* bat-7: height, body rate, velocity and thrust of three planners on one serve of S.6, with ten
  times the limits for `bat-lite` and `juggle`, as in the paper [Yu2023bat, Fig. 7].

Without names all figures are drawn, into the run folder. The CSV has one line for each point of a
curve, with the panel, the curve, x and y. The printed table has the greatest values of all curves.
"""

import csv
import dataclasses
import io
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import planner_jax as pj
from planner_jax.baselines.intercept.speed import plan_speed
from planner_jax.benchmarks.intercept_prediction import NOISE, TIMES, sample_path
from planner_jax.benchmarks.intercept_speed import PAPER, constant_speed, judge, planners
from planner_jax.benchmarks.run import argument_parser, begin, parse_names
from planner_jax.benchmarks.speed_problems import speed_problems
from planner_jax.core.protocol import is_solved
from planner_jax.runs import style
from planner_jax.sims.prediction.polynomial_fit import fit_polynomial

COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE)
OBSTACLE, POINTS = "obstacle", "observed"  # beginnings of the names of filled curves, and of points


@dataclasses.dataclass(frozen=True)
class Curve:
    """One curve of a figure: K points in one of its panels."""

    panel: str
    name: str
    x: np.ndarray  # (K,)
    y: np.ndarray  # (K,)


@dataclasses.dataclass(frozen=True)
class Drawing:
    """The panels of a figure, with the labels of both axes by panel, and its curves."""

    panels: dict[str, tuple[str, str]]
    curves: list[Curve]

    def to_csv(self) -> str:
        """Return the curves as comma-separated values, with six significant digits."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(("panel", "curve", "x", "y"))
        for curve in self.curves:
            for x, y in zip(curve.x, curve.y, strict=True):
                writer.writerow((curve.panel, curve.name, f"{x:.6g}", f"{y:.6g}"))
        return text.getvalue()


def draw_panels(figure: Figure, drawing: Drawing) -> None:
    """Draw all panels side by side; curves of one name have one colour."""
    names = {curve.name: None for curve in drawing.curves if not curve.name.startswith(OBSTACLE)}
    colours = dict(zip(names, (style.INK, *COLOURS), strict=False))
    every = np.atleast_1d(figure.subplots(1, len(drawing.panels)))
    for axes, (panel, labels) in zip(every, drawing.panels.items(), strict=True):
        style.label(axes, *labels, title=panel)
        for curve in (curve for curve in drawing.curves if curve.panel == panel):
            if curve.name.startswith(OBSTACLE):
                axes.fill(curve.x, curve.y, color=style.PALE)
            else:
                line = "o" if curve.name.startswith(POINTS) else "-"
                look: style.Look = {"color": colours[curve.name], "markersize": 4.0}
                axes.plot(curve.x, curve.y, line, label=curve.name, **look)
    figure.legend(*every[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)


def draw_predictions(_: int, seed: int) -> Drawing:
    """Predict a straight and a curved target 15 s ahead by a polynomial of degree 2."""
    ahead, curves = np.linspace(0.0, 15.0, 61, dtype=np.float32), []
    noise = np.random.default_rng(seed).normal(0.0, NOISE, (2, len(TIMES), 2))
    states, controls = np.array([[1.0, 1.0, 0.3, 0.2], [1.0, 7.0, 0.3, -5.8]]), (0.0, 0.4)
    panels = ("straight target", "curved target")
    for panel, state, changes, error in zip(panels, states, controls, noise, strict=True):
        inputs = np.tile([0.0, changes], (len(TIMES) + 15, 1))
        leaves = (jnp.asarray(leaf, jnp.float32) for leaf in (state, inputs, 1.0))
        path = pj.ControlledPath(*leaves)
        seen = np.asarray(sample_path(path, TIMES - TIMES[0])) + error
        found = fit_polynomial(TIMES, seen.astype(np.float32), 2)
        for name, points in (
            ("true", sample_path(path, np.concatenate([TIMES, ahead[1:]]) - TIMES[0])),
            ("observed", seen),
            ("predicted", sample_path(found, ahead)),
        ):
            curves.append(Curve(panel, name, *np.asarray(points).T))
    return Drawing(dict.fromkeys(panels, ("x [m]", "y [m]")), curves)


def draw_speeds(num: int, seed: int) -> Drawing:
    """Plan the speed past moving obstacles at constant speed, by EM and by the lines of the paper.

    Raises:
        LookupError: in no problem the constant speed hits an obstacle and the others are good.
    """
    problems, named = speed_problems(num, seed), planners(PAPER)
    names = {"EM": "em, 20", "lines of the paper": "edges, soft end, 20"}
    plans = {
        name: jax.jit(jax.vmap(lambda one, key=key: plan_speed(one, named[key])))(problems)
        for name, key in names.items()
    }
    found = {name: (plan.curve, is_solved(plan.status)) for name, plan in plans.items()}
    found = {"uniform": (jax.vmap(constant_speed)(problems), np.ones(num, bool))} | found
    good = {
        name: judge(problems, np.asarray(curve.points), np.asarray(solved)).good
        for name, (curve, solved) in found.items()
    }
    wanted = ~good["uniform"] & good["EM"] & good["lines of the paper"]
    if not wanted.any():
        raise LookupError(f"no problem of {num} has the required outcomes")
    lane, times = int(np.argmax(wanted)), np.linspace(0.0, float(problems.horizon[0]), 201)
    panels = {"station": "s [m]", "speed": "v [m/s]", "acceleration": "a [m/s²]"}
    blocked, curves = jax.tree.map(lambda leaf: leaf[lane], problems.blocked), []
    for k in np.flatnonzero(blocked.present):
        x = [blocked.start[k], blocked.end[k], blocked.end[k], blocked.start[k]]
        y = [*blocked.lower[k], *blocked.upper[k][::-1]]
        curves.append(Curve("station", f"{OBSTACLE} {k + 1}", np.array(x), np.array(y)))
    for order, panel in enumerate(panels):
        for name, (batch, _) in found.items():
            curve = jax.tree.map(lambda leaf: leaf[lane], batch)
            curves.append(
                Curve(panel, name, times, np.asarray(curve.at(jnp.asarray(times), order)))
            )
    return Drawing({name: ("t [s]", label) for name, label in panels.items()}, curves)


def draw_hits(_: int, seed: int) -> Drawing:
    """Plan one serve of S.6 by three planners; the limits are relaxed for two of them."""
    panels = {
        "height": "z [m]",
        "body rate": "|ω| [rad/s]",
        "velocity": "|v| [m/s]",
        "thrust": "|τ| [m/s²]",
    }
    curves = []
    for name, scale in (("bat", 1.0), ("bat-lite", 10.0), ("juggle", 10.0)):
        case = pj.hit.draw(1, "S.6", seed, limit_scale=scale)
        plan = pj.plan(pj.hit.planner(name), case)
        flight = jax.tree.map(np.asarray, pj.take(plan, 0)).sample(100.0)
        rate, speed = (np.linalg.norm(each, axis=1) for each in (flight.body_rate, flight.vel))
        values = (flight.pos[:, 2], rate, speed, flight.thrust)
        curves += [
            Curve(panel, name, flight.time, each)
            for panel, each in zip(panels, values, strict=True)
        ]
    return Drawing({name: ("t [s]", label) for name, label in panels.items()}, curves)


FIGURES: dict[str, Callable[[int, int], Drawing]] = {
    "qu-2": draw_predictions,
    "qu-4": draw_speeds,
    "bat-7": draw_hits,
}


def main() -> None:
    parser = argument_parser("paper_figures", __doc__, num=50, seed=0)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"among {', '.join(FIGURES)}")
    options = parser.parse_args()
    names = options.names and parse_names(parser, "NAME", ",".join(options.names), FIGURES)
    with begin(parser, options) as bench:
        bench.say("| figure | panel | curve | least | greatest |", "|---|---|---|---|---|")
        for name in names or FIGURES:
            drawing = FIGURES[name](options.num, options.seed)
            (bench.path / f"{name}.csv").write_text(drawing.to_csv(), "utf-8")
            size = (1.0 + 3.6 * len(drawing.panels), 3.6)
            style.draw(bench.path / f"{name}.png", draw_panels, size, drawing)
            for curve in drawing.curves:
                least, most = float(curve.y.min()), float(curve.y.max())
                bench.say(f"| {name} | {curve.panel} | {curve.name} | {least:.3f} | {most:.3f} |")
                bench.row(figure=name, panel=curve.panel, curve=curve.name, least=least, most=most)


if __name__ == "__main__":
    main()
