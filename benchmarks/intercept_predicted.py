"""Measure interceptions of targets that are only predicted, with one plan and with re-planning.

    python -m benchmarks.intercept_predicted [--suite hard] [--num 40] [--seed 0] [--out DIR]

A target is observed 15 times, once a second up to the start, with noise of 0.1 m on each coordinate
[Qu2022, Section V-A], and `select` predicts its path. The planner knows walls and movers, but only
the prediction of the target. There are three rows for straight and for turning targets:

* `one shot`: one plan, driven to its end.
* `re-planned`: observations continue once a second while the car drives. After each one the target
is
  predicted from all observations so far, and the remainder is re-planned. The new plan replaces the
  old one if it keeps every limit.
* `known`: the target's path is known.

The car follows its plans exactly. If no plan keeps every limit, the body's middle may be 0.2 m from
the prediction at the meeting. If that fails too, and the car has no plan yet, it may meet a point
about 0.5 m beside the prediction. If that fails as well, the plan with the smallest excess is
driven, and planning from scratch is tried at every observation.

The whole driven trajectory, at steps of 20 ms, is judged by the referee as one plan against the
true target: every limit of the car, the map, polygons, and a meeting within 0.3 m at the case's
time. Misses are over all drives, even those with collisions. A case is solvable if some row solves
it. Printed beside the rows are the share of first predictions within 0.3 m at the case's time, and
the same share at the Cramer-Rao bound, which no unbiased predictor exceeds by much.
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

NOISE = 0.1  # [m], standard deviation of each observed coordinate
COUNT = 15  # observations up to the start
INTERVAL = 1.0  # [s], between two observations, and between two plans
RATE = 50.0  # [Hz], of the driven trajectory that the referee judges
RADII = (0.05, 0.3, 0.5)  # [m]
SUCCESS = 0.3  # [m], from the true target
CLOSE = 0.2  # [m], tolerance around the prediction if no plan keeps all limits
# [m], points around the prediction that are tried last.
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
    """Predict paths, leaves (B, ...), from observations (B, L, 2) [m] at times (B, L) [s]."""
    return select(times, seen, NOISE, weights).path


@jax.jit
@jax.vmap
def compute_bound(path: TurningPath, times: jax.Array, end: jax.Array) -> jax.Array:
    """Return shares (B,) within the success radius at the bound, for observations at (B, L) [s]."""
    straight, turning = (
        share_within(cramer_rao(path, times, NOISE, end, turning=turning), SUCCESS)
        for turning in (False, True)
    )
    return jax.numpy.where(path.turn_rate == 0.0, straight, turning)


@dataclasses.dataclass(frozen=True)
class Observations:
    """Observations of B targets, before the start and during the drive."""

    times: np.ndarray  # (L,) [s]
    places: np.ndarray  # (B, L, 2) [m]

    def paths(self, now: float) -> TurningPath:
        """Return paths, leaves (B, ...), predicted at time `now` [s], which is their time 0."""
        batch = len(self.places)
        times = np.tile((self.times - now).astype(np.float32), (batch, 1))
        seen = np.tile((self.times <= now).astype(np.float32), (batch, 1))
        return jax.tree.map(np.asarray, predict(times, self.places.astype(np.float32), seen))


def take_lanes(tree: Any, lanes: Any) -> Any:
    """Return the batch elements `lanes` of a pytree, on the host."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[lanes], tree)


def replace_lanes(tree: Any, lanes: np.ndarray, some: Any) -> Any:
    """Return a pytree with other values in the batch elements `lanes`, on the host."""

    def leaf(old: Any, new: Any) -> np.ndarray:
        changed = np.array(old)
        changed[lanes] = new
        return changed

    return jax.tree.map(leaf, tree, some)


def plan_cases(cases: InterceptCase, around: np.ndarray) -> InterceptPlan:
    """Plan from scratch; where that fails, with more tolerance, and then beside the target.

    Args:
        cases: leaves (B, ...).
        around: (B,) bool, whether a point beside the target is allowed.
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
    """Return the cases with a tolerance of `distance` [m]."""
    return dataclasses.replace(cases, tolerance=np.full_like(cases.tolerance, distance))


def plan_beside(cases: InterceptCase) -> InterceptPlan:
    """Plan to points around the target; return the first solved plan of each case."""
    num, path = len(PLACES), cast("Any", cases.target)
    many = take_lanes(cases, np.repeat(np.arange(len(cases.time)), num))
    moved = np.asarray(path.pos)[:, None] + PLACES
    target = dataclasses.replace(many.target, pos=moved.reshape(-1, 2).astype(np.float32))
    plans = pj.plan(PLANNER, loosen(dataclasses.replace(many, target=target), CLOSE))
    good = is_solved(plans.status).reshape(-1, num)
    return take_lanes(plans, num * np.arange(len(good)) + good.argmax(axis=1))


@dataclasses.dataclass
class Drives:
    """Drives of B cars: speed and curvature every 20 ms, from the start to the case's time."""

    plans: InterceptPlan  # currently driven
    cases: InterceptCase  # problems that these plans solve
    began: np.ndarray  # (B,) [s], when these plans began
    had_plan: np.ndarray  # (B,) bool, whether the first plan keeps every limit
    speed: np.ndarray  # (B, S) [m/s]
    curvature: np.ndarray  # (B, S) [1/m]

    @classmethod
    def start(cls, cases: InterceptCase) -> "Drives":
        """Create drives that follow their first plans."""
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
        """Plan again at a time [s], for targets predicted from then on."""
        again = PLANNER.replanner()
        task = again.begin(self.cases, self.plans, now - self.began, target=target)
        plans = pj.plan(again, task)
        lanes = np.flatnonzero(~is_solved(plans.status))
        if lanes.size:
            is_lost = np.asarray(~is_solved(self.plans.status[lanes]))
            plans = replace_lanes(plans, lanes, plan_cases(take_lanes(task.case, lanes), is_lost))
        # A plan that exceeds a limit replaces only another such plan.
        lanes = np.flatnonzero(is_solved(plans.status) | ~is_solved(self.plans.status))
        new, first = take_lanes(plans, lanes), round(now * RATE)
        setpoints = new.sample(RATE)
        self.plans = replace_lanes(self.plans, lanes, new)
        self.cases = replace_lanes(self.cases, lanes, take_lanes(task.case, lanes))
        self.began[lanes] = now
        self.speed[lanes, first:] = setpoints.speed
        self.curvature[lanes, first:] = setpoints.curvature

    def judge(self, truth: InterceptCase) -> InterceptVerdict:
        """Return the referee's verdict on the whole drives, against the true targets."""
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
    """Drive B cases, and re-plan at every observation before a time [s].

    Args:
        cases: the true cases.
        observed: observations of the targets; None if the targets are known.
        until: [s]; 0 drives the first plans.
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
    """Print a line for each row and kind of target, (B,) bool, and which drives failed."""
    verdicts = {name: drives.judge(truth) for name, (drives, _) in rows.items()}
    # Cases that no row solves, not even with a known target, are left out of the last share.
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
    """Print the predictor's share within the success radius at the case's time, and the bound's."""
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
    """Print the table, and the results of the predictor alone."""
    parser = argument_parser("intercept_predicted", __doc__, num=40, seed=0)
    parser.add_argument("--suite", choices=SUITES, default="hard", help="default: hard")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        truth = take_lanes(pj.intercept.draw(options.num, options.suite, options.seed), slice(None))
        turning = np.asarray(cast("Any", truth.target).turn_rate) != 0.0
        end = float(truth.time[0])  # equal for all cases of a suite
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
