"""Measure closed loops of catches inside compiled functions: each robot plans anew in each step.

    taskset -c 0 python -m benchmarks.closed_loops [--num 64] [--steps 18] [--turns 5] [--out DIR]

Each of --num robots plans the catch of a thrown ball, moves along its plan for 0.03 s, and plans
again for the ball that is then nearer. The program compares ways to write this loop of --steps
steps:
* a Python loop that calls `pj.plan` for all robots in each step;
* one compiled `lax.scan` over the steps, with `pj.solve` of all robots in each step;
* the same with only the first two attempts of the planner, or only the first one;
* `jax.vmap` of the compiled loop of a single robot, which calls `pj.solve`;
* a Python loop and a scan that make first plans, and in each step re-plan by `pj.replan`.

The table has for each way the CPU time of the first call, which compiles, and of a later call (the
median of --turns calls, in turns). The cache on the disk is not used, but a way may use programs of
an earlier one. Further columns count the plans of all steps that solve their case, and those that
the referee accepts. The cost gap of a plan is the relative excess of its cost over the cost that a
longer search finds. The table has its median.
"""

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

import planner_jax as pj
from planner_jax.benchmarks.cost_gap import cost_gaps, gap_figures
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.trajectory.polynomial import evaluate

PERIOD = 0.03  # [s] between two plans
PLANNER = pj.catch.planner("exact")

Move = Callable[[PyTree, PyTree], PyTree]  # returns cases one period later, from cases and plans
Step = Callable[[PyTree], tuple[PyTree, PyTree]]  # as for `lax.scan`: returns state and result


def advance(case: PyTree, plan: PyTree) -> PyTree:
    """Return a case one period later, of a robot that moves as planned."""
    time = jnp.asarray(PERIOD, case.horizon.dtype)
    state = [evaluate(plan.trajectory, time, order) for order in range(4)]
    targets = case.targets.replace(ball=jax.vmap(lambda path: path.at(time))(case.targets))
    return case.replace(head_state=jnp.stack(state), targets=targets, horizon=case.horizon - PERIOD)


def plan_anew(move: Move, cases: PyTree, planner: pj.Planner = PLANNER) -> tuple[PyTree, PyTree]:
    """Plan cases from scratch; return the cases one period later, and (cases, plans)."""
    plans = pj.plan(planner, cases)  # `pj.solve` inside a compiled function
    return move(cases, plans), (cases, plans)


def plan_again(move: Move, now: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
    """Re-plan the cases of `now`, (cases, plans), one period later; return twice the new pair."""
    later = move(*now)
    news = {"targets": later.targets, "head_state": later.head_state}
    new = later, pj.replan(PLANNER, *now, PERIOD, **news)
    return new, new


def with_first_plans(cases: PyTree) -> tuple[PyTree, PyTree]:
    """Return cases and their plans from scratch."""
    return cases, pj.plan(PLANNER, cases)


def scan(step: Step, state: PyTree, steps: int) -> PyTree:
    """Return the results of all steps of a compiled loop."""
    return jax.lax.scan(lambda state, _: step(state), state, length=steps)[1]


def loop(step: Step, state: PyTree, steps: int) -> PyTree:
    """Return the results of all steps of a Python loop."""
    found = []
    for _ in range(steps):
        state, result = step(state)
        found.append(result)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)


def ways(steps: int) -> dict[str, Callable[[PyTree], tuple[PyTree, PyTree]]]:
    """Return each way to write the loop: a function of the cases of all robots."""
    together = jax.vmap(advance)
    compiled = jax.jit(together)
    on_host = lambda cases, plans: jax.device_get(compiled(cases, plans))  # noqa: E731
    each, anew, again = (
        functools.partial(plan_anew, advance),
        functools.partial(plan_anew, together),
        functools.partial(plan_again, together),
    )
    anew_on_host = functools.partial(plan_anew, on_host)
    again_on_host = functools.partial(plan_again, on_host)
    few = {}
    for num in (2, 1):
        planner = pj.catch.planner("exact", attempts=pj.catch.CatchProblem.attempts[:num])
        anew_by = functools.partial(anew, planner=planner)
        few[f"scan, pj.solve, attempts[:{num}]"] = jax.jit(
            lambda cases, step=anew_by: scan(step, cases, steps)
        )
    alone = jax.vmap(lambda case: scan(each, case, steps), out_axes=1)
    return {
        "Python loop, pj.plan": lambda cases: loop(anew_on_host, cases, steps),
        "scan, pj.solve of the batch": jax.jit(lambda cases: scan(anew, cases, steps)),
        **few,
        "vmap of a scan, pj.solve": jax.jit(alone),
        "Python loop, pj.replan": lambda cases: loop(again_on_host, with_first_plans(cases), steps),
        "scan, pj.replan of the batch": jax.jit(
            lambda cases: scan(again, with_first_plans(cases), steps)
        ),
    }


def main() -> None:
    """Run the benchmark."""
    parser = argument_parser("closed_loops", __doc__, num=64, steps=18, turns=5, seed=0)
    options = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    cases = jax.device_get(pj.catch.draw(options.num, "throws", seed=options.seed))
    functions, found = ways(options.steps), {}
    times: dict[str, list[float]] = {name: [] for name in functions}
    with begin(parser, options) as bench:
        for _ in range(options.turns + 1):
            for name, function in functions.items():
                began = time.process_time()
                found[name] = jax.block_until_ready(function(cases))
                times[name].append(time.process_time() - began)
        bench.say(
            "| loop | first call, CPU s | later, CPU s | solved | accepted | cost gap, median |",
            "|---|---|---|---|---|---|",
        )
        for name, pair in found.items():
            flat = jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), pair)
            first, later = times[name][0], float(np.median(times[name][1:]))
            success, solved = pj.catch.judge(*flat).success, pj.are_solved(flat[1])
            gaps = cost_gaps(PLANNER, *flat)
            figures = gap_figures(gaps)
            bench.count(success, gaps)
            bench.say(
                f"| {name} | {first:.1f} | {later:.2f} | {solved.sum()} of {solved.size} "
                f"| {success.sum()} | {100 * (figures['cost_gap_median'] or 0.0):.2g} % |"
            )
            bench.row(
                loop=name,
                first=first,
                later=later,
                solved=int(solved.sum()),
                accepted=int(success.sum()),
                **figures,
            )


if __name__ == "__main__":
    main()
