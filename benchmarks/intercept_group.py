"""Compare methods to decide in which order one car meets three targets.

    python -m benchmarks.intercept_group [--num 20] [--forty 0] [--seed 1] [--out DIR]

A case has the first three targets of a group of moving targets, drawn from the suite `group`. Four
methods are compared:
* plan all six orders, and use the best plan;
* plan the three orders with the earliest estimated last meeting, and use the best plan;
* the greedy order, which continues with the target that can be met next, by an estimate;
* the order in which the targets were drawn, which is random.

The referee, an independent check in float64, decides about success. Times of the last meeting are
averaged over groups that all four methods solve. They are compared with a lower bound, which no
plan can beat. For the bound, the car is replaced by a point that moves in a straight line to each
target, through obstacles, and that changes its direction instantly. Its speed is at most the speed
of the middle of a car at full acceleration from the start. It meets a target as soon as their
distance is within the case's tolerance. The bound is the earliest last meeting over all orders.

Planning times are for a second call, which compiles nothing, with all groups at once. The compile
time of the first listed method is the longest, because the other methods use the same programs. The
run's summary has the success rate of the first method.

With --forty the groups have 40 targets among 40 moving obstacles, of the suite `forty`, and are
planned by `direct` one by one. Their lower bound is described in `benchmarks.group_bound`.
"""

import argparse
import dataclasses
import itertools
import os
import time

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.group_bound import bound_end_time
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.plane.target import PlanePath
from planner_jax.task.group.case import InterceptGroup
from planner_jax.task.group.decide import Best
from planner_jax.task.group.plan import GroupPlan

TARGETS = 3
DECISIONS = {
    "best of all six orders": Best(6),
    "best of three orders": Best(3),
    "greedy": "greedy",
    "random": "given",
}
FORTY_STEP = 0.2  # [s] Time step of the lower bound for 40 targets.
FORTY_SHARE = 0.6  # End of the bound's last time step, divided by the end time of the plan.
STEP = 0.005  # [s] Time step of the lower bound on the time of the last meeting.


def draw(num: int, seed: int) -> InterceptGroup:
    """Draw `num` groups of moving targets in NumPy arrays; keep the first three of each group."""
    groups = jax.tree.map(np.asarray, pj.group.draw(num, seed=seed))
    present = np.broadcast_to(np.arange(groups.num_targets) < TARGETS, groups.present.shape)
    return dataclasses.replace(groups, present=present)


@jax.jit
@jax.vmap
def _places(paths: PlanePath, times: jax.Array) -> jax.Array:
    at = jax.vmap(lambda path, time: path.at(time).pos, (None, 0))
    return jax.vmap(at, (0, None))(paths, times)


def limit_times(groups: InterceptGroup) -> np.ndarray:
    """Return lower bounds (B,) [s] on the time at which a car has met the three targets of a group.

    There are B groups. The bound is infinite if no car can meet all targets.
    """
    shared = groups.shared
    num = int(np.ceil(shared.time.max() / STEP)) + 1
    times = np.broadcast_to(
        np.float32(STEP) * np.arange(num, dtype=np.float32), (len(shared.time), num)
    )
    places = np.asarray(_places(shared.target, times), float)
    limits, ahead = shared.limits, np.asarray(shared.body.middle)
    # On a path of curvature kappa the speed of the body's middle is sqrt(v^2 + (ahead v kappa)^2),
    # where v is the speed of the rear axle. The term (v kappa)^2 is the curvature kappa times the
    # lateral acceleration v^2 kappa, and both are limited.
    v = np.minimum(
        limits.speed[:, None], shared.speed[:, None] + limits.acceleration[:, None] * times
    )
    speed = np.sqrt(v**2 + (ahead**2 * limits.curvature * limits.lateral_acceleration)[:, None])
    travel = np.cumsum(STEP * np.concatenate([0.0 * speed[:, :1], speed[:, 1:]], axis=1), axis=1)
    start, tolerance = np.asarray(shared.start), np.asarray(shared.tolerance)
    heading = start[:, 2]
    middle = start[:, :2] + ahead[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
    orders = itertools.permutations(range(TARGETS))
    return np.min(
        [_meet_in_order(order, middle, travel, times, places, tolerance) for order in orders],
        axis=0,
    )


def _meet_in_order(
    order: tuple[int, ...],
    place: np.ndarray,
    travel: np.ndarray,
    times: np.ndarray,
    places: np.ndarray,
    tolerance: np.ndarray,
) -> np.ndarray:
    lanes, at, slack = np.arange(len(travel)), np.zeros(len(travel), int), tolerance
    met = np.ones(len(travel), bool)
    for target in order:
        far = np.linalg.norm(places[:, target] - place[:, None], axis=2)
        meets = far <= travel - travel[lanes, at, None] + slack[:, None]
        meets &= np.arange(travel.shape[1]) >= at[:, None]
        met &= meets.any(axis=1)
        # The meeting may be between two time steps. For a lower bound the earlier step is used.
        at = np.maximum(meets.argmax(axis=1) - 1, at)
        place, slack = places[lanes, target, at], 2.0 * tolerance
    return np.where(met, times[lanes, at], np.inf)


def time_planning(groups: InterceptGroup, decide: str | Best) -> tuple[GroupPlan, float, float]:
    """Plan all groups of targets twice, with one method to decide the order of the targets.

    `decide` is "greedy" (next the target that can be met next), "given" (the drawn order), or
    `Best(n)` (plan the n most promising orders, and use the best plan). Returns the plans, and the
    durations [s] of the first call, which compiles, and of the second.
    """
    planner, began = pj.group.planner(decide=decide), time.perf_counter()
    pj.plan(planner, groups)
    between = time.perf_counter()
    plans = pj.plan(planner, groups)
    return plans, between - began, time.perf_counter() - between


def measure(bench: Bench, options: argparse.Namespace) -> None:
    """Plan the groups with each method to order the targets, and print a row for each method.

    The methods plan all six orders, the three most promising, the greedy order, or a random order.
    """
    groups = draw(options.num, options.seed)
    least, found = limit_times(groups), {}
    for name, decide in DECISIONS.items():
        plans, cold, warm = time_planning(groups, decide)
        success = pj.group.judge(groups, plans).success
        found[name] = np.asarray(plans.cost), success, max(cold - warm, 0.0), warm
    common = np.all([success for _, success, _, _ in found.values()], axis=0)
    bench.say(
        f"{options.num} groups of {TARGETS}, seed {options.seed}; times of the {common.sum()} that "
        f"all solve; load average {os.getloadavg()[0]:.1f}",
        "",
        "| order | refereed success | last meeting, median | p90 | above the bound, median "
        "| as early as the best | ms a group, warm | compiling |",
        "|---|---|---|---|---|---|---|---|",
    )
    best, *_ = found["best of all six orders"]
    for name, (times, success, compiling, warm) in found.items():
        median, late = np.quantile(times[common], (0.5, 0.9))
        over = np.median(times[common] / least[common] - 1.0)
        same = np.mean(times[common] <= best[common] + 1e-3)
        each = 1e3 * warm / options.num
        bench.say(
            f"| {name} | {100 * success.mean():.1f} % | {median:.2f} s | {late:.2f} s "
            f"| {100 * over:.0f} % | {100 * same:.0f} % | {each:.0f} | {compiling:.0f} s |"
        )
        bench.row(
            order=name,
            success_rate=success.mean(),
            median=median,
            p90=late,
            over_bound=over,
            as_early_as_best=same,
            ms_a_group=each,
            compile_seconds=compiling,
        )
    median, late = np.quantile(least[common], (0.5, 0.9))
    bench.say(f"| bound | | {median:.2f} s | {late:.2f} s | 0 % | | | |")
    bench.note(bound_median=median, bound_p90=late)
    bench.count(found["best of all six orders"][1])


def bound_forty(groups: InterceptGroup, ends: np.ndarray) -> np.ndarray:
    """Return lower bounds (B,) [s] on the last meeting of B groups; `ends` (B,) are known times."""
    bounds = []
    for k, upper in enumerate(ends):
        shared = pj.take(groups.shared, k)
        times = FORTY_STEP * np.arange(int(np.ceil(FORTY_SHARE * upper / FORTY_STEP)) + 2)
        with jax.enable_x64(True):
            paths = jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], shared.target)
            places = np.asarray(_places(paths, times[None]))[0]
        limits, ahead = shared.limits, float(shared.body.middle)
        v = np.minimum(limits.speed, shared.speed + limits.acceleration * times)
        # The speed of the body's middle is v sqrt(1 + (ahead kappa)^2), with the curvature kappa at
        # most its limit and at most the limit of v^2 kappa, divided by v^2.
        bend = np.minimum(limits.curvature, limits.lateral_acceleration / np.maximum(v, 1e-6) ** 2)
        slow = np.sqrt(limits.lateral_acceleration / limits.curvature)
        slow = np.minimum(v, slow) * np.sqrt(1.0 + (ahead * limits.curvature) ** 2)
        fast = np.maximum(v * np.sqrt(1.0 + (ahead * bend) ** 2), slow)
        travel = np.concatenate([[0.0], np.cumsum(FORTY_STEP * fast[1:])])
        heading = shared.start[2]
        start = np.asarray(shared.start[:2]) + ahead * np.array([np.cos(heading), np.sin(heading)])
        tolerance = float(shared.tolerance)
        bounds.append(bound_end_time(places, travel, start, tolerance, FORTY_STEP))
    return np.array(bounds)


def measure_forty(bench: Bench, options: argparse.Namespace) -> None:
    """Plan groups of 40 targets one by one, and print success, planning times, times and gaps."""
    groups = jax.tree.map(np.asarray, pj.group.draw(options.forty, "forty", options.seed))
    planner, plans, seconds = pj.group.planner("direct", decide="search"), [], []
    began = time.perf_counter()
    pj.plan(planner, pj.take(groups, 0))
    cold = time.perf_counter() - began
    for k in range(options.forty):
        began = time.perf_counter()
        plans.append(pj.plan(planner, pj.take(groups, k)))
        seconds.append(time.perf_counter() - began)
    together = jax.tree.map(lambda *leaves: np.stack(leaves), *plans)
    success = pj.group.judge(groups, together).success
    good = np.flatnonzero(success)
    ends, median = together.cost[good], float(np.median(seconds))
    gaps = ends / bound_forty(pj.take(groups, good), ends) - 1.0
    bench.say(
        "",
        f"{options.forty} groups of 40 targets among 40 movers, seed {options.seed}; times of the "
        f"{good.size} solved",
        "",
        "| refereed success | last meeting, median | worst | above the bound, median | worst "
        "| s a group, warm, p50 | worst | compiling |",
        "|---|---|---|---|---|---|---|---|",
        f"| {100 * success.mean():.1f} % | {np.median(ends):.1f} s | {ends.max():.1f} s "
        f"| {100 * np.median(gaps):.0f} % | {100 * gaps.max():.0f} % | {median:.2f} "
        f"| {max(seconds):.2f} | {cold - median:.0f} s |",
    )
    bench.row(
        order="search, 40 targets",
        success_rate=success.mean(),
        median=np.median(ends),
        over_bound=np.median(gaps),
        worst_over_bound=gaps.max(),
        ms_a_group=1e3 * median,
        compile_seconds=cold - median,
    )
    bench.count(success)


def main() -> None:
    parser = argument_parser("intercept_group", __doc__, num=20, seed=1)
    what = "plan this number of groups of 40 targets instead"
    parser.add_argument("--forty", type=int, default=0, help=what)
    options = parser.parse_args()
    with begin(parser, options) as bench:
        if options.forty:
            measure_forty(bench, options)
        else:
            measure(bench, options)


if __name__ == "__main__":
    main()
