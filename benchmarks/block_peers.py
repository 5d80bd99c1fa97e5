"""Compare all block planners on the same throws, beside Tables I and II of [Natarajan2024].

    python -m benchmarks.block_peers [--suite pole] [--regime R1] [--num 100] [--width W]

A robot arm blocks thrown balls with a shield. A ball counts as blocked only if the referee, an
independent check in float64, accepts the plan, whatever the planner reports. The column `found`
counts motions without a collision, even if they are too late for the ball. One call plans one throw
on one core, from NumPy arrays to NumPy arrays. Compile time is not counted.

`insat-expansion` computes a spline for each expanded state instead of each edge of the search. The
last table has the states that the searches of `insat` and `pinsat` expand in a second of planning.
With --width, `pinsat` and `epase` expand up to W states at once; on a GPU wide batches pay.

For the column `with query time`, the planning time and the motion must together fit between the
time at which the arm may start and the contact. Motions of `online` and `brisk` always end at the
contact, so any planning time would make them late. These two planners therefore plan a second time,
for an arm that starts later by the 90 % quantile of all planning times. A plan counts as failed if
its own planning time exceeds this quantile.

The execution time is how long the arm moves. Torques are root mean squares over the execution time,
computed by inverse dynamics with the masses of the links and a massless shield. Execution times and
torques are averaged over the throws that the planner blocks, and over the throws that all planners
block.

The paper's rows are quoted as printed. They are for throws that are not published: 200 by the text,
209 by the percentages, which are multiples of 1/209. The paper used a Threadripper Pro 5995WX. It
does not state its limits, poses and definition of torques. Its numbers are therefore not comparable
with numbers measured here. Compare the ratios between the planners of each table instead.
"""

import dataclasses
import importlib.util
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

import planner_jax as pj
from planner_jax.baselines.block.epase import OpenStates
from planner_jax.baselines.block.insat import InsatBlock
from planner_jax.baselines.block.pose_by_pose import Goal
from planner_jax.baselines.protocols import BY_ROW
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.core import GRAVITY
from planner_jax.referee.block import BlockVerdict
from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_dynamics import inverse_dynamics
from planner_jax.runs.timing import measure_plans
from planner_jax.sweep.block.settings import REGIMES
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.spec import SUITES
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, total_duration

PEERS = "ompl and toppra not installed: pip install 'planner-jax[arm-peers]' for rrt-connect, epase"
# Row of the printed table -> planner and its options. `direct` tries up to 384 straight motions, in
# which all joints move in proportion, and `direct-soonest` only one. Rows with "-plain" use the
# first path that the planner finds without improving it, as the planners of [Natarajan2024]
# presumably do.
PLANNERS: dict[str, tuple[str, dict[str, Any]]] = {
    "online": ("online", {}),
    "brisk": ("brisk", {}),
    "direct": ("direct", {}),
    "direct-soonest": ("direct", {"tries": 1}),
    "rrt-connect": ("rrt-connect", {}),
    "rrt-connect-plain": ("rrt-connect", {"patient": False, "shortcuts": False}),
    "epase": ("epase", {}),
    "epase-plain": ("epase", {"patient": False, "longest": 2.0}),
    "insat": ("insat", {}),
    "insat-expansion": ("insat", {"lift": "expansion"}),
    "pinsat": ("pinsat", {}),
}
OF_WIDTH = ("pinsat", "epase")  # planners with the option --width
NEED_PEERS = ("rrt-connect", "epase")
LASTS_UNTIL_CONTACT = ("online", "brisk")
# [%] Quantile of the planning times of `online` and `brisk`. They plan for an arm that starts later
# by the quantile, so that their motions are in time although planning takes time.
RESERVE = 90.0
WARM = 2  # Number of throws, drawn with another seed, that are planned before the measurement.
PAPERS = ("theirs", "RRT-Connect", "ePA*SE")  # planners in the tables of [Natarajan2024]


def leave_out_missing(bench: Bench, names: list[str]) -> list[str]:
    """Return the names of planners whose packages are installed; say so if some are missing."""
    if all(importlib.util.find_spec(name) for name in ("ompl", "toppra")):
        return names
    bench.say(PEERS, "")
    return [name for name in names if PLANNERS[name][0] not in NEED_PEERS]


@struct.dataclass
class Torques:
    """RMS and greatest torques of the arm's six joints during a motion."""

    rms: Array  # (6,) [N m], root mean square over the duration of the motion
    peak: Array  # (6,) [N m], greatest magnitude during the motion


def motion_torques(
    arm: Arm, motion: PiecewisePolynomial, gravity: float | Array = GRAVITY, samples: int = 256
) -> Torques:
    """Return RMS and greatest joint torques of a motion, as in Table II of [Natarajan2024].

    The RMS torque is sqrt(1/T integral of tau^2 dt), with the motion's duration T and the joint's
    torque tau. The integral is approximated by the midpoint rule, because accelerations may jump at
    the ends of the motion. The paper does not state whether its torques include gravity.

    Args:
        arm: one arm.
        motion: joint trajectory, longer than 0 s.
        gravity: () [m/s^2], acts along -z of the base frame; 0 for torques without gravity.
        samples: number of equal time steps; 256 give steps below 4 ms for motions up to a second.
    """
    shares = (np.arange(samples) + 0.5) / samples
    duration = total_duration(motion)

    def at(share: Array) -> Array:
        angles, rates, accelerations = (evaluate(motion, share * duration, k) for k in range(3))
        return inverse_dynamics(arm, angles, rates, accelerations, gravity)

    torques = jax.vmap(at)(jnp.asarray(shares, duration.dtype))
    return Torques(
        rms=jnp.sqrt(jnp.mean(torques**2, axis=0)), peak=jnp.max(jnp.abs(torques), axis=0)
    )


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Results of one planner on B throws: success, times and torques."""

    verdict: BlockVerdict
    found: np.ndarray  # (B,) bool, whether the motion is free of collision, even if too late
    counted: np.ndarray  # (B,) bool, whether the ball is blocked, planning time included
    query: np.ndarray  # (B,) [s], planning time
    execution: np.ndarray  # (B,) [s], time during which the arm moves
    with_gravity: Torques  # leaves (B, 6) [N m]
    without: Torques  # leaves (B, 6) [N m], torques without gravity


def remove_waits(motion: PiecewisePolynomial) -> PiecewisePolynomial:
    """Set the durations of pieces in which no joint moves to zero, for a batch of motions.

    The sum of the durations is then the time during which the arm moves.
    """
    coeffs = np.asarray(motion.coeffs)
    moves = np.any(coeffs[:, :, 1:] != 0.0, axis=(2, 3))
    durations: Any = np.where(moves, motion.durations, 0.0)
    return PiecewisePolynomial(coeffs=motion.coeffs, durations=durations)


def is_found(plans: BlockPlan, verdict: BlockVerdict) -> np.ndarray:
    claims = pj.are_solved(plans)
    late = np.isfinite(plans.violation) & (verdict.failed_limit == "time")
    return (claims & verdict.success) | (late & ~claims)


def run_planner(planner: Any, cases: Any, warm: Any, *, lasts: bool) -> Outcome:
    """Plan throws one by one, judge the plans, and compute their times and torques.

    `warm` are throws that are planned before the measurement. `lasts` is true if the planner's
    motions always end at the contact, so that any planning time would make them late. The planner
    then plans a second time, for an arm that starts later by the 90 % quantile of its planning
    times.
    """
    # Every call advances the random generator of RRT-Connect. The number of calls before the
    # measurement is therefore constant, so that the measured paths are reproducible.
    for k in range(WARM):
        pj.plan(planner, pj.take(warm, k))
    plans, query = measure_plans(planner, cases)
    verdict = pj.block.judge(cases, plans)
    motion = remove_waits(plans.motion)
    execution = np.asarray(motion.durations).sum(axis=1)
    if lasts:
        reserve = np.float32(np.percentile(query, RESERVE))
        later = dataclasses.replace(cases, delay=cases.delay + reserve)
        again, seconds = measure_plans(planner, later)
        counted = pj.block.judge(later, again).success & (seconds <= reserve)
    else:
        counted = verdict.success & (cases.delay + query + execution <= plans.contact_time)
    torques = jax.jit(jax.vmap(motion_torques, (0, 0, None)))
    with_gravity, without = (
        jax.tree.map(np.asarray, torques(cases.arm, motion, gravity)) for gravity in (GRAVITY, 0.0)
    )
    found = is_found(plans, verdict)
    return Outcome(verdict, found, counted, query, execution, with_gravity, without)


def with_spread(values: np.ndarray, digits: int) -> str:
    """Format values as "mean ± standard deviation"; "-" if there are no values."""
    if not len(values):
        return "-"
    return f"{values.mean():.{digits}f} ± {values.std():.{digits}f}"


def table_of_rates(bench: Bench, outcomes: dict[str, Outcome], common: np.ndarray) -> None:
    """Print block rates, planning and execution times, as in Table I of [Natarajan2024].

    The paper's rows come first. `common` (B,) bool marks the throws that all planners block.
    """
    bench.say(
        "| Table I | found | blocked | with query time | query [ms] | p50 | p99 | execution [s] "
        f"| execution on the {common.sum()} common |",
        "|---|---|---|---|---|---|---|---|---|",
    )
    for name in PAPERS:
        found, counted, query, motion = (
            BY_ROW["Natarajan2024", "Table I", f"{quantity} {name}"]
            for quantity in ("found", "in time", "query", "motion")
        )
        blocked = BY_ROW.get(("Natarajan2024", "Table I", f"blocked {name}"), counted)
        bench.say(
            f"| paper: {name} | {found} | {blocked} | {counted} | {query} | - | - | {motion} | - |"
        )
    for name, one in outcomes.items():
        good = one.verdict.success
        p50, p99 = 1e3 * np.percentile(one.query, [50, 99])
        bench.say(
            f"| {name} | {100 * one.found.mean():.1f} % | {100 * good.mean():.1f} % "
            f"| {100 * one.counted.mean():.1f} % | {with_spread(1e3 * one.query, 1)} | {p50:.2f} "
            f"| {p99:.2f} | {with_spread(one.execution[good], 3)} "
            f"| {with_spread(one.execution[common], 3)} |"
        )
        bench.row(
            table="I",
            planner=name,
            found=one.found.mean(),
            blocked=good.mean(),
            counted=one.counted.mean(),
            query={"mean": one.query.mean(), "sd": one.query.std(), "p50": p50, "p99": p99},
            execution=one.execution[good].mean() if good.any() else None,
            execution_common=one.execution[common].mean() if common.any() else None,
        )


def table_of_torques(bench: Bench, outcomes: dict[str, Outcome], common: np.ndarray) -> None:
    """Print mean joint torques of each planner below the rows of Table II of [Natarajan2024].

    Means are over the throws that the planner blocks, and over the throws that all planners block,
    which `common` (B,) bool marks.
    """
    bench.say(
        "",
        "| Table II, RMS [N m] | throws | 1 | 2 | 3 | 4 | 5 | 6 | peak 1 | peak 2 | peak 3 |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    )
    for name in PAPERS:
        row = [BY_ROW["Natarajan2024", "Table II", f"{name} joint {k}"] for k in range(1, 7)]
        bench.say(f"| paper: {name} | own | {' | '.join(map(str, row))} | - | - | - |")
    for name, one in outcomes.items():
        for kind, torques in (("", one.with_gravity), (", no gravity", one.without)):
            for throws, which_ones in (("own", one.verdict.success), ("common", common)):
                if not which_ones.any():
                    continue
                all_rms, all_peaks = (
                    np.asarray(each)[which_ones] for each in (torques.rms, torques.peak)
                )
                rms = [with_spread(all_rms[:, k], 1 if k < 3 else 4) for k in range(6)]
                peaks = [f"{all_peaks[:, k].mean():.0f}" for k in range(3)]
                bench.say(f"| {name}{kind} | {throws} | {' | '.join([*rms, *peaks])} |")
                bench.row(
                    table="II",
                    planner=name,
                    gravity=not kind,
                    throws=throws,
                    rms=all_rms.mean(axis=0),
                    peak=all_peaks.mean(axis=0),
                )


def count_expansions(planner: Any, cases: Any) -> tuple[int, float, float, int]:
    """Plan throws one by one; return expanded states, seconds, median cost and number of plans.

    The median is over the motions [s] in time for the ball.
    """
    opened: list[OpenStates] = []

    class Counted(type(planner)):
        def open_states(self, case: BlockCase, goal: Goal) -> OpenStates:
            opened.append(super().open_states(case, goal))
            return opened[-1]

    counted = Counted(**vars(planner))
    plans, seconds = measure_plans(counted, cases)
    solved = pj.are_solved(plans)
    expanded = sum(states.num_expanded for states in opened)
    median = float(np.median(np.asarray(plans.cost)[solved])) if solved.any() else np.nan
    return expanded, float(seconds.sum()), median, int(solved.sum())


def table_of_expansions(bench: Bench, planners: dict[str, Any], cases: Any, warm: Any) -> None:
    """Print how many states the searches of INSAT expand in a second, planning time included."""
    bench.say("", "| search | width | solved | median motion [s] | expansions/s | s a plan |")
    bench.say("|---|---|---|---|---|---|")
    for name, planner in planners.items():
        pj.plan(planner, pj.take(warm, 0))
        expanded, seconds, median, solved = count_expansions(planner, cases)
        rate, num = expanded / seconds, cases.batch_shape[0]
        bench.say(
            f"| {name} | {planner.width} | {solved} of {num} | {median:.4f} | {rate:.1f} "
            f"| {seconds / num:.3f} |"
        )
        bench.row(table="expansions", planner=name, width=planner.width, rate=rate, cost=median)


def main() -> None:
    parser = argument_parser("block_peers", __doc__, num=100, seed=0)
    parser.add_argument("--suite", choices=list(SUITES), default="pole", help="default: pole")
    parser.add_argument("--regime", choices=REGIMES, default="R2", help="default: R2")
    parser.add_argument(
        "--wide",
        action="store_true",
        help="balls may meet the shield off its middle and at an angle",
    )
    parser.add_argument(
        "--delay", type=float, default=0.0, help="time [s] before the arm may start; default: 0"
    )
    parser.add_argument(
        "--planners", default=",".join(PLANNERS), help="names, comma-separated; default: all"
    )
    parser.add_argument("--width", type=int, help="states expanded at once by pinsat and epase")
    options = parser.parse_args()
    names = parse_names(parser, "--planners", options.planners, PLANNERS)
    if not 0.0 <= options.delay < np.inf:
        parser.error(f"argument --delay: must be finite and >= 0, got {options.delay:g}")
    if hasattr(os, "sched_setaffinity"):  # JAX's threads inherit the affinity if they start later.
        os.sched_setaffinity(0, [max(os.sched_getaffinity(0))])
    with begin(parser, options) as bench:
        settings = {"regime": options.regime, "wide": options.wide, "delay": options.delay}
        cases, warm = (
            jax.tree.map(np.asarray, pj.block.draw(num, options.suite, seed, **settings))
            for num, seed in ((options.num, options.seed), (WARM, options.seed + 1))
        )
        bench.say(
            f"{options.num} throws, {options.suite}, seed {options.seed}, {options.regime}, "
            f"{'wide' if options.wide else 'strict'}, delay {options.delay:g} s, one core, "
            f"jax {jax.__version__}, load average {os.getloadavg()[0]:.1f}",
            "",
        )
        names = leave_out_missing(bench, names)
        outcomes, searches = {}, {}
        for name in names:
            kind, changes = PLANNERS[name]
            if options.width is not None and kind in OF_WIDTH:
                changes = changes | {"width": options.width}
            lasts = kind in LASTS_UNTIL_CONTACT
            planner: Any = pj.block.planner(kind, **changes)
            outcomes[name] = run_planner(planner, cases, warm, lasts=lasts)
            if isinstance(planner, InsatBlock):
                searches[name] = planner
        common = np.all([one.verdict.success for one in outcomes.values()], axis=0)
        table_of_rates(bench, outcomes, common)
        table_of_torques(bench, outcomes, common)
        table_of_expansions(bench, searches, cases, warm)
        bench.count(outcomes[names[0]].verdict.success)


if __name__ == "__main__":
    main()
