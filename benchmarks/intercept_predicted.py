"""Targets that are only predicted: one plan, and plans made anew while the car drives.

    python -m benchmarks.intercept_predicted [--suite hard] [--num 40] [--seed 0] [--out DIR]

A target is seen 15 times, once a second up to the start, with noise of 0.1 m on each coordinate
[Qu2022, Section V-A], and `select` says where it will go; the planner knows walls and movers,
but of the target the prediction alone. Rows, for targets that go straight and for those that turn:

* `one shot`: one plan, driven to its end.
* `planned anew`: looks go on once a second while the car drives. After each one the target is
  predicted from all looks until then, and what is left is planned anew. The new plan takes over
  if it keeps every limit, otherwise the old one is driven on.
* `known`: the target's way is known.

The car drives its plans exactly. Where no plan keeps every limit, the middle may be 0.2 m from the
prediction at the meeting, and where a car has no plan yet, about 0.5 m beside it; where that does
not help either, the plan that exceeds a limit least is driven, and planning from scratch is tried
at every look. The whole way that was driven, at steps of 20 ms, is given to the referee as one
plan, against the true target: every limit of the car, the map, polygons, and a meeting within 0.3 m
at the case's time. Misses are told of all drives, whatever they touched; solvable are cases that
some row meets. Beside them stand the predictor's own share within 0.3 m at the case's time, and
that at the Cramer-Rao bound: what no unbiased predictor exceeds by much.
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

NOISE = 0.1  # [m], standard deviation of a coordinate that is seen
COUNT = 15  # looks up to the start
INTERVAL = 1.0  # [s], between two looks, and between two plans
RATE = 50.0  # [Hz], of what is driven, as the referee looks at it
RADII = (0.05, 0.3, 0.5)  # [m]
SUCCESS = 0.3  # [m], from the true target
CLOSE = 0.2  # [m], from the prediction, where no plan meets it more closely
# [m], where no plan does that either: places around the prediction.
PLACES = 0.5 * np.stack([f(np.arange(8) * np.pi / 4.0) for f in (np.cos, np.sin)], axis=1)
PLANNER = SpacetimeIntercept()
MODES = ("straight", "turning")
HEADER = (
    "| target | row | num | success % (95 %) | of the solvable, % | <= 0.05 / 0.3 / 0.5 m, % | "
    "miss p50, m | first plan keeps all limits, % | fails by | s |"
)


@jax.jit
@jax.vmap
def predict(times: jax.Array, seen: jax.Array, weights: jax.Array) -> TurningPath:
    """Expected paths, leaves (B, ...), from looks at times (B, L) [s] of places (B, L, 2) [m]."""
    return select(times, seen, NOISE, weights).path


@jax.jit
@jax.vmap
def at_bound(path: TurningPath, times: jax.Array, end: jax.Array) -> jax.Array:
    """Shares (B,) within the success radius at the bound, of looks at times (B, L) [s]."""
    straight, turning = (
        share_within(cramer_rao(path, times, NOISE, end, turning=turning), SUCCESS)
        for turning in (False, True)
    )
    return jax.numpy.where(path.turn_rate == 0.0, straight, turning)


@dataclasses.dataclass(frozen=True)
class Looks:
    """What is seen of B targets, before the start and on the way."""

    times: np.ndarray  # (L,) [s]
    places: np.ndarray  # (B, L, 2) [m]

    def paths(self, now: float) -> TurningPath:
        """Paths that are expected at a time [s], which count from then, leaves (B, ...)."""
        batch = len(self.places)
        times = np.tile((self.times - now).astype(np.float32), (batch, 1))
        seen = np.tile((self.times <= now).astype(np.float32), (batch, 1))
        return jax.tree.map(np.asarray, predict(times, self.places.astype(np.float32), seen))


def taken(tree: Any, lanes: Any) -> Any:
    """Some lanes of a pytree, on the host."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[lanes], tree)


def put(tree: Any, lanes: np.ndarray, some: Any) -> Any:
    """A pytree with other values in some lanes, on the host."""

    def leaf(old: Any, new: Any) -> np.ndarray:
        changed = np.array(old)
        changed[lanes] = new
        return changed

    return jax.tree.map(leaf, tree, some)


def planned(cases: InterceptCase, around: np.ndarray) -> InterceptPlan:
    """Plans from scratch; what cannot be met is met less closely, and then beside.

    Args:
        cases: leaves (B, ...).
        around: (B,) bool, for which a place beside the target is better than no plan.
    """
    plans = pj.plan(PLANNER, cases)
    lanes = np.flatnonzero(~is_solved(plans.status))
    if lanes.size:
        found = pj.plan(PLANNER, within(taken(cases, lanes), CLOSE))
        better = is_solved(found.status)
        plans = put(plans, lanes[better], taken(found, better))
    lanes = np.flatnonzero(~is_solved(plans.status) & around)
    if lanes.size:
        found = beside(taken(cases, lanes))
        better = is_solved(found.status)
        plans = put(plans, lanes[better], taken(found, better))
    return plans


def within(cases: InterceptCase, distance: float) -> InterceptCase:
    """Cases that may be met at a distance [m]."""
    return dataclasses.replace(cases, tolerance=np.full_like(cases.tolerance, distance))


def beside(cases: InterceptCase) -> InterceptPlan:
    """Plans that end at one of some places around the target; the first one that has a plan."""
    num, path = len(PLACES), cast("Any", cases.target)
    many = taken(cases, np.repeat(np.arange(len(cases.time)), num))
    moved = np.asarray(path.pos)[:, None] + PLACES
    target = dataclasses.replace(many.target, pos=moved.reshape(-1, 2).astype(np.float32))
    plans = pj.plan(PLANNER, within(dataclasses.replace(many, target=target), CLOSE))
    good = is_solved(plans.status).reshape(-1, num)
    return taken(plans, num * np.arange(len(good)) + good.argmax(axis=1))


@dataclasses.dataclass
class Drives:
    """What B cars drive: speed and curvature every 20 ms, from the start to the case's time."""

    plans: InterceptPlan  # that are driven now
    cases: InterceptCase  # what these are of
    began: np.ndarray  # (B,) [s], when these began
    had_plan: np.ndarray  # (B,) bool, whose first plan keeps every limit
    speed: np.ndarray  # (B, S) [m/s]
    curvature: np.ndarray  # (B, S) [1/m]

    @classmethod
    def begun(cls, cases: InterceptCase) -> "Drives":
        """Cars that drive their first plans."""
        plans = planned(cases, np.ones(cases.batch_shape, bool))
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
        """Plan anew at a time [s], for where targets are expected from then on."""
        again = PLANNER.replanner()
        task = again.begin(self.cases, self.plans, now - self.began, target=target)
        plans = pj.plan(again, task)
        lanes = np.flatnonzero(~is_solved(plans.status))
        if lanes.size:
            is_lost = np.asarray(~is_solved(self.plans.status[lanes]))
            plans = put(plans, lanes, planned(taken(task.case, lanes), is_lost))
        # One that exceeds a limit is driven only instead of another such.
        lanes = np.flatnonzero(is_solved(plans.status) | ~is_solved(self.plans.status))
        new, first = taken(plans, lanes), round(now * RATE)
        setpoints = new.sample(RATE)
        self.plans = put(self.plans, lanes, new)
        self.cases = put(self.cases, lanes, taken(task.case, lanes))
        self.began[lanes] = now
        self.speed[lanes, first:] = setpoints.speed
        self.curvature[lanes, first:] = setpoints.curvature

    def judged(self, truth: InterceptCase) -> InterceptVerdict:
        """What the referee says of the whole way, held against what is true."""
        asked = dataclasses.replace(truth, tolerance=np.full_like(truth.tolerance, SUCCESS))
        whole = dataclasses.replace(
            self.plans,
            start=truth.start,
            time=truth.time,
            speed=self.speed,
            curvature=self.curvature,
        )
        return pj.intercept.judge(asked, whole)


def drive(cases: InterceptCase, looks: Looks | None, until: float) -> Drives:
    """Drives of B cases with plans made anew at every look before a time [s].

    Args:
        cases: as they truly are.
        looks: what is seen of the targets; None where they are known.
        until: [s]; 0 drives the first plans.
    """
    if looks is None:
        return Drives.begun(cases)
    drives = Drives.begun(dataclasses.replace(cases, target=looks.paths(0.0)))
    for now in looks.times[(looks.times > 0.0) & (looks.times < until)]:
        drives.renew(now, looks.paths(now))
    return drives


def report(
    bench: Bench,
    rows: dict[str, tuple[Drives, float]],
    truth: InterceptCase,
    turning: np.ndarray,
) -> None:
    """Print a line for each row and kind of target, (B,) bool, and which drives failed."""
    verdicts = {name: drives.judged(truth) for name, (drives, _) in rows.items()}
    # What no row meets, the one that knows the target among them, is left out of the last share.
    solvable = np.any([verdict.success for verdict in verdicts.values()], axis=0)
    for mode, is_of_mode in zip(MODES, (~turning, turning), strict=True):
        for name, verdict in verdicts.items():
            drives, seconds = rows[name]
            good, miss = verdict.success[is_of_mode], verdict.miss[is_of_mode]
            num, could = len(good), int(solvable[is_of_mode].sum())
            low, high = wilson_interval(int(good.sum()), num)
            within = [int((miss <= radius).sum()) for radius in RADII]
            limits, counts = np.unique(
                verdict.failed_limit[is_of_mode & ~verdict.success], return_counts=True
            )
            fails = dict(zip(limits.tolist(), counts.tolist(), strict=True))
            bench.say(
                f"| {mode} | {name} | {num} | {percent(int(good.sum()), num)} "
                f"({100 * low:.1f} to {100 * high:.1f}) | {percent(int(good.sum()), could)} | "
                f"{' / '.join(percent(each, num) for each in within)} | {np.median(miss):.3f} | "
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
                within=np.array(within) / num,
                miss_median=np.median(miss),
                fails=fails,
                failed=np.flatnonzero(is_of_mode & ~verdict.success),
                seconds=seconds,
            )
    bench.count(verdicts["planned anew"].success)
    for name, verdict in verdicts.items():
        if name != "one shot":
            bench.say("", f"{name}, drives that fail:")
            bench.say(
                *(f"* {k}: {verdict.sentence(int(k))}" for k in np.flatnonzero(~verdict.success))
            )


def report_bound(bench: Bench, looks: Looks, truth: InterceptCase, turning: np.ndarray) -> None:
    """Print what the predictor reaches at the case's time, and what could be reached."""
    times = np.asarray(truth.time)
    there = positions(truth.target, times)
    off = np.linalg.norm(positions(looks.paths(0.0), times) - there, axis=1)
    before = looks.times[looks.times <= 0.0].astype(np.float32)
    bound = at_bound(truth.target, np.tile(before, (len(off), 1)), times)
    for mode, is_of_mode in zip(MODES, (~turning, turning), strict=True):
        mine, least = (off[is_of_mode] <= SUCCESS).mean(), np.asarray(bound)[is_of_mode].mean()
        bench.say(
            f"{mode}: {100 * mine:.1f} % of first predictions are within {SUCCESS:g} m at the "
            f"case's time, {100 * least:.1f} % at the Cramer-Rao bound"
        )
        bench.note(**{f"{mode}_predicted": mine, f"{mode}_bound": least})


def main() -> None:
    """Print the table, and what the predictor alone reaches."""
    parser = argument_parser("intercept_predicted", __doc__, num=40, seed=0)
    parser.add_argument("--suite", choices=SUITES, default="hard")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        truth = taken(pj.intercept.draw(options.num, options.suite, options.seed), slice(None))
        turning = np.asarray(cast("Any", truth.target).turn_rate) != 0.0
        end = float(truth.time[0])  # the same of all cases of a suite
        looks = Looks(*pj.intercept.observe(truth, options.seed, NOISE, COUNT, INTERVAL, until=end))
        device = jax.devices()[0].device_kind
        bench.say(f"{options.num} cases, suite {options.suite}, seed {options.seed}; {device}", "")
        rows = {}
        for name, seen, until in (
            ("one shot", looks, 0.0),
            ("planned anew", looks, end),
            ("known", None, 0.0),
        ):
            began = time.perf_counter()
            rows[name] = drive(truth, seen, until), time.perf_counter() - began
        bench.say(HEADER, "|---" * HEADER.count(" | ") + "|---|")
        report(bench, rows, truth, turning)
        bench.say("")
        report_bound(bench, looks, truth, turning)


if __name__ == "__main__":
    main()
