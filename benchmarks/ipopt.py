"""IPOPT on the planners' own problems: plans a second on one core, and at the same cost gap.

    python -m benchmarks.ipopt [--num 200] [--tune 20] [--seed 0] [--repeat 3] [--batch N]
        [--tasks hit,catch] [--out DIR]

Hits of the suite `court` and catches of one ball, `throws`, by `exact` with each effort, one plan
at a time on one core and in batches on JAX's first device, beside IPOPT through CasADi (the extra
`oracle`) on one core. Its problem has the same decision variables, first guess, objective and
samples, written down anew from the definitions (`ipopt_peer`), with exact derivatives and MUMPS,
in two forms: limits as constraints, where they have to be met as the planners' statuses ask, or
the planner's own penalties in the objective. Settings are tried on other cases, and each form's
quickest that is as good as any is kept; it is printed.

The cost of a plan is that of snap and time alone, in float64 for all, and its gap that to the
least of any accepted plan of the case that a run found. Times on one core are those of the
processor, so that a shared machine changes them little, compilation and building apart, each case
as fast as the fastest of --repeat tries. IPOPT reaches a planner's plan at its first iterate that
meets the limits and costs no more, within 0.01 %, by the planner's objective where it minimises
that: its time up to there is the iterates' share of a search to a tolerance of 1e-6, and all of it
where there is none. It need not know that it is there.
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
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin, chosen
from planner_jax.core.choices import EFFORTS
from planner_jax.core.errors import install_line
from planner_jax.core.protocol import FEASIBILITY_TOLERANCE
from planner_jax.cost.along import BETWEEN_NODES
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.hit.default_planner import ExactHit
from planner_jax.trajectory.polynomial import snap_energy

# By task: the suite, and the module that writes its problem down.
TASKS = {"hit": ("court", "hits"), "catch": ("throws", "catches")}
BATCH, GPU_BATCH = 1024, 65536
# What the batched interior-point solver jaxipm has over IPOPT at most: [Viljoen2026], quadrotors on
# one L40S.
JAXIPM = 32.85
TIGHTEST = 1e-6  # tolerance of the searches whose iterates are looked at
NO_MORE = 1e-4  # relative, by which a cost may be above another one and still counts as no more


@dataclasses.dataclass
class Found:
    """What one solver made of all cases."""

    name: str
    cost: np.ndarray  # (B,) of snap and time
    objective: np.ndarray | None  # (B,) the planner's, penalties included; None where not minimised
    accepted: np.ndarray  # (B,) bool, by the referee
    seconds: np.ndarray  # (B,) of processor time, one after another on one core
    in_batch: float | None = None  # plans a second


class Setup:
    """Cases of a task with what IPOPT is told about them, in float64.

    Args:
        name: of the task.
        num: how many cases.
        seed: that they are drawn by.
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
            told = peer.told_of(self.module, self.planner, self.contexts)
            for label, learned in (("learned", True), ("smooth", False)):
                planner = self.planner.with_settings((("learned", learned),))
                first = lambda context, planner=planner: planner.guesses(context, 1)[0]  # noqa: E731
                starts = np.asarray(jax.jit(jax.vmap(first))(self.contexts))
                self.batches[label] = peer.Batch(told, starts)
            self._decode = jax.jit(jax.vmap(self.planner.decode))
            self._objective = jax.jit(jax.vmap(self.planner.objective))

    def plans(self, points: np.ndarray) -> Any:
        """The plans of points (B, n), float64 NumPy leaves."""
        with jax.enable_x64(True):
            return jax.tree.map(np.asarray, self._decode(jnp.asarray(points), self.contexts))

    def objective(self, points: np.ndarray) -> np.ndarray:
        """The planner's objective, penalties included, at points (B, n); (B,)."""
        with jax.enable_x64(True):
            return np.asarray(self._objective(jnp.asarray(points), self.contexts).cost)

    def accepted(self, plans: Any) -> np.ndarray:
        """Which plans the referee passes, (B,) bool."""
        return np.asarray(self.card.judge(self.cases, plans).success)

    def cost(self, plans: Any) -> np.ndarray:
        """What snap and time of plans cost, (B,)."""
        with jax.enable_x64(True):
            path = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), plans.trajectory)
            cost = self.planner.energy_weight * np.asarray(jax.vmap(snap_energy)(path))
        if isinstance(self.planner, ExactCatch):
            cost = cost + self.planner.time_weight * np.asarray(plans.times, float)[:, -1]
        return cost


def ours(setup: Setup, effort: str, repeat: int, batch: int, seed: int) -> tuple[Found, float]:
    """The planner with an effort, and how long the first call of one case took, with compiling."""
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
            accepted=setup.accepted(together),
            seconds=seconds,
            in_batch=batch / min(elapsed[1:]),
        ),
        first,
    )


def seconds_to(
    setup: Setup, peer: Any, paths: list[np.ndarray], whole: np.ndarray, run: Found
) -> tuple[np.ndarray, np.ndarray]:
    """How long IPOPT takes to plans that meet the limits and cost no more than a run's, (B,) [s].

    Args:
        setup: the cases.
        peer: whose iterates these are.
        paths: the iterates (S, n) of each case.
        whole: (B,) [s] that each search takes.
        run: of the planner.

    Returns:
        The times, and which plans are reached, (B,) bool.
    """
    worst, told = peer.programs[False].worst, setup.batches["learned"].told
    by_objective = peer.form == "penalties"
    target = np.asarray(run.objective if by_objective else run.cost)
    costs = np.full((max(map(len, paths)), len(paths)), np.inf)
    for step in range(len(costs)):
        points = np.stack([path[min(step, len(path) - 1)] for path in paths])
        costs[step] = setup.objective(points) if by_objective else setup.cost(setup.plans(points))
    for k, path in enumerate(paths):
        excess = np.array([float(worst(point, told[k])) for point in path]) + BETWEEN_NODES
        costs[: len(path), k][~(excess <= FEASIBILITY_TOLERANCE)] = np.inf
        costs[len(path) :, k] = np.inf
    good = costs <= target * (1.0 + NO_MORE)
    reached, steps = np.asarray(good.any(axis=0)), np.array([len(path) for path in paths])
    share = np.where(reached, (np.argmax(good, axis=0) + 1) / steps, 1.0)
    return whole * share, reached


def measure(bench: Bench, name: str, options: Any) -> None:
    """All rows of one task."""
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
        f"Settings of IPOPT on {options.tune} other cases; tolerances are of the objective over "
        f"{unit:.2g}, which is a usual cost:",
        "",
        "| form | tolerance | options | functions | refereed | objective above the least (p90) | "
        "steps | ms |",
        "|---|---|---|---|---|---|---|---|",
    )
    runs, peers, kept = [], {}, {}
    for form in peer_module.TRIED:
        peer = peers[form] = peer_module.Peer(setup.module, setup.planner, form, unit)
        accepted = lambda points: tuning.accepted(tuning.plans(points))  # noqa: E731
        kept[form], rows = peer_module.best_setting(peer, tuning.batches["learned"], accepted)
        for row in rows:
            bench.row(task=name, what="setting", **row)
            told = ", ".join(f"{k} {v}" for k, v in row["options"].items()) or "-"
            how = "compiled C" if row["compiled"] else "CasADi's machine"
            mark = "**" if row["chosen"] else ""
            bench.say(
                f"| {mark}{form}{mark} | {row['tolerance']:g} | {told} | {how} | "
                f"{100.0 * row['success_rate']:.0f} % | {100.0 * row['above_p90']:.2f} % | "
                f"{row['steps']:.1f} | {row['milliseconds']:.1f} |"
            )
    efforts = {}
    firsts = []
    for effort in EFFORTS:
        efforts[effort], first = ours(setup, effort, options.repeat, batch, options.seed)
        firsts.append(first)
        runs.append(efforts[effort])
    for start, form in ((s, f) for s in setup.batches for f in peers):
        found = peers[form].solve(kept[form], setup.batches[start], options.repeat)
        plans = setup.plans(found.points)
        runs.append(
            Found(
                name=f"IPOPT, {form}, {start} first guess",
                cost=setup.cost(plans),
                objective=setup.objective(found.points) if form == "penalties" else None,
                accepted=setup.accepted(plans),
                seconds=found.seconds,
            )
        )
    gaps = _table(bench, name, runs)
    bench.say(
        "",
        f"First calls: {', '.join(f'{each:.1f}' for each in firsts)} s by effort, with what JAX's "
        "cache lacks compiled; "
        + "; ".join(
            f"IPOPT, {form}: {peer.build_seconds:.1f} s to build, {peer.compile_seconds:.1f} s "
            "to build and compile C"
            for form, peer in peers.items()
        ),
    )
    _equal_gaps(bench, setup, efforts, peers, kept, options.repeat)
    bench.count(np.concatenate([each.accepted for each in efforts.values()]), *gaps)


def _table(bench: Bench, name: str, runs: list[Found]) -> list[np.ndarray]:
    """A row a solver, and the gaps of the planner's efforts."""
    bench.say(
        "",
        "| solver | refereed | cost above the least (median, p90, p99) | planner's objective above "
        "the least (the same) | plans/s, one at a time on one core | plans/s in a batch |",
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
            f"| {run.name} | {100.0 * success:.1f} % | {_told(gap)} | {_told(own)} | {rate:,.0f} | "
            f"{'-' if run.in_batch is None else f'{run.in_batch:,.0f}'} |"
        )
        if run.in_batch is not None:
            gaps.append(gap)
    return gaps


def _told(gap: np.ndarray | None) -> str:
    """Three quantiles in per cent."""
    if gap is None or not gap.size:
        return "-"
    return ", ".join(f"{100.0 * (each or 0.0):.2f} %" for each in gap_figures(gap).values())


def _equal_gaps(
    bench: Bench, setup: Setup, efforts: dict, peers: dict, kept: dict, repeat: int
) -> None:
    """A row for each effort, form and first guess: plans a second up to the planner's cost."""
    bench.say(
        "",
        f"At the same gap; the planner's own first guess is the learned one. jaxipm has up to "
        f"{JAXIPM:g} times IPOPT's plans/s (published: other problems, one L40S):",
        "",
        "| effort | IPOPT's form | IPOPT's first guess | reaches the planner's cost | plans/s to "
        "there on one core | planner over IPOPT, one at a time on one core | planner in a batch "
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
    parser.add_argument("--tasks", default=",".join(TASKS), help="default: %(default)s")
    parser.add_argument(
        "--batch", type=at_least(1), help=f"default: {BATCH} on a CPU, {GPU_BATCH} elsewhere"
    )
    options = parser.parse_args()
    names = chosen(parser, "--tasks", options.tasks, TASKS)
    if importlib.util.find_spec("casadi") is None:
        parser.exit(2, f"benchmarks.ipopt needs casadi: {install_line('oracle')}\n")
    if hasattr(os, "sched_setaffinity"):  # before JAX starts its threads
        os.sched_setaffinity(0, [max(os.sched_getaffinity(0))])
    with begin(parser, options) as bench:
        for name in names:
            measure(bench, name, options)


if __name__ == "__main__":
    main()
