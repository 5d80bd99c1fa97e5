"""Measure catches that are re-planned while the ball flies, from noisy observations of the ball.

    python -m benchmarks.catch_replan [--num 1000] [--rate 100] [--noise 0.005] [--out DIR]
    taskset -c 1 python -m benchmarks.catch_replan --alone

A quadrotor catches a thrown ball with a net. A camera observes each ball --rate times per second,
from a tenth of a second before planning starts until the catch. A period is the time between two
observations. Observed positions have noise of the standard deviation --noise [m], and the ball's
drag is known. After each observation a Kalman filter predicts the ball one period ahead, and the
catch is planned again for a start at that time. If the new plan is ready within one period and
keeps all limits, the quadrotor switches to it at the end of the period. A plan that takes longer is
a missed deadline. It is dropped, as is a plan that violates a limit. During the last 0.05 s before
the catch nothing is re-planned.

The flown trajectory, from the first plan to the catch, is judged against the ball's true path by
the protocol of [Yu2023catch]: limits with a tolerance of 5 %, and the ball within the net's radius
of its centre. The first plan without re-planning is judged too. With --alone, the program only
times re-plans, and plans from scratch for the same throws.

The run's summary contains the success rate of the flown trajectories, or with --alone of the timed
re-plans, and the excess cost of the first re-plans over a longer search. All programs run in the
calling thread, as in the planning server, because starting a program of 0.1 ms in one of JAX's
threads adds 0.05 ms. Run the benchmark on an idle machine; the load average is printed.
"""

import dataclasses
import gc
import os
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import planner_jax as pj
from planner_jax.ball.estimation import EkfModel, ekf_init, ekf_predict, ekf_update
from planner_jax.ball.flight import BallState
from planner_jax.benchmarks.cost_gap import COMPARED, cost_gaps
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.core.protocol import is_solved
from planner_jax.live.server import compute_in_place
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial

SEEN = 0.1  # [s] Observations start this long before planning starts.
WARM_UP = 5  # Number of throws that are simulated before the measurement.
SCRATCH = pj.catch.CatchProblem.planner()
AGAIN: Any = SCRATCH.replanner()


class Estimator:
    """Kalman filter of a ball's position and velocity, with mean and covariance in one vector."""

    def __init__(self, period: float, noise: float, drag: Any, gravity: Any) -> None:
        model = EkfModel(
            drag=jnp.asarray(drag),
            gravity=jnp.asarray(gravity),
            acceleration_density=jnp.asarray(1e-4),
            observation_std=jnp.asarray(noise),
        )
        unknown = ekf_init(
            jnp.zeros(3), jnp.zeros(3), pos_std=jnp.asarray(noise), vel_std=jnp.asarray(10.0)
        )
        first, unravel = ravel_pytree(unknown)

        def advance(vector: jax.Array) -> jax.Array:
            state = ekf_update(unravel(vector[:-3]), vector[-3:], model)
            ahead = ekf_predict(state, jnp.asarray(period), model)
            return ravel_pytree(ahead)[0]

        self._advance = jax.jit(advance)
        self._first = self._belief = np.asarray(first)

    def begin(self, observation: np.ndarray) -> None:
        """Start a new ball: the first observed position (3,) [m] becomes the mean position."""
        self._belief = self._first.copy()
        self._belief[:3] = observation

    def see(self, observation: np.ndarray) -> BallState:
        """Update the filter with an observed position (3,) [m]; predict the ball a period later."""
        belief: Any = np.asarray(self._advance(np.concatenate([self._belief, observation])))
        self._belief = belief
        return BallState(pos=belief[None, :3], vel=belief[None, 3:6])


@dataclasses.dataclass
class Times:
    """Durations [s] of estimates, first plans and re-plans in all throws, and counts of failures.

    A re-plan fails if it takes longer than the time between two observations, or violates a limit.
    """

    estimate: list[float] = dataclasses.field(default_factory=list)
    first: list[float] = dataclasses.field(default_factory=list)
    again: list[float] = dataclasses.field(default_factory=list)
    missed: int = 0  # number of re-plans that took longer than a period
    broken: int = 0  # number of re-plans that violate a limit
    # The first 1,024 re-planning problems with their plans, whose costs are compared with the costs
    # of a longer search.
    replans: list[tuple[Any, CatchPlan]] = dataclasses.field(default_factory=list)

    def keep(self, left: Any, found: CatchPlan) -> None:
        if len(self.replans) < COMPARED:
            self.replans.append((left, found))

    def gaps(self) -> np.ndarray | None:
        """Return by what fraction the costs of stored re-plans exceed the costs of a long search.

        The long search starts from the same initial guess as the re-plan. The result is None if no
        re-plan is stored.
        """
        if not self.replans:
            return None
        return cost_gaps(AGAIN, *stack(self.replans))


def stack(trees: list) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def balls_of(case: CatchCase) -> pj.BallPath:
    assert isinstance(case.targets, pj.BallPath)
    return case.targets


def first_plan(case: CatchCase) -> tuple[CatchCase, CatchPlan]:
    """Estimate the earliest time at which the ball can be caught, and plan a catch from scratch.

    The planner's search starts from this time. Returns the case with the time, and the plan.
    """
    case = case.with_choice(jax.tree.map(lambda leaf: np.asarray(leaf)[0], _propose(case)))
    return case, pj.plan(SCRATCH, case)


_propose = jax.jit(pj.catch.Greedy().propose)


def warm_up(case: CatchCase) -> None:
    """Compile all searches of the planner and the re-planner.

    The planner starts a later search only for cases that are not solved. The quadrotor's speed
    limit is therefore set near zero, so that no search solves the case and all are compiled.
    """
    stuck = dataclasses.replace(
        case, limits=dataclasses.replace(case.limits, speed=np.float32(1e-3))
    )
    _, flown = first_plan(stuck)
    pj.replan(AGAIN, stuck, flown, 0.01, targets=stuck.targets)


def fly(
    case: CatchCase, observations: np.ndarray, estimator: Estimator, period: float, out: Times
) -> tuple[CatchPlan, CatchPlan]:
    """Simulate one throw from its first observation to the catch, with re-planning.

    Args:
        case: the true case; time 0 is one period after the observation at which planning starts.
        observations: (K, 3) [m], observed positions of the ball, one for each period.
        estimator: Kalman filter of the ball.
        period: [s], time between two observations.
        out: stores the durations of all calls.

    Returns:
        The flown trajectory as a plan, and the first plan.
    """
    before = round(SEEN / period)
    estimator.begin(observations[0])
    for observation in observations[:before]:
        estimator.see(observation)
    ball = estimator.see(observations[before])
    began = time.perf_counter()
    targets = dataclasses.replace(balls_of(case), ball=ball)
    task, current = first_plan(dataclasses.replace(case, targets=targets))
    out.first.append(time.perf_counter() - began)
    first, flown, elapsed = current, [], 0.0
    for observation in observations[before + 1 :]:
        elapsed += period
        if current.times[0] - elapsed < AGAIN.problem.shortest:
            break
        began = time.perf_counter()
        ball = estimator.see(observation)
        seen = time.perf_counter()
        targets = dataclasses.replace(balls_of(task), ball=ball)
        left = AGAIN.begin(task, current, elapsed, targets=targets)
        found = pj.plan(AGAIN, left)
        ended = time.perf_counter()
        out.estimate.append(seen - began)
        out.again.append(ended - seen)
        out.keep(left, found)
        late, broken = ended - began > period, not is_solved(found.status)
        out.missed += late
        out.broken += broken
        if not (late or broken):
            flown.append(cut_trajectory(current.trajectory, elapsed))
            task, current, elapsed = left.case, found, 0.0
    path = join_trajectories([*flown, current.trajectory])
    times = path.durations.sum(keepdims=True)
    return dataclasses.replace(current, trajectory=path, times=times), first


def cut_trajectory(path: PiecewisePolynomial, elapsed: float) -> PiecewisePolynomial:
    """Return the part of a trajectory from its start to the time `elapsed` [s]."""
    ends = path.durations.cumsum()
    durations = path.durations - np.maximum(ends - elapsed, 0.0)
    flown = durations > 0.0
    return PiecewisePolynomial(path.coeffs[flown], durations[flown])


def join_trajectories(paths: list[PiecewisePolynomial]) -> PiecewisePolynomial:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *paths)


def judge(cases: CatchCase, plans: list[CatchPlan]) -> dict[str, np.ndarray]:
    """Judge plans by the protocol of [Yu2023catch]; return for each field of the verdict an array.

    The protocol tolerates limits exceeded by 5 %. Plans with equal numbers of pieces are judged
    together; the arrays are in the order of the plans.
    """
    lengths = np.array([flown.trajectory.durations.size for flown in plans])
    found: dict[str, np.ndarray] = {}
    for length in np.unique(lengths):
        lanes = np.flatnonzero(lengths == length)
        verdict = pj.catch.judge(
            pj.take(cases, lanes),
            stack([plans[k] for k in lanes]),
            tolerance=0.05,
            net_test="ball",
        )
        for name in ("success", "failed_limit", "net_distance", "num_caught", "angle"):
            value = getattr(verdict, name)
            wide = np.empty((len(plans), *value.shape[1:]), value.dtype)
            found.setdefault(name, wide.astype(object) if value.dtype.kind == "U" else wide)
            found[name][lanes] = value
    return found


def report_times(bench: Bench, name: str, seconds: list[float]) -> None:
    """Print percentiles of durations [s], and store them in the run folder under `name`."""
    p50, p90, p99 = 1e3 * np.percentile(seconds, [50, 90, 99])
    bench.row(name=name, num=len(seconds), p50_ms=p50, p90_ms=p90, p99_ms=p99)
    bench.say(
        f"{name}: p50 {p50:.3f} ms, p90 {p90:.3f} ms, p99 {p99:.3f} ms, "
        f"max {1e3 * max(seconds):.3f} ms ({len(seconds)})"
    )


def report_catches(bench: Bench, name: str, verdict: dict[str, np.ndarray]) -> None:
    p50, p90, p99 = 100.0 * np.percentile(verdict["net_distance"], [50, 90, 99])
    limits = np.unique([limit for limit in verdict["failed_limit"] if limit], return_counts=True)
    failures = ", ".join(f"{limit} {count}" for limit, count in zip(*limits, strict=True))
    bench.say(
        f"{name}: refereed success {100.0 * verdict['success'].mean():.2f} %, ball from the "
        f"net's centre p50 {p50:.1f} cm, p90 {p90:.1f} cm, p99 {p99:.1f} cm"
        + (f"; failed: {failures}" if failures else "")
    )


def throws(num: int, period: float, noise: float) -> tuple[CatchCase, np.ndarray]:
    """Draw `num` throws; return them as cases, and noisy observations (num, K, 3) [m] of the balls.

    There are K observations, one each `period` [s], with the standard deviation `noise` [m]. Time 0
    of the cases is one period after planning starts.
    """
    suite = pj.catch.draw(num)
    times = jnp.arange(-round(SEEN / period), int(suite.horizon.max() / period)) * period
    paths = jax.tree.map(lambda leaf: leaf[:, 0], suite.targets)
    states = jax.vmap(lambda path: jax.vmap(path.at)(times))(paths)
    random = np.random.default_rng(0)
    observations = np.asarray(states.pos) + noise * random.standard_normal(states.pos.shape)
    ahead = jax.vmap(lambda path: path.at(jnp.asarray(period)))(paths)
    begins = dataclasses.replace(
        suite,
        targets=dataclasses.replace(
            balls_of(suite), ball=jax.tree.map(lambda leaf: leaf[:, None], ahead)
        ),
        horizon=suite.horizon - period,
    )
    return jax.tree.map(np.asarray, begins), observations.astype(np.float32)


def time_replans(bench: Bench, lanes: list[CatchCase], period: float, noise: float) -> None:
    """Time one re-plan and one plan from scratch for each case, and print percentiles.

    A re-plan starts at a random time of the first plan. The ball's position [m] and velocity [m/s]
    then deviate from the expected values by random errors with the standard deviation `noise`.
    """
    random = np.random.default_rng(0)
    tasks = []
    for case in lanes:
        task, current = first_plan(case)
        elapsed = np.float32(period * random.integers(1, round(0.6 / period)))
        path = balls_of(case)
        ball = jax.tree.map(
            np.asarray,
            pj.BallPath(
                BallState(path.ball.pos[0], path.ball.vel[0]), path.drag[0], path.gravity[0]
            ).at(jnp.asarray(elapsed)),
        )
        moved = BallState(
            (ball.pos + noise * random.standard_normal(3)).astype(np.float32)[None],
            (ball.vel + noise * random.standard_normal(3)).astype(np.float32)[None],
        )
        tasks.append((task, current, elapsed, dataclasses.replace(path, ball=moved)))
    seconds, scratch, replans = [], [], []
    for task, current, elapsed, targets in tasks:
        began = time.perf_counter()
        left = AGAIN.begin(task, current, elapsed, targets=targets)
        found = pj.plan(AGAIN, left)
        ended = time.perf_counter()
        pj.plan(SCRATCH, task)
        scratch.append(time.perf_counter() - ended)
        seconds.append(ended - began)
        replans.append((left, found))
    report_times(bench, "from scratch, with order and time fixed", scratch)
    report_times(bench, "re-plan alone", seconds)
    cases, plans = stack(replans)
    bench.say(f"solved {100.0 * pj.are_solved(plans).mean():.2f} %")
    success = judge(cases.case, [found for _, found in replans])["success"]
    bench.count(success, cost_gaps(AGAIN, cases, plans))


def main() -> None:
    parser = argument_parser("catch_replan", __doc__, num=1000)
    parser.add_argument(
        "--rate", type=float, default=100.0, help="observations and plans per second [Hz]"
    )
    parser.add_argument(
        "--noise",
        type=float,
        default=0.005,
        help="standard deviation of each observed coordinate [m]",
    )
    parser.add_argument("--alone", action="store_true", help="only time re-plans, without flights")
    options = parser.parse_args()
    period = 1.0 / options.rate
    compute_in_place()
    with begin(parser, options) as bench:
        cases, observations = throws(options.num, period, options.noise)
        lanes = [pj.take(cases, k) for k in range(options.num)]
        began = time.perf_counter()
        warm_up(lanes[0])
        bench.say(
            f"{options.num} throws, {jax.devices()[0].platform}, jax {jax.__version__}, load "
            f"average {os.getloadavg()[0]:.1f}; compilation of all attempts "
            f"{time.perf_counter() - began:.1f} s"
        )
        if options.alone:
            time_replans(bench, lanes, period, options.noise)
        else:
            fly_all(bench, cases, observations, period, options.noise)


def fly_all(
    bench: Bench, cases: CatchCase, observations: np.ndarray, period: float, noise: float
) -> None:
    lanes = [pj.take(cases, k) for k in range(len(observations))]
    path = balls_of(lanes[0])
    estimator = Estimator(period, noise, path.drag[0], path.gravity[0])
    for lane, seen in zip(lanes[:WARM_UP], observations, strict=False):
        fly(lane, seen, estimator, period, Times())
    times = Times()
    gc.collect()
    gc.disable()  # A garbage collection takes milliseconds, so a real control loop avoids it.
    flights = [
        fly(lane, seen, estimator, period, times)
        for lane, seen in zip(lanes, observations, strict=True)
    ]
    flown, first = (list(plans) for plans in zip(*flights, strict=True))
    report_times(bench, "estimate", times.estimate)
    report_times(bench, "first plan, from scratch", times.first)
    report_times(bench, "re-plan", times.again)
    report_times(bench, "estimate and re-plan", np.add(times.estimate, times.again).tolist())
    bench.say(
        f"deadlines of {1e3 * period:.1f} ms missed: {times.missed} of {len(times.again)}; "
        f"re-plans that violate a limit: {times.broken}; load average {os.getloadavg()[0]:.1f}"
    )
    verdict = judge(cases, flown)
    report_catches(bench, "re-planned", verdict)
    report_catches(bench, "first plan alone", judge(cases, first))
    bench.count(verdict["success"], times.gaps())
    bench.note(missed=times.missed, replans=len(times.again), broken=times.broken)


if __name__ == "__main__":
    main()
