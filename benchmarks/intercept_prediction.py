"""Measure errors of predicted target positions, and compare methods with Table I of [Qu2022].

    python -m benchmarks.intercept_prediction [--num 20000] [--seed 0] [--out DIR]

Moving targets are observed 15 times, once a second up to time 0, with noise of 0.1 m on each
coordinate [Qu2022, Section V-A]. Their positions are predicted 0, 5, 10 and 15 s ahead. The methods
are polynomials of degree 1 to 3 as in the paper, turns with constant speed and turn rate (fitted by
least squares), and the function `select`, which decides whether a target is straight or turning.
The table also has the Cramer-Rao bound, a lower bound on the errors of unbiased predictions.

Straight and turning targets move at 0.2 to 0.5 m/s, which keeps them on the paper's map. Turning
targets turn at 0.03 to 0.1 rad/s. A third kind follows the paper's example curve, which accelerates
by 0.4 m/s every second; neither a straight path nor a turn describes it. Errors are means. For the
relative error, the mean error is divided by the mean distance of the targets from the map's corner.
The paper states neither the origin of its distances nor the degree of its polynomials. Its errors
grow with time as errors of degree 2 do.

The success rate in the run's summary is the share of predictions by `select` within 0.3 m at 10 s,
for straight and turning targets. The time is for one prediction on one core without compilation,
from NumPy arrays to NumPy arrays. The constants of `select` were tuned with other seeds. The mean
error of 1,000 turning targets at 10 s has a standard error of 0.01 m. Some methods differ by less
than this error, so a comparison needs many more targets.
"""

import os
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.baselines.protocols import BY_ROW
from planner_jax.benchmarks.prediction_bounds import cramer_rao, mean_distance, share_within
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.plane.target import PolynomialPath, TurningPath
from planner_jax.sims.prediction.observed import centre
from planner_jax.sims.prediction.polynomial_fit import fit_polynomial
from planner_jax.sims.prediction.select_path import select
from planner_jax.sims.prediction.turn_fit import best_turn, path_of

TIMES = np.arange(-14.0, 1.0, dtype=np.float32)  # [s] Times of the observations.
AHEAD = np.array([0.0, 5.0, 10.0, 15.0], np.float32)  # [s] Times of the predicted positions.
MEETING = 2  # Index into AHEAD of the time at which errors below RADII are counted: 10 s.
NOISE, MAP = 0.1, 8.0  # [m] Standard deviation of a coordinate, and side of the square map.
RADII = (0.3, 0.5)  # [m] Shares of errors below these distances are counted.
MODES = {
    "straight": "straight targets",
    "turning": "targets with a constant turn rate",
    "gaining": "targets that accelerate by 0.4 m/s every second, the paper's curve",
}
DEGREES = (1, 2, 3)
METHODS = (*(f"degree {degree}" for degree in DEGREES), "turn", "selected")


def draw(mode: str, num: int, seed: int) -> tuple[Any, np.ndarray]:
    """Draw `num` targets of one kind; return their paths and observed positions (num, 15, 2) [m].

    `mode` is "straight", "turning", or "gaining" for an accelerating target.
    """
    rng = np.random.default_rng([seed, list(MODES).index(mode)])
    speed, heading = rng.uniform(0.2, 0.5, num), rng.uniform(-np.pi, np.pi, num)
    rate = rng.uniform(0.03, 0.1, num) * rng.choice([-1.0, 1.0], num) * (mode == "turning")
    place = rng.uniform(0.0, MAP, (num, 2))
    velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    noise = rng.normal(0.0, NOISE, (num, len(TIMES), 2))
    leaves = [place, velocity, rate]
    if mode == "gaining":
        leaves = [np.stack([place, velocity, np.tile([0.0, 0.2], (num, 1))], 1), np.zeros(num)]
    kind = PolynomialPath if mode == "gaining" else TurningPath
    paths = kind(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves))
    return paths, np.asarray(places(paths, TIMES) + noise, np.float32)


def sample_path(path: Any, times: Any) -> jax.Array:
    """Return the positions (T, 2) [m] of a path at times (T,) [s]."""
    return jax.vmap(lambda time: path.at(time).pos)(times)


places = jax.jit(jax.vmap(sample_path, in_axes=(0, None)))


@jax.jit
@jax.vmap
def predict(truth: jax.Array, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Predict a target's positions by all methods from 15 observed positions `seen` (15, 2) [m].

    The true positions `truth` (4, 2) [m] are 0, 5, 10 and 15 s ahead of the last observation.

    Returns:
        off: (methods, 4) [m], distances of the predictions from the true positions.
        is_turning: () bool, whether `select` chose a turn.
    """
    chosen, centred = select(TIMES, seen, NOISE), centre(TIMES, seen, None, 3)
    fits = [fit_polynomial(TIMES, seen, degree) for degree in DEGREES]
    paths = (*fits, path_of(centred, best_turn(centred)), chosen)
    found = jnp.stack([sample_path(path, AHEAD) for path in paths])
    return jnp.linalg.norm(found - truth, axis=-1), chosen.turn_rate != 0.0


@jax.jit
@jax.vmap
def bounds(path: TurningPath) -> tuple[jax.Array, jax.Array]:
    """Return mean errors (4,) [m] of a best unbiased prediction 0, 5, 10 and 15 s ahead.

    The covariance of this prediction is the Cramer-Rao bound. The second result has the
    probabilities (2,) that its error 10 s ahead is below 0.3 and below 0.5 m.
    """

    def least(time: Any) -> jax.Array:
        straight, turning = (
            cramer_rao(path, TIMES, NOISE, time, turning=turning) for turning in (False, True)
        )
        return jnp.where(path.turn_rate == 0.0, straight, turning)

    covariances = jax.vmap(least)(AHEAD)
    shares = [share_within(covariances[MEETING], radius) for radius in RADII]
    return jax.vmap(mean_distance)(covariances), jnp.stack(shares)


def report(bench: Bench, mode: str, num: int, seed: int) -> None:
    paths, seen = draw(mode, num, seed)
    truth = np.asarray(places(paths, AHEAD))
    off, turning = map(np.asarray, predict(truth, seen))
    distance = np.linalg.norm(truth, axis=-1).mean(axis=0)
    heads = ["prediction", *(f"{ahead:.0f} s" for ahead in AHEAD), *(f"<= {r} m" for r in RADII)]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]

    def row(name: str, mean: np.ndarray, shares: Any) -> None:
        cells = [f"{m:.3f} m, {100 * m / d:.2f} %" for m, d in zip(mean, distance, strict=True)]
        cells += [f"{100 * share:.1f} %" for share in shares]
        lines.append(f"| {name} | {' | '.join(cells)} |")
        bench.row(mode=mode, prediction=name, mean=mean, relative=mean / distance, shares=shares)

    for name, one in zip(METHODS, off.swapaxes(0, 1), strict=True):
        row(name, one.mean(axis=0), [(one[:, MEETING] <= radius).mean() for radius in RADII])
    if mode != "gaining":
        row("Cramer-Rao", *(np.asarray(each).mean(axis=0) for each in bounds(paths)))
    rows = (BY_ROW.get(("Qu2022", "Table I", f"{mode} {ahead:.0f} s")) for ahead in AHEAD)
    if published := [each for each in rows if each]:
        cells = [*map(str, published), *[""] * len(RADII)]
        lines.append(f"| [Qu2022] | {' | '.join(cells)} |")
        grown = {
            "[Qu2022]": np.array([each.value for each in published]),
            **{name: off[:, METHODS.index(name)].mean(axis=0) for name in ("degree 2", "selected")},
        }
        ratios = {name: " : ".join(f"{g:.1f}" for g in e / e[0]) for name, e in grown.items()}
        lines += [
            "",
            "growth of the error: " + "; ".join(f"{name} {text}" for name, text in ratios.items()),
        ]
    ours = off[:, -1, MEETING]
    figures = {
        "mean_error": ours.mean(),
        "standard_error": ours.std() / np.sqrt(num),
        "within": (ours <= RADII[0]).mean(),
    }
    lines += [
        "",
        f"selected, at {AHEAD[MEETING]:.0f} s: mean error {figures['mean_error']:.4f} m, "
        f"standard error {figures['standard_error']:.4f} m; "
        f"a turn is selected for {100 * turning.mean():.1f} %",
    ]
    bench.say("", f"{num} {MODES[mode]}", "", *lines)
    bench.note(**{f"{mode}_{name}": figure for name, figure in figures.items()})
    if mode != "gaining":
        bench.count(ours <= RADII[0], None)


def latency(bench: Bench, num: int, seed: int) -> None:
    """Time predictions of many targets, one at a time, and print quantiles of the time."""
    one, seconds = jax.jit(lambda seen: select(TIMES, seen, NOISE)), []
    targets = np.concatenate([draw(mode, num, seed)[1] for mode in ("straight", "turning")])
    jax.device_get(one(targets[0]))
    for seen in targets:
        began = time.perf_counter()
        jax.device_get(one(seen))
        seconds.append(time.perf_counter() - began)
    p50, p99 = 1e3 * np.percentile(seconds, [50, 99])
    bench.say(
        "",
        f"one prediction, one core, warm: p50 {p50:.3f} ms, p99 {p99:.3f} ms; load average "
        f"{os.getloadavg()[0]:.1f}; [Qu2022]: <= 1 ms",
    )
    bench.note(p50_ms=p50, p99_ms=p99)


def main() -> None:
    parser = argument_parser("intercept_prediction", __doc__, num=20000, seed=0)
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):  # JAX's threads inherit the affinity if they start later.
        os.sched_setaffinity(0, [max(os.sched_getaffinity(0))])
    with begin(parser, options) as bench:
        for mode in MODES:
            report(bench, mode, options.num, options.seed)
        latency(bench, min(options.num, 1000), options.seed)


if __name__ == "__main__":
    main()
