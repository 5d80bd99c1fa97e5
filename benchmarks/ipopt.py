"""Compare planners with IPOPT on the same problems: plans per second on one core, at equal cost.

    python -m benchmarks.ipopt [--num 200] [--tune 20] [--seed 0] [--repeat 3] [--batch N]
        [--tasks hit,catch] [--out DIR]

The planner is `exact` with each effort, on hits of the suite `court` and catches of one ball
(`throws`). It plans one case at a time on one core, and batches on JAX's first device. IPOPT runs
through CasADi (the extra `oracle`) on one core. Its problem has the same decision variables,
initial guess, objective and samples, implemented independently from the definitions (`ipopt_peer`),
with exact derivatives and MUMPS. There are two forms: limits as constraints, satisfied as the
planners' statuses require, or the planner's own penalties in the objective. IPOPT's settings are
tuned on other cases. For each form the fastest setting without a loss of quality is used, and
printed.

The cost of a plan consists of snap and time alone, in float64 for all. Its gap is relative to the
least cost of any accepted plan of the case in this run. Times on one core are CPU times, on which
other load of the machine has little effect, without compiling and building; for each case the
fastest of --repeat tries counts. IPOPT reaches a planner's plan at its first iterate that satisfies
the limits and costs no more, within 0.01 %. The compared cost is the planner's objective if IPOPT
minimises it. The time until then is the share of iterates, times the duration of a search to a
tolerance of 1e-6, or the whole duration if no iterate qualifies. IPOPT need not detect this itself.
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
from planner_jax.benchmarks.cost_gap import gap_figures
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin, parse_names
from planner_jax.core.choices import EFFORTS
from planner_jax.core.errors import install_line
from planner_jax.core.protocol import FEASIBILITY_TOLERANCE
from planner_jax.cost.along import BETWEEN_NODES
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.hit.default_planner import ExactHit
from planner_jax.trajectory.polynomial import snap_energy

# Task -> suite, and the module that defines its problem.
TASKS = {"hit": ("court", "hits"), "catch": ("throws", "catches")}
BATCH, GPU_BATCH = 1024, 65536
# Greatest speed-up of the batched interior-point solver jaxipm over IPOPT: [Viljoen2026],
# quadrotors on one L40S.
JAXIPM = 32.85
TIGHTEST = 1e-6  # tolerance of the searches whose iterates are evaluated
NO_MORE = 1e-4  # relative excess of a cost over another that counts as equal


@dataclasses.dataclass
class Found:
    """Results of one solver on all cases."""

    name: str
    cost: np.ndarray  # (B,), of snap and time
    objective: np.ndarray | None  # (B,), the planner's, with penalties; None if not minimised
    accepted: np.ndarray  # (B,) bool, by the referee
    seconds: np.ndarray  # (B,), CPU time, one after another on one core
    in_batch: float | None = None  # plans per second


class Setup:
    """Cases of a task with the parameters of IPOPT's problems, in float64.

    Args:
        name: of the task.
        num: number of cases.
        seed: with which the cases are drawn.
    """

    def __init__(self, name: str, num: int, seed: int):
        suite, module = TASKS[name]
        self.card = pj.task_named(name)
        self.cases: Any = jax.tree.map(np.asarray, self.card.draw(num, suite, seed))
        made = self.card.planner("exact", **self.card.bench)
        planner = made.planner if isinstance(made, DecidedPlanner) else made
        assert isinstance(planner, ExactHit | ExactCatch)
        self.planner = planner
        self.module = importlib.import_module(f"planner_jax.benchmarks.ipopt_peer.{module}")
        decided = self.cases
        if isinstance(made, DecidedPlanner):
            decided = self.cases.with_choice(pj.plan(made, self.cases).choice)
        peer = importlib.import_module("planner_jax.benchmarks.ipopt_peer.peer")
        with jax.enable_x64(True):
            exact = lambda x: jnp.asarray(x, float) if x.dtype.kind == "f" else jnp.asarray(x)  # noqa: E731
            decided = jax.tree.map(lambda x: exact(np.asarray(x)), decided)
            self.contexts = jax.jit(jax.vmap(self.planner.prepare))(decided)
            self.batches = {}
            params = peer.stack_params(self.module, self.planner, self.contexts)
            for label, learned in (("learned", True), ("smooth", False)):
                planner = self.planner.with_settings((("learned", learned),))
                first = lambda context, planner=planner: planner.guesses(context, 1)[0]  # noqa: E731
                starts = np.asarray(jax.jit(jax.vmap(first))(self.contexts))
                self.batches[label] = peer.Batch(params, starts)
            self._decode = jax.jit(jax.vmap(self.planner.decode))
            self._objective = jax.jit(jax.vmap(self.planner.objective))

    def plans(self, points: np.ndarray) -> Any:
        """Return the plans of points (B, n), float64 NumPy leaves."""
        with jax.enable_x64(True):
            return jax.tree.map(np.asarray, self._decode(jnp.asarray(points), self.contexts))

    def objective(self, points: np.ndarray) -> np.ndarray:
        """Return the planner's objective, including penalties, at points (B, n); (B,)."""
        with jax.enable_x64(True):
            return np.asarray(self._objective(jnp.asarray(points), self.contexts).cost)

    def judge(self, plans: Any) -> np.ndarray:
        """Return which plans the referee accepts, (B,) bool."""
        return np.asarray(self.card.judge(self.cases, plans).success)

    def cost(self, plans: Any) -> np.ndarray:
        """Return the cost of snap and time of plans, (B,)."""
        with jax.enable_x64(True):
            path = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), plans.trajectory)
            cost = self.planner.energy_weight * np.asarray(jax.vmap(snap_energy)(path))
        if isinstance(self.planner, ExactCatch):
            cost = cost + self.planner.time_weight * np.asarray(plans.times, float)[:, -1]
        return cost


def run_planner(
    setup: Setup, effort: str, repeat: int, batch: int, seed: int
) -> tuple[Found, float]:
    """Run the planner with an effort; return results and the duration of the first call."""
    planner = setup.card.planner("exact", effort=effort, **setup.card.bench)
    num, host = len(setup.batches["learned"].starts), jax.devices("cpu")[:1]
    lanes = [pj.take(setup.cases, k) for k in range(num)]
    began = time.perf_counter()
    pj.plan(planner, lanes[0], devices=host)
    first = time.perf_counter() - began
    plans = [pj.plan(planner, case, devices=host) for case in lanes]  # compiles all rounds
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
    """Return the time that IPOPT takes to a feasible plan at no more than the planner's cost.

    Args:
        setup: the cases.
        peer: solver of the iterates.
        paths: the iterates (S, n) of each case.
        whole: (B,) [s], duration of each search.
        run: results of the planner.

    Returns:
        The times (B,) [s], and which plans are reached, (B,) bool.
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
    """Print all rows of one task."""
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
        peer = peers[form] = peer_module.Peer(setup.module, setup.planner, form, unit)
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
    """Print a row a solver; return the gaps of the planner's efforts."""
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
    """Format three quantiles in per cent."""
    if gap is None or not gap.size:
        return "-"
    return ", ".join(f"{100.0 * (each or 0.0):.2f} %" for each in gap_figures(gap).values())


def _report_equal_costs(
    bench: Bench, setup: Setup, efforts: dict, peers: dict, kept: dict, repeat: int
) -> None:
    """Print plans/s up to the planner's cost, for each effort, form and initial guess."""
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
    """Print the rows."""
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
    if hasattr(os, "sched_setaffinity"):  # before JAX starts its threads
        os.sched_setaffinity(0, [max(os.sched_getaffinity(0))])
    with begin(parser, options) as bench:
        for name in names:
            measure(bench, name, options)


if __name__ == "__main__":
    main()
