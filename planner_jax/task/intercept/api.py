"""Public functions of the task `pj.intercept`, in which a car meets a moving target."""

import zlib
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from planner_jax.core.checks import require_kind, require_number
from planner_jax.core.choices import require_size
from planner_jax.core.paths import require_path
from planner_jax.core.planner import Planner
from planner_jax.core.registry import suite_named
from planner_jax.core.rules import NOT_NEGATIVE, POSITIVE
from planner_jax.plane.maps import OccupancyMap as OccupancyMap
from planner_jax.plane.maps import read_map as read_map
from planner_jax.plane.maps import walls_of_grid as walls_of_grid
from planner_jax.plane.prediction import Prediction as Prediction
from planner_jax.plane.prediction import predict as predict
from planner_jax.plane.target import (
    ControlledPath,
    LaterPath,
    PlanePath,
    PolynomialPath,
    TurningPath,
)
from planner_jax.referee.intercept import InterceptVerdict, referee_intercepts
from planner_jax.task.arguments import judge_by
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.spec import SUITES, TASK
from planner_jax.task.intercept.suites import draw_with_counts


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    dtype: DTypeLike = jnp.float32,
) -> InterceptCase:
    """Draw a batch of interception cases from a suite, a named family of random cases.

    "easy" (default), "medium" and "hard" have ever more obstacles, "storm" and "gale" many moving
    ones, "maze" long walls with gaps, and "rush" little time. The targets of "qu-curve" accelerate,
    and "qu-map" has the walls of one map, both as in [Qu2022]. Suites of other packages are also
    accepted. The batch has the cases number `first` to `first` + `num` - 1 of suite and `seed`.
    """
    suite = suite_named(suite, "easy")
    if suite not in SUITES:
        return TASK.other_suite(suite)(num, seed, first)
    return draw_with_counts(suite, num, seed, first, dtype=dtype).cases


def observe(
    cases: InterceptCase,
    seed: int,
    noise: float = 0.1,
    count: int = 15,
    interval: float = 1.0,
    first: int = 0,
    until: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate noisy observations of the targets' positions up to time 0, when the cars start.

    The noise is Gaussian [Qu2022, eq. 4]. With `until` > 0 the observations continue after time 0.

    Args:
        cases: batch of B cases.
        seed: >= 0. The noise of a case depends on the seed and the case's index alone.
        noise: [m], standard deviation of the noise on each axis.
        count: number of observations up to time 0; the last of them is at time 0.
        interval: [s], time between two observations.
        first: >= 0, index of the first case of the batch.
        until: [s], time up to which observations continue, >= 0.

    Returns:
        times: (L,) [s], L = count + floor(until / interval).
        positions: (B, L, 2) [m].

    Raises:
        ValueError: an argument is out of its range.
    """
    require_kind("cases", cases, InterceptCase)
    for name, size, least in (("seed", seed, 0), ("count", count, 1), ("first", first, 0)):
        require_size(name, size, least)
    for name, value in (("noise", noise), ("until", until)):
        require_number(name, value, NOT_NEGATIVE)
    require_number("interval", interval, POSITIVE)
    times = interval * np.arange(1.0 - count, 1.0 + np.floor(until / interval + 1e-9))
    positions = np.asarray(_positions_at(cases.target, times.astype(cases.time.dtype)))
    tag = zlib.crc32(b"observations")
    errors = [
        np.random.default_rng([seed, first + k, tag]).standard_normal((len(times), 2))
        for k in range(len(positions))
    ]
    return times, positions + noise * np.stack(errors)


@jax.jit
def _positions_at(paths: PlanePath, times: Array) -> Array:
    return jax.vmap(lambda path: jax.vmap(lambda time: path.at(time).pos)(times))(paths)


def planner(
    name: str = "spacetime", *, effort: str = "feasible", **options: object
) -> Planner[InterceptCase, InterceptPlan]:
    """Make a planner of interceptions by its name.

    * `spacetime`: computes the set of cells in space and time that the car can reach, and optimises
      path and speed together, by least squares from random paths through this set.
    * `quick`: `spacetime` with fewer paths and steps, for large batches on a GPU.
    * `lattice`: plans eight paths among the walls, then the speed along each path among the moving
      obstacles, and selects the best plan.
    * `paper`: the planner of [Qu2022]: one path by Hybrid A*, smoothed, then the speed along it. It
      runs on the host and needs the extra `baselines`.
    * `em`: the best path of `lattice`, with the speed optimisation of the EM planner [Fan2018].
    * `constant`: the best path of `lattice` at constant speed; ignores moving obstacles.

    Args:
        name: name of the planner, as listed above.
        effort: "feasible" ends with the first plan that keeps every limit. "good" and "best" try
            more paths, for plans of less discomfort, or earlier ones with `meet="early"`.
        options: fields of the planner's class: `SpacetimeIntercept`, `PathThenSpeed` or
            `PaperIntercept`.

    Raises:
        ValueError: no planner has the requested name, or it does not support the effort.
    """
    return TASK.make_planner(name, options).with_effort(effort)


def judge(cases: InterceptCase, plans: InterceptPlan, **settings: object) -> InterceptVerdict:
    """Judge one plan, or a batch, by the referee, a check that is independent of the planners.

    The referee computes the positions of targets of the classes `TurningPath`, `PolynomialPath`,
    `ControlledPath` and `LaterPath` itself. For other classes it calls the target's method `at` in
    float64.

    The verdict has for each plan whether it is a `success`, the reason as text by `sentence(k)`,
    and the measured quantities. The settings are keyword arguments of `referee_intercepts`, such as
    `truth`: the true paths of the targets, if the paths in the cases are predictions.
    """
    require_kind("cases", cases, InterceptCase)
    target = cases.target
    if (truth := settings.get("truth")) is not None:
        require_path("truth", truth, cases.batch_shape, 2)
        target = cast(PlanePath, truth)
        if cases.batch_shape == ():
            one = jax.tree.map(lambda leaf: np.asarray(leaf)[None], truth)
            settings = {**settings, "truth": one}
    settings = {**position_setting(target), **settings}
    return judge_by(referee_intercepts, cases, plans, (InterceptCase, InterceptPlan), settings)


def position_setting(target: PlanePath) -> dict[str, object]:
    """Return the setting by which the referee evaluates targets of a user's own class.

    The result is {"target_positions": positions} with the function `positions` below. It is {} for
    the library's classes, whose positions the referee computes itself.
    """
    while isinstance(target, LaterPath):
        target = target.path
    known = TurningPath, PolynomialPath, ControlledPath
    return {} if type(target) in known else {"target_positions": positions}


def positions(target: PlanePath, times: Float[np.ndarray, " B"]) -> Float[np.ndarray, "B 2"]:
    """Return the positions [m] of B targets at B times [s], by their method `at` in float64."""
    with jax.enable_x64(True):
        double = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), target)
        return np.asarray(jax.vmap(lambda path, time: path.at(time).pos)(double, times))
