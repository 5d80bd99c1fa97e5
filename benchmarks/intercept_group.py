"""Compare methods to order three targets for one car, beside a lower bound on the time.

    python -m benchmarks.intercept_group [--num 20] [--seed 1] [--out DIR]

The first three targets of groups of the suite `group` are met in four orders: the best of all six
orders, each planned; the best of the three orders with the lowest estimates; the greedy order,
which continues with the target of the earliest estimated meeting; and the order in which the
targets were drawn, which is random. Success is judged by the referee. Times of the last meeting are
over groups that all four solve.

No plan meets all targets earlier than the bound, the minimum over all orders for a point that moves
straight in any direction at once, through obstacles. Its speed is at most the middle's speed
at full acceleration from the start. It meets targets within the case's tolerance, and may start the
next leg this tolerance away on the other side. Early meetings are optimal for this point, because
it is faster than its targets and can stay with them.

Planning times are of a second call for all groups at once. The first listed decision compiles most
programs, and the others share them. The summary's success is for the best of all orders.
"""

import argparse
import dataclasses
import itertools
import os
import time

import jax
import numpy as np

import planner_jax as pj
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
STEP = 0.005  # [s], time step of the bound


def draw(num: int, seed: int) -> InterceptGroup:
    """Draw groups of three targets, with NumPy leaves."""
    groups = jax.tree.map(np.asarray, pj.group.draw(num, seed=seed))
    present = np.broadcast_to(np.arange(groups.num_targets) < TARGETS, groups.present.shape)
    return dataclasses.replace(groups, present=present)


@jax.jit
@jax.vmap
def _places(paths: PlanePath, times: jax.Array) -> jax.Array:
    """Return positions (N, T, 2) [m] of targets with a leading axis N at times (T,) [s]."""
    at = jax.vmap(lambda path, time: path.at(time).pos, (None, 0))
    return jax.vmap(at, (0, None))(paths, times)


def limit_times(groups: InterceptGroup) -> np.ndarray:
    """Return lower bounds (B,) [s] on the time of the last of three meetings; inf if impossible."""
    shared = groups.shared
    num = int(np.ceil(shared.time.max() / STEP)) + 1
    times = np.broadcast_to(
        np.float32(STEP) * np.arange(num, dtype=np.float32), (len(shared.time), num)
    )
    places = np.asarray(_places(shared.target, times), float)
    limits, ahead = shared.limits, np.asarray(shared.body.middle)
    # The middle's speed is sqrt(v^2 + (ahead v kappa)^2), and (v kappa)^2 is the product of kappa
    # and v^2 kappa, and both have limits. It never decreases, so it is greatest at the end of
    # a step.
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
    """Return when (B,) [s] the bound's point meets the last target of an order; inf if never.

    Args:
        order: indices of the targets.
        place: (B, 2) [m], position of the point at time 0.
        travel: (B, T) [m], greatest distance covered up to each time.
        times: (B, T) [s].
        places: (B, N, T, 2) [m], positions of the targets.
        tolerance: (B,) [m].
    """
    lanes, at, slack = np.arange(len(travel)), np.zeros(len(travel), int), tolerance
    met = np.ones(len(travel), bool)
    for target in order:
        far = np.linalg.norm(places[:, target] - place[:, None], axis=2)
        meets = far <= travel - travel[lanes, at, None] + slack[:, None]
        meets &= np.arange(travel.shape[1]) >= at[:, None]
        met &= meets.any(axis=1)
        # It may meet the target between the time step before and this one.
        at = np.maximum(meets.argmax(axis=1) - 1, at)
        place, slack = places[lanes, target, at], 2.0 * tolerance
    return np.where(met, times[lanes, at], np.inf)


def time_planning(groups: InterceptGroup, decide: str | Best) -> tuple[GroupPlan, float, float]:
    """Return plans, and the durations [s] of the first and the second call."""
    planner, began = pj.group.planner(decide=decide), time.perf_counter()
    pj.plan(planner, groups)
    between = time.perf_counter()
    plans = pj.plan(planner, groups)
    return plans, between - began, time.perf_counter() - between


def measure(bench: Bench, options: argparse.Namespace) -> None:
    """Plan the groups with all four decisions, and print a row for each."""
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


def main() -> None:
    """Print a row for every decision, and the bound."""
    parser = argument_parser("intercept_group", __doc__, num=20, seed=1)
    options = parser.parse_args()
    with begin(parser, options) as bench:
        measure(bench, options)


if __name__ == "__main__":
    main()
