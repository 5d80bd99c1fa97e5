"""Measure how often a car meets a target whose path it must predict from noisy observations.

    python -m benchmarks.intercept_predicted [--suite hard] [--num 40] [--seed 0] [--out DIR]

A moving target is observed 15 times, once a second up to the start, with noise of 0.1 m on each
coordinate [Qu2022, Section V-A]. The function `select` predicts its path. The planner knows walls
and moving obstacles exactly. There are three rows for straight and for turning targets:

* `one shot`: the target is predicted once, and one plan is driven to its end.
* `re-planned`: observations continue once a second while the car drives. After each observation the
  target is predicted again, and the remaining motion is planned again. The new plan replaces the
  old plan if it keeps every limit.
* `known`: the target's true path is known, and one plan is driven to its end.

The car follows its plans exactly. If no plan keeps every limit, the tolerance of the meeting is
increased to 0.2 m. If planning fails again, and the car does not follow a solved plan yet, plans to
eight points 0.5 m around the predicted target are tried. If all these plans fail, the car drives
the plan with the smallest excess over a limit, and plans from scratch at every later observation.

The referee, an independent check in float64, judges the whole driven trajectory, at steps of 20 ms,
as one plan against the true target. It checks the limits of the car, the map, collisions with
polygons, and a distance of at most 0.3 m from the target at the case's time. The table lists this
distance, called miss, over all drives, including drives with a collision. A case is solvable if at
least one of the rows solves it.

Finally the program prints which share of the first predictions is within 0.3 m of the true target
at the case's time. It also prints this share for a predictor at the Cramer-Rao bound, which is
about the best that an unbiased predictor can reach.
"""

import dataclasses
import time
from typing import Any, cast

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.prediction_bounds import cramer_rao, share_within
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.core.protocol import is_solved
from planner_jax.plane.target import TurningPath
from planner_jax.referee.intercept import InterceptVerdict
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.sims.prediction.select_path import select
from planner_jax.task.intercept.api import positions
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.spec import SUITES

NOISE = 0.1  # [m] Standard deviation of each observed coordinate.
COUNT = 15  # Number of observations up to the start.
INTERVAL = 1.0  # [s] Time between two observations, and between two plans.
RATE = 50.0  # [Hz] Sampling rate of the driven trajectory that the referee judges.
RADII = (0.05, 0.3, 0.5)  # [m] The table lists which shares of drives end this near the target.
SUCCESS = 0.3  # [m] Greatest distance from the true target of a successful meeting.
CLOSE = 0.2  # [m] Tolerance of the meeting in a second attempt, if the first plan fails.
# [m] Points around the predicted target, relative to it. The car plans to them if other plans fail.
PLACES = 0.5 * np.stack([f(np.arange(8) * np.pi / 4.0) for f in (np.cos, np.sin)], axis=1)
PLANNER = SpacetimeIntercept()
MODES = ("straight", "turning")
HEADER = (
    "| target | row | num | success % (95 %) | success of the solvable, % | "
    "<= 0.05 / 0.3 / 0.5 m, % | "
    "miss p50, m | first plan keeps all limits, % | failed limits | s |"
)


@jax.jit
@jax.vmap
def predict(times: jax.Array, seen: jax.Array, weights: jax.Array) -> TurningPath:
    """Predict the paths of B targets from observations (B, L, 2) [m] at times (B, L) [s].

    The fit weights the L observations of each target by `weights` (B, L).
    """
    return select(times, seen, NOISE, weights)


@jax.jit
@jax.vmap
def compute_bound(path: TurningPath, times: jax.Array, end: jax.Array) -> jax.Array:
    """Return the probabilities (B,) that the error of a best unbiased prediction is below 0.3 m.

    The predictions are for B targets at the times `end` (B,) [s], from observations at L times
    each, `times` (B, L) [s]. The covariance of the errors is the Cramer-Rao bound.
    """
    straight, turning = (
        share_within(cramer_rao(path, times, NOISE, end, turning=turning), SUCCESS)
        for turning in (False, True)
    )
    return jax.numpy.where(path.turn_rate == 0.0, straight, turning)


@dataclasses.dataclass(frozen=True)
class Observations:
    """Observations of B targets, before the start and during the drive."""

    times: np.ndarray  # (L,) [s], times of the observations
    places: np.ndarray  # (B, L, 2) [m], observed positions

    def paths(self, now: float) -> TurningPath:
        """Predict the paths of all B targets from the observations up to the time `now` [s].

        Time 0 of the predicted paths is `now`.
        """
        batch = len(self.places)
        times = np.tile((self.times - now).astype(np.float32), (batch, 1))
        seen = np.tile((self.times <= now).astype(np.float32), (batch, 1))
        return jax.tree.map(np.asarray, predict(times, self.places.astype(np.float32), seen))


def take_lanes(tree: Any, lanes: Any) -> Any:
    """Return the elements with indices `lanes` of a batched pytree, in NumPy arrays."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[lanes], tree)


def replace_lanes(tree: Any, lanes: np.ndarray, some: Any) -> Any:
    """Return a batched pytree in which `some` replaces the elements with indices `lanes`."""

    def leaf(old: Any, new: Any) -> np.ndarray:
        changed = np.array(old)
        changed[lanes] = new
        return changed

    return jax.tree.map(leaf, tree, some)


def plan_cases(cases: InterceptCase, around: np.ndarray) -> InterceptPlan:
    """Plan B cases from scratch, and unsolved cases again with weaker requirements.

    Unsolved cases are planned with a tolerance of the meeting of 0.2 m. If this fails too, they are
    planned to eight points 0.5 m around the target.

    Args:
        cases: a batch, leaves (B, ...).
        around: (B,) bool, whether the case may be planned to a point around the target.
    """
    plans = pj.plan(PLANNER, cases)
    lanes = np.flatnonzero(~is_solved(plans.status))
    if lanes.size:
        found = pj.plan(PLANNER, loosen(take_lanes(cases, lanes), CLOSE))
        better = is_solved(found.status)
        plans = replace_lanes(plans, lanes[better], take_lanes(found, better))
    lanes = np.flatnonzero(~is_solved(plans.status) & around)
    if lanes.size:
        found = plan_beside(take_lanes(cases, lanes))
        better = is_solved(found.status)
        plans = replace_lanes(plans, lanes[better], take_lanes(found, better))
    return plans


def loosen(cases: InterceptCase, distance: float) -> InterceptCase:
    """Return cases in which the meeting may be up to `distance` [m] from the target."""
    return dataclasses.replace(cases, tolerance=np.full_like(cases.tolerance, distance))


def plan_beside(cases: InterceptCase) -> InterceptPlan:
    """Plan each case to eight points 0.5 m around its target; return its first solved plan."""
    num, path = len(PLACES), cast("Any", cases.target)
    many = take_lanes(cases, np.repeat(np.arange(len(cases.time)), num))
    moved = np.asarray(path.pos)[:, None] + PLACES
    target = dataclasses.replace(many.target, pos=moved.reshape(-1, 2).astype(np.float32))
    plans = pj.plan(PLANNER, loosen(dataclasses.replace(many, target=target), CLOSE))
    good = is_solved(plans.status).reshape(-1, num)
    return take_lanes(plans, num * np.arange(len(good)) + good.argmax(axis=1))


@dataclasses.dataclass
class Drives:
    """Drives of B cars: speed and curvature every 20 ms, from the start to the meeting."""

    plans: InterceptPlan  # plans that the cars follow at present
    cases: InterceptCase  # problems that these plans solve
    began: np.ndarray  # (B,) [s], times at which the cars began to follow these plans
    had_plan: np.ndarray  # (B,) bool, whether the first plan keeps every limit
    speed: np.ndarray  # (B, S) [m/s], speed at each sample of the drive
    curvature: np.ndarray  # (B, S) [1/m], curvature of the path at each sample

    @classmethod
    def start(cls, cases: InterceptCase) -> "Drives":
        """Plan all cases from scratch, and create drives that follow these first plans."""
        plans = plan_cases(cases, np.ones(cases.batch_shape, bool))
        setpoints = plans.sample(RATE)
        return cls(
            plans,
            cases,
            began=np.zeros(cases.batch_shape),
            had_plan=np.asarray(is_solved(plans.status)),
            speed=setpoints.speed,
            curvature=setpoints.curvature,
        )

    def renew(self, now: float, target: TurningPath) -> None:
        """Plan all drives again at the time `now` [s], for targets that are predicted anew.

        Time 0 of the predicted paths `target` is `now`.
        """
        again = PLANNER.replanner()
        task = again.begin(self.cases, self.plans, now - self.began, target=target)
        plans = pj.plan(again, task)
        lanes = np.flatnonzero(~is_solved(plans.status))
        if lanes.size:
            is_lost = np.asarray(~is_solved(self.plans.status[lanes]))
            plans = replace_lanes(plans, lanes, plan_cases(take_lanes(task.case, lanes), is_lost))
        # A new plan that exceeds a limit replaces an old plan only if the old plan exceeds a limit.
        lanes = np.flatnonzero(is_solved(plans.status) | ~is_solved(self.plans.status))
        new, first = take_lanes(plans, lanes), round(now * RATE)
        setpoints = new.sample(RATE)
        self.plans = replace_lanes(self.plans, lanes, new)
        self.cases = replace_lanes(self.cases, lanes, take_lanes(task.case, lanes))
        self.began[lanes] = now
        self.speed[lanes, first:] = setpoints.speed
        self.curvature[lanes, first:] = setpoints.curvature

    def judge(self, truth: InterceptCase) -> InterceptVerdict:
        """Judge the whole drives against the true targets by the referee, an independent check."""
        loose = dataclasses.replace(truth, tolerance=np.full_like(truth.tolerance, SUCCESS))
        whole = dataclasses.replace(
            self.plans,
            start=truth.start,
            time=truth.time,
            speed=self.speed,
            curvature=self.curvature,
        )
        return pj.intercept.judge(loose, whole)


def drive(cases: InterceptCase, observed: Observations | None, until: float) -> Drives:
    """Simulate the drives of B cases, which are planned again at every observation.

    Args:
        cases: the cases with the true targets.
        observed: observations of the targets; None if the planner knows the true targets.
        until: [s], time after which drives are not planned again; 0 for no re-planning.
    """
    if observed is None:
        return Drives.start(cases)
    drives = Drives.start(dataclasses.replace(cases, target=observed.paths(0.0)))
    for now in observed.times[(observed.times > 0.0) & (observed.times < until)]:
        drives.renew(now, observed.paths(now))
    return drives


def report(
    bench: Bench,
    rows: dict[str, tuple[Drives, float]],
    truth: InterceptCase,
    turning: np.ndarray,
) -> None:
    """Judge all drives; print success rates for straight and for turning targets, and failures.

    Args:
        bench: prints the lines.
        rows: "one shot", "re-planned" or "known" -> drives with this knowledge of the target, and
            the wall-clock time of their simulation and planning [s].
        truth: the cases with the true targets.
        turning: (B,) bool, whether the target turns.
    """
    verdicts = {name: drives.judge(truth) for name, (drives, _) in rows.items()}
    # The column "success of the solvable" leaves out cases in which the drives of all rows fail.
    solvable = np.any([verdict.success for verdict in verdicts.values()], axis=0)
    for mode, is_of_mode in zip(MODES, (~turning, turning), strict=True):
        if not solvable[is_of_mode].any():
            bench.say(f"{mode}: no case that any row solves")
            continue
        for name, verdict in verdicts.items():
            drives, seconds = rows[name]
            good, miss = verdict.success[is_of_mode], verdict.miss[is_of_mode]
            num, could = len(good), int(solvable[is_of_mode].sum())
            low, high = wilson_interval(int(good.sum()), num)
            inside = [int((miss <= radius).sum()) for radius in RADII]
            limits, counts = np.unique(
                verdict.failed_limit[is_of_mode & ~verdict.success], return_counts=True
            )
            fails = dict(zip(limits.tolist(), counts.tolist(), strict=True))
            bench.say(
                f"| {mode} | {name} | {num} | {percent(int(good.sum()), num)} "
                f"({100 * low:.1f} to {100 * high:.1f}) | {percent(int(good.sum()), could)} | "
                f"{' / '.join(percent(each, num) for each in inside)} | {np.median(miss):.3f} | "
                f"{percent(int(drives.had_plan[is_of_mode].sum()), num)} | "
                f"{', '.join(f'{limit} {count}' for limit, count in fails.items())} | "
                f"{seconds:.0f} |"
            )
            bench.row(
                target=mode,
                row=name,
                num=num,
                success=good.mean(),
                success_of_solvable=good.sum() / could,
                within=np.array(inside) / num,
                miss_median=np.median(miss),
                fails=fails,
                failed=np.flatnonzero(is_of_mode & ~verdict.success),
                seconds=seconds,
            )
    bench.count(verdicts["re-planned"].success)
    for name, verdict in verdicts.items():
        if name != "one shot":
            bench.say("", f"{name}, drives that fail:")
            bench.say(
                *(f"* {k}: {verdict.sentence(int(k))}" for k in np.flatnonzero(~verdict.success))
            )


def report_bound(
    bench: Bench, observed: Observations, truth: InterceptCase, turning: np.ndarray
) -> None:
    """Print the share of predictions within 0.3 m of the target, made at the start of the drive.

    The target is predicted at the time of the meeting. Also print this share for the best unbiased
    predictor, by the Cramer-Rao bound.
    """
    times = np.asarray(truth.time)
    there = positions(truth.target, times)
    off = np.linalg.norm(positions(observed.paths(0.0), times) - there, axis=1)
    before = observed.times[observed.times <= 0.0].astype(np.float32)
    bound = compute_bound(truth.target, np.tile(before, (len(off), 1)), times)
    for mode, is_of_mode in zip(MODES, (~turning, turning), strict=True):
        if not is_of_mode.any():
            continue
        mine, least = (off[is_of_mode] <= SUCCESS).mean(), np.asarray(bound)[is_of_mode].mean()
        bench.say(
            f"{mode}: {100 * mine:.1f} % of first predictions are within {SUCCESS:g} m at the "
            f"case's time, {100 * least:.1f} % at the Cramer-Rao bound"
        )
        bench.note(**{f"{mode}_predicted": mine, f"{mode}_bound": least})


def main() -> None:
    parser = argument_parser("intercept_predicted", __doc__, num=40, seed=0)
    parser.add_argument("--suite", choices=SUITES, default="hard", help="default: hard")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        truth = take_lanes(pj.intercept.draw(options.num, options.suite, options.seed), slice(None))
        turning = np.asarray(cast("Any", truth.target).turn_rate) != 0.0
        end = float(truth.time[0])  # All cases of a suite have the same time of the meeting.
        observed = Observations(
            *pj.intercept.observe(truth, options.seed, NOISE, COUNT, INTERVAL, until=end)
        )
        device = jax.devices()[0].device_kind
        bench.say(f"{options.num} cases, suite {options.suite}, seed {options.seed}; {device}", "")
        rows = {}
        for name, seen, until in (
            ("one shot", observed, 0.0),
            ("re-planned", observed, end),
            ("known", None, 0.0),
        ):
            began = time.perf_counter()
            rows[name] = drive(truth, seen, until), time.perf_counter() - began
        bench.say(HEADER, "|---" * HEADER.count(" | ") + "|---|")
        report(bench, rows, truth, turning)
        bench.say("")
        report_bound(bench, observed, truth, turning)


if __name__ == "__main__":
    main()
