"""The functions `pj.intercept.draw`, `observe`, `planner` and `judge`."""

import zlib
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from planner_jax.core.checks import require_kind, require_path
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.core.registry import suite_named
from planner_jax.plane.target import LaterPath, PlanePath, PolynomialPath, TurningPath
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
    """Draw a batch of interceptions of a suite, with the arguments and errors of `pj.hit.draw`.

    The suite is "easy" by default, "medium", "hard", "storm", "gale", "maze", "rush", or a suite of
    another package. `draw_with_counts` also returns the number of rejected draws.
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
    """Draw noisy observations of the targets up to the time when the cars set out, or longer.

    See [Qu2022, eq. 4].

    Args:
        cases: leaves with leading axis B.
        seed: >= 0. The observations of case k are the same for every batch of a seed.
        noise: [m], standard deviation on each axis.
        count: number of observations up to time 0; the last of them is at time 0.
        interval: [s], between two observations.
        first: index of the first case, >= 0.
        until: [s], time of the last observation, >= 0. It does not change earlier observations.

    Returns:
        times: (L,) [s], L = count + floor(until / interval).
        positions: (B, L, 2) [m].

    Raises:
        ValueError: an argument is out of its range.
    """
    ranges = {"count": (count, 1), "noise": (noise, 0), "first": (first, 0), "until": (until, 0)}
    for name, (value, least) in ranges.items():
        if not value >= least:
            raise ArgumentError(name, f">= {least}", value)
    if not interval > 0.0:
        raise ArgumentError("interval", "> 0", interval)
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
    """Return positions (B, L, 2) [m] on paths with leading axis B at times (L,) [s]."""
    return jax.vmap(lambda path: jax.vmap(lambda time: path.at(time).pos)(times))(paths)


def planner(name: str = "spacetime", **options: object) -> Planner[InterceptCase, InterceptPlan]:
    """Make the intercept planner of a name.

    * `spacetime`: plans path and speed together, from a reach set in space and time.
    * `quick`: `spacetime` with fewer paths and steps, for large batches on a GPU.
    * `best`: `spacetime` with more paths and steps; selects the plan of least effort.
    * `lattice`: plans eight paths among the walls from a reach set, then a speed along each among
      the movers, and selects the best plan.
    * `paper`: the planner of [Qu2022]: one path by Hybrid A*, smoothed, then a speed along it. It
      runs on the host and needs the extra `baselines`.
    * `em`: the best path of `lattice` with the speed step of the EM planner.
    * `constant`: the best path of `lattice` at constant speed; it ignores the movers.

    Arguments and errors are as for `pj.hit.planner`. The options are the fields of
    `SpacetimeIntercept`, `PathThenSpeed` or `PaperIntercept`.
    """
    return TASK.make_planner(name, options)


def judge(cases: InterceptCase, plans: InterceptPlan, **settings: object) -> InterceptVerdict:
    """Judge one plan, or a batch of plans, with arguments, result and errors of `pj.hit.judge`.

    The referee computes the positions of `TurningPath`, `PolynomialPath` and `LaterPath` itself.
    It calls the method `at` of a target of any other class, in float64.

    The settings are keyword arguments of `referee_intercepts`, such as `truth`: the path, or a
    batch of paths, that the target really takes if the case holds a predicted path.
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
    """Return the setting that the referee needs for a target of a class that it does not know."""
    while isinstance(target, LaterPath):
        target = target.path
    is_known = type(target) in (TurningPath, PolynomialPath)
    return {} if is_known else {"target_positions": positions}


def positions(target: PlanePath, times: Float[np.ndarray, " B"]) -> Float[np.ndarray, "B 2"]:
    """Compute the positions [m] of targets (B,) of any class at times (B,) [s], in float64."""
    with jax.enable_x64(True):
        double = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), target)
        return np.asarray(jax.vmap(lambda path, time: path.at(time).pos)(double, times))
