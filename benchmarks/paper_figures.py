"""Draw figures of the papers from runs of this library: the data as CSV, and a PNG.

    python -m benchmarks.paper_figures [qu-2] [qu-4] [bat-7] [catch-6] [catch-7] [--out DIR]

* qu-2: predicted paths of a straight and a curved target [Qu2022, Fig. 2].
* qu-4: station, speed and acceleration of a uniform drive, of EM and of the lines of [Qu2022], past
  moving obstacles [Qu2022, Fig. 4], on the first of `--num` own problems where the uniform drive
  hits an obstacle and the other two plans are good.
* bat-7: height, body rate, speed and thrust of three planners on one serve of S.6, with ten times
  the limits for `bat-lite` and `juggle`, as in the paper [Yu2023bat, Fig. 7].
* catch-6: speed, body rate, thrust and jerk of one plan of `exact` with three catches, instead of
  the paper's recorded flight [Yu2023catch, Fig. 6].
* catch-7: the same for `catch`, and for `mpp` with the catching time of `catch`, on the first of
  `--num` throws where `catch` succeeds by the paper's rule and `mpp` fails [Yu2023catch, Fig. 7].

Without names all figures are drawn, into the run folder. The CSV has one line for each point of a
curve, with the panel, the curve, x and y. The printed table has the greatest values of all curves.
"""

import csv
import dataclasses
import io
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import planner_jax as pj
from planner_jax.baselines.catch.mpp import MppCatch
from planner_jax.baselines.intercept.speed import plan_speed
from planner_jax.benchmarks.intercept_prediction import NOISE, TIMES, sample_path
from planner_jax.benchmarks.intercept_speed import PAPER, constant_speed, judge, planners
from planner_jax.benchmarks.run import argument_parser, begin, parse_names
from planner_jax.benchmarks.speed_problems import speed_problems
from planner_jax.core.protocol import is_solved
from planner_jax.policies.published import PAPER_RULE
from planner_jax.runs import style
from planner_jax.sims.prediction.polynomial_fit import fit_polynomial
from planner_jax.task.catch.context import CatchContext

COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE)
# Beginning of the names of filled curves, names of points, and the name of dashed lines.
OBSTACLE, POINTS, LIMIT = "obstacle", ("observed", "catches"), "limit"
# Panels of flights: label of the y axis, field of a flight, and names of its limits.
QUANTITIES = {
    "height": ("z [m]", "height", ()),
    "speed": ("|v| [m/s]", "vel", ("speed",)),
    "body rate": ("|ω| [rad/s]", "body_rate", ("body_rate",)),
    "thrust": ("|τ| [m/s²]", "thrust", ("min_thrust", "max_thrust")),
    "jerk": ("|j| [m/s³]", "jerk", ()),
}
HIT_PANELS = ("height", "body rate", "speed", "thrust")
CATCH_PANELS = ("speed", "body rate", "thrust", "jerk")
STEPS = 1000  # number of intervals between the samples of a flight


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
    colours = dict(zip(names, (style.INK, *COLOURS), strict=False)) | {LIMIT: style.RED}
    every = np.atleast_1d(figure.subplots(1, len(drawing.panels)))
    for axes, (panel, labels) in zip(every, drawing.panels.items(), strict=True):
        style.label(axes, *labels, title=panel)
        for curve in (curve for curve in drawing.curves if curve.panel == panel):
            if curve.name.startswith(OBSTACLE):
                axes.fill(curve.x, curve.y, color=style.PALE)
            else:
                line = "o" if curve.name in POINTS else "--" if curve.name == LIMIT else "-"
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


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class TimedMpp(MppCatch):
    """The planner `mpp` with catches at the times of each case, and not at a fixed height."""

    def times(self, context: CatchContext) -> tuple[jax.Array, jax.Array]:
        """Return the times of the case (N,) [s], and violations (N,) of -1: none is missed."""
        return context.times, jnp.full_like(context.times, -1.0)


def plan_hits(_: int, seed: int) -> dict[str, tuple[Any, Any]]:
    """Plan one serve of S.6 by three planners; return by planner a batch of one case and plan."""
    found = {}
    for name, scale in (("bat", 1.0), ("bat-lite", 10.0), ("juggle", 10.0)):
        case = pj.hit.draw(1, "S.6", seed, limit_scale=scale)
        found[name] = case, pj.plan(pj.hit.planner(name), case)
    return found


def plan_three_catches(_: int, seed: int) -> dict[str, tuple[Any, Any]]:
    """Plan the catches of three targets; return a batch of one case and plan."""
    case = pj.catch.draw(1, "triangle3", seed)
    return {"exact": (case, pj.plan(pj.catch.planner(), case))}


def plan_throws(num: int, seed: int) -> dict[str, tuple[Any, Any]]:
    """Plan a throw by `catch`, and by `mpp` with the same time; return batches of one.

    Raises:
        LookupError: on none of `num` throws `catch` succeeds and `mpp` fails.
    """
    cases = pj.catch.draw(num, "paper-throws", seed)
    plans = pj.plan(pj.catch.planner("catch"), cases)
    timed = pj.plan(TimedMpp(), dataclasses.replace(cases, times=plans.times))
    good, other = (pj.catch.judge(cases, each, **PAPER_RULE).success for each in (plans, timed))
    if not (good & ~other).any():
        raise LookupError(f"no throw of {num} has the required outcomes")
    lane = int(np.argmax(good & ~other))
    one = lambda tree: jax.tree.map(lambda leaf: leaf[lane : lane + 1], tree)  # noqa: E731
    return {"catch": (one(cases), one(plans)), "mpp": (one(cases), one(timed))}


def draw_flights(flights: dict[str, tuple[Any, Any]], panels: tuple[str, ...]) -> Drawing:
    """Draw quantities of flights over time, and the limits of the first case as dashed lines.

    `flights` has a batch of one case and plan by name, and `panels` names keys of `QUANTITIES`.
    """
    limits, curves, end = next(iter(flights.values()))[0].limits, [], 0.0
    for name, (_, plans) in flights.items():
        plan = jax.tree.map(np.asarray, pj.take(plans, 0))
        flight = plan.sample(STEPS / float(np.sum(plan.trajectory.durations)))
        end, catches = max(end, flight.time[-1]), getattr(plan, "times", np.zeros(0))
        for panel in panels:
            field = QUANTITIES[panel][1]
            value = flight.pos[:, 2] if field == "height" else getattr(flight, field)
            size = np.linalg.norm(value, axis=1) if value.ndim == 2 else value
            curves.append(Curve(panel, name, flight.time, size))
            if catches.size > 1:
                at = np.interp(catches, flight.time, size)
                curves.append(Curve(panel, "catches", catches, at))
    for panel in panels:
        for field in QUANTITIES[panel][2]:
            if (limit := getattr(limits, field)) is not None:
                curves.append(Curve(panel, LIMIT, np.array([0.0, end]), np.tile(limit, 2)))
    return Drawing({name: ("t [s]", QUANTITIES[name][0]) for name in panels}, curves)


FIGURES: dict[str, Callable[[int, int], Drawing]] = {
    "qu-2": draw_predictions,
    "qu-4": draw_speeds,
    "bat-7": lambda num, seed: draw_flights(plan_hits(num, seed), HIT_PANELS),
    "catch-6": lambda num, seed: draw_flights(plan_three_catches(num, seed), CATCH_PANELS),
    "catch-7": lambda num, seed: draw_flights(plan_throws(num, seed), CATCH_PANELS),
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
