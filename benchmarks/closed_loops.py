"""Measure closed loops of catches inside compiled functions: each robot plans anew in each step.

    taskset -c 0 python -m benchmarks.closed_loops [--num 64] [--steps 18] [--turns 5] [--out DIR]

Each of --num robots plans the catch of a thrown ball, moves along its plan for 0.03 s, and plans
again for the ball that is then nearer, --steps times in all. The program compares ways to write
this loop:
* a Python loop that calls `pj.plan` for all robots in each step;
* one compiled `lax.scan` over the steps, with `pj.solve` of all robots in each step;
* `jax.vmap` of the compiled loop of a single robot, which calls `pj.solve`;
* the scan and the Python loop with `pj.replan` from the plan of the step before, too.

For each way the table has the CPU time of the first call, which compiles, the CPU time of a later
call (the median of --turns calls, in turns), and how many of all plans solve their case. The
referee judges all plans.
"""

import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.trajectory.polynomial import evaluate

PERIOD = 0.03  # [s] between two plans
PLANNER = pj.catch.planner("exact")


def advance(case: Any, plan: Any) -> Any:
    """Return a case one period later, of a robot that moves as planned."""
    time = jnp.asarray(PERIOD, case.horizon.dtype)
    state = [evaluate(plan.trajectory, time, order) for order in range(4)]
    ball = jax.vmap(lambda path: path.at(time))(case.targets)
    targets = case.targets.replace(ball=ball)
    return case.replace(head_state=jnp.stack(state), targets=targets, horizon=case.horizon - PERIOD)


def scan(cases: Any, *, steps: int, again: bool = False) -> tuple[Any, Any]:
    """Return cases and plans of all steps, of one robot or of a batch, in a compiled loop."""
    move = advance if cases.batch_shape == () else jax.vmap(advance)

    def step(cases: Any, _: None) -> tuple[Any, Any]:
        plans = pj.solve(PLANNER, cases)
        return move(cases, plans), (cases, plans)

    def step_again(now: tuple[Any, Any], _: None) -> tuple[Any, Any]:
        cases, plans = now
        later = move(cases, plans)
        news = {"targets": later.targets, "head_state": later.head_state}
        time = jnp.full(cases.batch_shape, PERIOD, later.horizon.dtype)
        new = pj.replan(PLANNER, cases, plans, time, **news)
        return (later, new), (later, new)

    if not again:
        return jax.lax.scan(step, cases, length=steps)[1]
    first = cases, pj.solve(PLANNER, cases)
    others = jax.lax.scan(step_again, first, length=steps - 1)[1]
    return jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, others)


def loop(cases: Any, move: Callable, *, steps: int, again: bool = False) -> tuple[Any, Any]:
    """Return cases and plans of all steps, by a Python loop over the steps."""
    found, plans = [], None
    for _ in range(steps):
        if again and plans is not None:
            later = jax.device_get(move(cases, plans))
            news = {"targets": later.targets, "head_state": later.head_state}
            plans = pj.replan(PLANNER, cases, plans, PERIOD, **news)
            cases = later
        else:
            plans = pj.plan(PLANNER, cases)
        found.append((cases, plans))
        if not again:
            cases = jax.device_get(move(cases, plans))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)


def ways(steps: int) -> dict[str, Callable]:
    """Return each way to write the loop: a function of the cases of all robots."""
    move = jax.jit(jax.vmap(advance))
    lanes = lambda found: jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), found)  # noqa: E731
    alone = functools.partial(scan, steps=steps)
    return {
        "Python loop, pj.plan": functools.partial(loop, move=move, steps=steps),
        "scan, pj.solve of the batch": jax.jit(functools.partial(scan, steps=steps)),
        "vmap of a scan, pj.solve": jax.jit(lambda cases: lanes(jax.vmap(alone)(cases))),
        "Python loop, pj.replan": functools.partial(loop, move=move, steps=steps, again=True),
        "scan, pj.replan of the batch": jax.jit(functools.partial(scan, steps=steps, again=True)),
    }


def main() -> None:
    """Run the benchmark."""
    parser = argument_parser("closed_loops", __doc__, num=64, steps=18, turns=5, seed=0)
    options = parser.parse_args()
    cases = pj.catch.draw(options.num, "throws", seed=options.seed)
    functions, times, found = ways(options.steps), {}, {}
    with begin(parser, options) as bench:
        for turn in range(options.turns + 1):
            for name, function in functions.items():
                began = time.process_time()
                found[name] = jax.block_until_ready(function(cases))
                times.setdefault(name, []).append(time.process_time() - began)
                if turn == 0:
                    print(name, times[name], flush=True)
        bench.say(
            "| loop | first call, CPU s | later, CPU s | solved | accepted |",
            "|---|---|---|---|---|",
        )
        for name, (each, plans) in found.items():
            flat = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), (each, plans))
            first, *later = times[name]
            success = pj.catch.judge(*flat).success
            solved, median = int(pj.are_solved(flat[1]).sum()), float(np.median(later))
            bench.count(success)
            bench.say(
                f"| {name} | {first:.1f} | {median:.2f} | {solved} of {len(success)} "
                f"| {success.sum()} |"
            )
            bench.row(
                loop=name, first=first, later=median, solved=solved, accepted=int(success.sum())
            )


if __name__ == "__main__":
    main()
