"""Compare the speed of the planners with IPOPT on the same problems, at equal cost of the plans.

    python -m benchmarks.ipopt [--num 200] [--tune 20] [--seed 0] [--repeat 3] [--batch N]
        [--tasks hit,catch] [--out DIR]

The planner is `exact`, on hits of the suite `court` and on catches of one ball. Its effort
("feasible", "good" or "best") sets how long it searches for a lower cost after every limit holds.
It plans one case at a time on one core, and batches on JAX's first device. IPOPT runs through
CasADi (the extra `oracle`) on one core, with exact derivatives and the linear solver MUMPS. Its
problem has the same decision variables, initial guess, objective and samples, but is implemented
independently in `ipopt_peer`. It has two forms. In the form "limits", limits are constraints. In
the form "penalties", limits are penalties in the objective, as in the planner. IPOPT's settings are
tuned on other cases: for each form, the fastest setting without a loss of quality is used.

The cost of a plan is the weighted sum of its squared snap and its time, in float64. It is compared
with the least cost of any plan of the case in this run that the referee, an independent check,
accepts. Times on one core are CPU times without compilation, because other load of the machine has
little effect on CPU times. For each case the fastest of --repeat tries counts.

To compare at equal cost, the program finds the first iterate of IPOPT that keeps the limits and
costs at most 0.01 % more than the planner's plan. In the form "penalties" the cost is the planner's
objective. IPOPT's time is the duration of a search to a tolerance of 1e-6, times the share of its
iterates up to that iterate, or the whole duration if there is no such iterate. This favours IPOPT,
which would not know when to stop.
"""

import dataclasses
import importlib
import importlib.util
import os
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.baselines.protocols import BY_ROW
from planner_jax.benchmarks.cost_gap import gap_figures
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin, parse_names
from planner_jax.core.choices import EFFORTS
from planner_jax.core.missing_extra import install_line
from planner_jax.core.protocol import FEASIBILITY_TOLERANCE
from planner_jax.cost.along import BETWEEN_NODES
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.hit.default_planner import HitProblem
from planner_jax.trajectory.polynomial import snap_energy

# Task -> suite from which cases are drawn, and module of `ipopt_peer` with the problem for IPOPT.
TASKS = {"hit": ("court", "hits"), "catch": ("throws", "catches")}
BATCH, GPU_BATCH = 1024, 65536  # Batch sizes on a CPU and on other devices.
# Greatest published speed-up of the batched interior-point solver jaxipm over IPOPT, measured with
# quadrotors on one GPU of type L40S.
JAXIPM = BY_ROW["Viljoen2026", "abstract", "speed-up"].value
TIGHTEST = 1e-6  # Tolerance of the searches by IPOPT whose iterates are compared with plans.
NO_MORE = 1e-4  # Two costs count as equal up to this relative difference.


@dataclasses.dataclass
class Found:
    """Results of one solver on B cases: costs, success and times."""

    name: str
    cost: np.ndarray  # (B,), cost of snap and time, without penalties
    # (B,), value of the planner's objective with penalties. None for IPOPT in the form "limits",
    # whose objective has no penalties.
    objective: np.ndarray | None
    accepted: np.ndarray  # (B,) bool, whether the referee accepts the plan
    seconds: np.ndarray  # (B,) [s], CPU times of single cases on one core
    in_batch: float | None = None  # plans per second in a batch; None if not measured


class Setup:
    """Drawn cases of a task, and the parameters of the same problems for IPOPT, in float64.

    Args:
        name: name of the task.
        num: number of cases.
        seed: seed with which the cases are drawn.
    """

    def __init__(self, name: str, num: int, seed: int):
        suite, module = TASKS[name]
        self.card = pj.task_named(name)
        self.cases: Any = jax.tree.map(np.asarray, self.card.draw(num, suite, seed))
        made = self.card.planner("exact", **self.card.bench)
        planner = made.planner if isinstance(made, DecidedPlanner) else made
        assert isinstance(planner, pj.SearchPlanner)
        self.problem = planner.problem
        assert isinstance(self.problem, HitProblem | CatchProblem)
        self.module = importlib.import_module(f"planner_jax.benchmarks.ipopt_peer.{module}")
        decided = self.cases
        if isinstance(made, DecidedPlanner):
            decided = self.cases.with_choice(pj.plan(made, self.cases).choice)
        peer = importlib.import_module("planner_jax.benchmarks.ipopt_peer.peer")
        with jax.enable_x64(True):
            exact = lambda x: jnp.asarray(x, float) if x.dtype.kind == "f" else jnp.asarray(x)  # noqa: E731
            decided = jax.tree.map(lambda x: exact(np.asarray(x)), decided)
            self.contexts = jax.jit(jax.vmap(self.problem.prepare))(decided)
            self.batches = {}
            params = peer.stack_params(self.module, self.problem, self.contexts)
            for label, learned in (("learned", True), ("smooth", False)):
                own = self.problem.with_settings((("learned", learned),))
                first = lambda context, own=own: own.guesses(context, 1)[0]  # noqa: E731
                starts = np.asarray(jax.jit(jax.vmap(first))(self.contexts))
                self.batches[label] = peer.Batch(params, starts)
            self._decode = jax.jit(jax.vmap(self.problem.decode))
            self._objective = jax.jit(jax.vmap(self.problem.objective))

    def plans(self, points: np.ndarray) -> Any:
        """Convert n decision variables of each of B cases, (B, n), to plans in float64."""
        with jax.enable_x64(True):
            return jax.tree.map(np.asarray, self._decode(jnp.asarray(points), self.contexts))

    def objective(self, points: np.ndarray) -> np.ndarray:
        """Return the planner's objective with penalties (B,) at n decision variables of B cases."""
        with jax.enable_x64(True):
            return np.asarray(self._objective(jnp.asarray(points), self.contexts).cost)

    def judge(self, plans: Any) -> np.ndarray:
        """Return for each plan whether the referee, an independent check, accepts it, (B,) bool."""
        return np.asarray(self.card.judge(self.cases, plans).success)

    def cost(self, plans: Any) -> np.ndarray:
        """Return the costs (B,) of the plans' snap and time, in float64 and without penalties."""
        with jax.enable_x64(True):
            path = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), plans.trajectory)
            cost = self.problem.energy_weight * np.asarray(jax.vmap(snap_energy)(path))
        if isinstance(self.problem, CatchProblem):
            cost = cost + self.problem.time_weight * np.asarray(plans.times, float)[:, -1]
        return cost


def run_planner(
    setup: Setup, effort: str, repeat: int, batch: int, seed: int
) -> tuple[Found, float]:
    """Plan one case at a time on a CPU core, and then a batch on JAX's first device.

    Returns the results, and the duration [s] of the first call, which compiles. `effort` sets how
    long the planner searches for a lower cost; `batch` and `seed` define the drawn batch.
    """
    planner = setup.card.planner("exact", effort=effort, **setup.card.bench)
    num, host = len(setup.batches["learned"].starts), jax.devices("cpu")[:1]
    lanes = [pj.take(setup.cases, k) for k in range(num)]
    began = time.perf_counter()
    pj.plan(planner, lanes[0], devices=host)
    first = time.perf_counter() - began
    # This loop compiles all searches that the cases need.
    plans = [pj.plan(planner, case, devices=host) for case in lanes]
    seconds = np.full(num, np.inf)
    for _ in range(repeat):
        for k, case in enumerate(lanes):
            began = time.process_time()
            plans[k] = pj.plan(planner, case, devices=host)
            seconds[k] = min(seconds[k], time.process_time() - began)
    together = jax.tree.map(lambda *leaves: np.stack(leaves), *plans)
    many = setup.card.draw(batch, TASKS[setup.card.name][0], seed)
    many = jax.device_put(many, jax.devices()[0])
    elapsed = []
    for _ in range(repeat + 1):
        began = time.perf_counter()
        jax.block_until_ready(pj.plan(planner, many))
        elapsed.append(time.perf_counter() - began)
    return (
        Found(
            name=f"`exact`, {effort}",
            cost=setup.cost(together),
            objective=np.asarray(together.cost, float),
            accepted=setup.judge(together),
            seconds=seconds,
            in_batch=batch / min(elapsed[1:]),
        ),
        first,
    )


def seconds_to(
    setup: Setup, peer: Any, paths: list[np.ndarray], whole: np.ndarray, run: Found
) -> tuple[np.ndarray, np.ndarray]:
    """Return when IPOPT reaches plans that keep the limits and cost no more than the planner's.

    Args:
        setup: B cases.
        peer: IPOPT, which computed the iterates.
        paths: for each case the S iterates (S, n) of IPOPT.
        whole: (B,) [s], duration of each search by IPOPT.
        run: results of the planner.

    Returns:
        The times (B,) [s], and whether IPOPT reaches such a plan, (B,) bool.
    """
    worst, params = peer.programs[False].worst, setup.batches["learned"].params
    by_objective = peer.form == "penalties"
    target = np.asarray(run.objective if by_objective else run.cost)
    costs = np.full((max(map(len, paths)), len(paths)), np.inf)
    for step in range(len(costs)):
        points = np.stack([path[min(step, len(path) - 1)] for path in paths])
        costs[step] = setup.objective(points) if by_objective else setup.cost(setup.plans(points))
    for k, path in enumerate(paths):
        excess = np.array([float(worst(point, params[k])) for point in path]) + BETWEEN_NODES
        costs[: len(path), k][~(excess <= FEASIBILITY_TOLERANCE)] = np.inf
        costs[len(path) :, k] = np.inf
    good = costs <= target * (1.0 + NO_MORE)
    reached, steps = np.asarray(good.any(axis=0)), np.array([len(path) for path in paths])
    share = np.where(reached, (np.argmax(good, axis=0) + 1) / steps, 1.0)
    return whole * share, reached


def measure(bench: Bench, name: str, options: Any) -> None:
    peer_module: Any = importlib.import_module("planner_jax.benchmarks.ipopt_peer.peer")
    setup = Setup(name, options.num, options.seed)
    tuning = Setup(name, options.tune, options.seed + 1)
    unit = float(np.median(tuning.cost(tuning.plans(tuning.batches["learned"].starts))))
    device = jax.devices()[0]
    batch = options.batch or (BATCH if device.platform == "cpu" else GPU_BATCH)
    suite = TASKS[name][0]
    bench.say(
        "",
        f"{options.num} cases of {name}, suite {suite}, seed {options.seed}; batches of "
        f"{batch:,} on {device.device_kind}; jax {jax.__version__}, CasADi "
        f"{peer_module.ca.__version__}, load average {os.getloadavg()[0]:.1f}",
    )
    bench.say(
        "",
        f"Settings of IPOPT on {options.tune} other cases; tolerances are for the objective "
        f"divided by {unit:.2g}, a typical cost:",
        "",
        "| form | tolerance | options | functions | refereed | objective above the least (p90) | "
        "steps | ms |",
        "|---|---|---|---|---|---|---|---|",
    )
    runs, peers, kept = [], {}, {}
    for form in peer_module.TRIED:
        peer = peers[form] = peer_module.Peer(setup.module, setup.problem, form, unit)
        accepted = lambda points: tuning.judge(tuning.plans(points))  # noqa: E731
        kept[form], rows = peer_module.best_setting(peer, tuning.batches["learned"], accepted)
        for row in rows:
            bench.row(task=name, what="setting", **row)
            listed = ", ".join(f"{k} {v}" for k, v in row["options"].items()) or "-"
            how = "compiled C" if row["compiled"] else "CasADi's virtual machine"
            mark = "**" if row["chosen"] else ""
            bench.say(
                f"| {mark}{form}{mark} | {row['tolerance']:g} | {listed} | {how} | "
                f"{100.0 * row['success_rate']:.0f} % | {100.0 * row['above_p90']:.2f} % | "
                f"{row['steps']:.1f} | {row['milliseconds']:.1f} |"
            )
    efforts = {}
    firsts = []
    for effort in EFFORTS:
        efforts[effort], first = run_planner(setup, effort, options.repeat, batch, options.seed)
        firsts.append(first)
        runs.append(efforts[effort])
    for start, form in ((s, f) for s in setup.batches for f in peers):
        found = peers[form].solve(kept[form], setup.batches[start], options.repeat)
        plans = setup.plans(found.points)
        runs.append(
            Found(
                name=f"IPOPT, {form}, {start} initial guess",
                cost=setup.cost(plans),
                objective=setup.objective(found.points) if form == "penalties" else None,
                accepted=setup.judge(plans),
                seconds=found.seconds,
            )
        )
    gaps = _report_solvers(bench, name, runs)
    bench.say(
        "",
        f"First calls: {', '.join(f'{each:.1f}' for each in firsts)} s by effort, with compilation "
        "of programs that JAX's cache lacks; "
        + "; ".join(
            f"IPOPT, {form}: {peer.build_seconds:.1f} s to build, {peer.compile_seconds:.1f} s "
            "to build and compile C"
            for form, peer in peers.items()
        ),
    )
    _report_equal_costs(bench, setup, efforts, peers, kept, options.repeat)
    bench.count(np.concatenate([each.accepted for each in efforts.values()]), *gaps)


def _report_solvers(bench: Bench, name: str, runs: list[Found]) -> list[np.ndarray]:
    """Print a row for each solver: success, costs above the least cost of any solver, and speed.

    Returns by what fraction the planner's costs exceed the least costs: an array for each effort
    ("feasible", "good", "best"), which sets how long the planner searches.
    """
    bench.say(
        "",
        "| solver | refereed | cost above the least (median, p90, p99) | planner's objective above "
        "the least (median, p90, p99) | plans/s, one at a time on one core | plans/s in a batch |",
        "|---|---|---|---|---|---|",
    )
    cost = np.min([np.where(run.accepted, run.cost, np.inf) for run in runs], axis=0)
    minimised = [np.where(r.accepted, r.objective, np.inf) for r in runs if r.objective is not None]
    objective, gaps = np.min(minimised, axis=0), []
    for run in runs:
        gap = (run.cost / cost - 1.0)[run.accepted]
        own = None if run.objective is None else (run.objective / objective - 1.0)[run.accepted]
        rate, success = 1.0 / run.seconds.mean(), run.accepted.mean()
        bench.row(
            task=name,
            what="solver",
            solver=run.name,
            success_rate=success,
            plans_per_second=rate,
            plans_per_second_in_batch=run.in_batch,
            **gap_figures(gap),
            objective=gap_figures(own),
        )
        bench.say(
            f"| {run.name} | {100.0 * success:.1f} % | {_format_quantiles(gap)} | "
            f"{_format_quantiles(own)} | {rate:,.0f} | "
            f"{'-' if run.in_batch is None else f'{run.in_batch:,.0f}'} |"
        )
        if run.in_batch is not None:
            gaps.append(gap)
    return gaps


def _format_quantiles(gap: np.ndarray | None) -> str:
    """Format the median, 90 % and 99 % quantile of relative excess costs in per cent."""
    if gap is None or not gap.size:
        return "-"
    return ", ".join(f"{100.0 * (each or 0.0):.2f} %" for each in gap_figures(gap).values())


def _report_equal_costs(
    bench: Bench, setup: Setup, efforts: dict, peers: dict, kept: dict, repeat: int
) -> None:
    """Print how fast IPOPT reaches the cost of the planner, relative to the planner's own speed.

    There is a row for each combination of an effort, a form and an initial guess.

    Args:
        bench: prints and stores the rows.
        setup: cases, and IPOPT's two initial guesses of each, "learned" (by a network) and
            "smooth".
        efforts: effort of the planner, how long it searches for a lower cost -> results (`Found`).
        peers: form of IPOPT's problem, "limits" (as constraints) or "penalties" -> `Peer`.
        kept: form -> setting of IPOPT that was tuned for it.
        repeat: number of times that each case is solved; the fastest time counts.
    """
    bench.say(
        "",
        f"At the same cost; the planner's own initial guess is the learned one. jaxipm has up to "
        f"{JAXIPM:g} times IPOPT's plans/s (published: other problems, one L40S):",
        "",
        "| effort | IPOPT's form | IPOPT's initial guess | reaches the planner's cost | plans/s "
        "to this cost on one core | planner over IPOPT, one at a time on one core | "
        "planner in a batch "
        "over IPOPT |",
        "|---|---|---|---|---|---|---|",
    )
    for start, form in ((s, f) for s in setup.batches for f in peers):
        peer, (_, *how) = peers[form], kept[form]
        exact = (TIGHTEST, *how)
        paths = peer.iterates(exact, setup.batches[start])
        whole = peer.solve(exact, setup.batches[start], repeat).seconds
        for effort, run in efforts.items():
            taken, reached = seconds_to(setup, peer, paths, whole, run)
            rate = reached.sum() / taken.sum()
            alone = 1.0 / run.seconds.mean() / rate if rate else np.inf
            many = run.in_batch / rate if rate else np.inf
            bench.row(
                task=setup.card.name,
                what="equal gap",
                effort=effort,
                form=form,
                start=start,
                reached=reached.mean(),
                plans_per_second=rate,
                one_core_over_ipopt=alone,
                batch_over_ipopt=many,
            )
            bench.note(**{f"{setup.card.name}_{effort}_over_ipopt_{form}_{start}": alone})
            bench.say(
                f"| {effort} | {form} | {start} | {100.0 * reached.mean():.0f} % | {rate:,.0f} | "
                f"{alone:,.1f} | {many:,.0f} |"
            )


def main() -> None:
    parser = argument_parser("ipopt", __doc__, num=200, tune=20, seed=0, repeat=3)
    parser.add_argument(
        "--tasks", default=",".join(TASKS), help="comma-separated; default: %(default)s"
    )
    parser.add_argument(
        "--batch",
        type=at_least(1),
        help=f"plans in a batch; default: {BATCH} on a CPU, {GPU_BATCH} elsewhere",
    )
    options = parser.parse_args()
    names = parse_names(parser, "--tasks", options.tasks, TASKS)
    if importlib.util.find_spec("casadi") is None:
        parser.exit(2, f"benchmarks.ipopt needs casadi: {install_line('oracle')}\n")
    if hasattr(os, "sched_setaffinity"):  # JAX's threads inherit the affinity if they start later.
        os.sched_setaffinity(0, [max(os.sched_getaffinity(0))])
    with begin(parser, options) as bench:
        for name in names:
            measure(bench, name, options)


if __name__ == "__main__":
    main()
