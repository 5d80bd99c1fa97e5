"""Compare this library's L-BFGS with optax.lbfgs and SciPy's L-BFGS-B on the objective of hits.

    python -m benchmarks.optimiser [--num 200] [--row late-0.5] [--out DIR]

The cases are hits in which planning starts --row late-T seconds after the serve, or in which limits
are multiplied by F (--row limits-F). All three solvers minimise the same float32 objective in the
same scaled variables, from the same initial guess. This library's solver and optax solve all cases
in one batched call. SciPy solves one case after another, with a compiled function of value and
gradient. Times are per plan, without compilation. The referee, an independent check in float64,
decides about success. The run's summary has the success rate of this library's solver, over all
maximum numbers of iterations.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.optimize

import planner_jax as pj
from planner_jax.benchmarks.cost_gap import gap_figures
from planner_jax.benchmarks.hit_rows import ROWS
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.optimise.multistart import minimise
from planner_jax.task.hit.default_planner import HitProblem

PROBLEM = HitProblem()


def make_own_solver(iterations: int) -> Callable:
    """Return a function that minimises the objective of one hit with this library's L-BFGS.

    The function maps a case to n decision variables (n,) and the number of iterations.
    """

    def solve(case):
        context = PROBLEM.prepare(case)
        start = PROBLEM.guesses(context, 1)[0]
        found = minimise(
            lambda x: PROBLEM.objective(x, context), start, pj.LbfgsConfig(max_steps=iterations)
        )
        return found.point, found.iterations

    return solve


def make_optax_solver(iterations: int) -> Callable:
    """Return a function that minimises the planner's objective for one hit with optax.lbfgs.

    It uses optax's zoom line search. The function maps a case to n decision variables (n,) and the
    number of iterations.
    """

    def solve(case):
        context = PROBLEM.prepare(case)
        solver = optax.lbfgs(memory_size=6)

        def cost(x):
            return PROBLEM.objective(x, context).cost

        def step(_, carry):
            point, state = carry
            value, grad = optax.value_and_grad_from_state(cost)(point, state=state)
            updates, state = solver.update(
                grad, state, point, value=value, grad=grad, value_fn=cost
            )
            return optax.apply_updates(point, updates), state

        start = PROBLEM.guesses(context, 1)[0]
        point, _ = jax.lax.fori_loop(0, iterations, step, (start, solver.init(start)))
        return point, jnp.asarray(iterations)

    return solve


def run_batched(solve: Callable, cases) -> tuple[np.ndarray, float, float]:
    """Solve B cases in one call, after a first call that compiles.

    Returns n decision variables of each case (B, n), the mean number of iterations, and the
    duration [s].
    """
    compiled = jax.jit(jax.vmap(solve))
    jax.block_until_ready(compiled(cases))
    began = time.perf_counter()
    points, iterations = jax.block_until_ready(compiled(cases))
    return np.asarray(points), float(iterations.mean()), time.perf_counter() - began


def run_scipy(cases, iterations: int) -> tuple[np.ndarray, float, float]:
    """Solve B cases one after another with SciPy's L-BFGS-B and a compiled value and gradient.

    Returns n decision variables of each case (B, n), the mean number of iterations, and the
    duration [s].
    """
    contexts = jax.jit(jax.vmap(PROBLEM.prepare))(cases)
    starts = np.asarray(jax.jit(jax.vmap(lambda c: PROBLEM.guesses(c, 1)[0]))(contexts), float)
    value_and_grad = jax.jit(jax.value_and_grad(lambda x, c: PROBLEM.objective(x, c).cost))
    lanes = [jax.tree.map(lambda x, k=k: x[k], contexts) for k in range(len(starts))]
    value_and_grad(starts[0], lanes[0])
    points, counts = [], []
    began = time.perf_counter()
    for start, context in zip(starts, lanes, strict=True):

        def function(x, context=context):
            value, grad = value_and_grad(np.float32(x), context)
            return float(value), np.asarray(grad, float)

        found = scipy.optimize.minimize(
            function,
            start,
            jac=True,
            method="L-BFGS-B",
            options={"maxcor": 6, "maxiter": iterations, "ftol": 1e-9, "gtol": 1e-12},
        )
        points.append(found.x)
        counts.append(found.nit)
    return np.asarray(points, np.float32), float(np.mean(counts)), time.perf_counter() - began


def main() -> None:
    parser = argument_parser("optimiser", __doc__, num=200)
    parser.add_argument("--row", default="late-0.5", choices=[*ROWS][:-1], help="default: late-0.5")
    options = parser.parse_args()
    cases = pj.hit.draw(options.num, seed=2, **ROWS[options.row])
    final = jax.jit(jax.vmap(lambda s, x: PROBLEM.objective(x, PROBLEM.prepare(s)).cost))
    decode = jax.jit(jax.vmap(lambda s, x: PROBLEM.decode(x, PROBLEM.prepare(s))))
    with begin(parser, options) as bench:
        bench.say(
            f"{options.num} generated serves, row {options.row}, {jax.devices()[0].platform}",
            "| solver | iterations | ms a plan | median cost | mean cost | success |",
            "|---|---|---|---|---|---|",
        )
        best = pj.plan(pj.SearchPlanner(PROBLEM).with_solver(), jax.tree.map(np.asarray, cases))
        runs = {
            "planner_jax": lambda n: run_batched(make_own_solver(n), cases),
            "optax.lbfgs": lambda n: run_batched(make_optax_solver(n), cases),
            "SciPy L-BFGS-B": lambda n: run_scipy(cases, n),
        }
        for budget, name in ((budget, name) for budget in (10, 60, 200) for name in runs):
            points, iterations, seconds = runs[name](budget)
            cost = np.asarray(final(cases, points))
            success = pj.hit.judge(cases, decode(cases, points)).success
            gaps = (cost / best.cost - 1.0)[success & pj.are_solved(best)]
            bench.say(
                f"| {name} | {iterations:.0f} of {budget} | {1e3 * seconds / options.num:.3f} | "
                f"{np.median(cost):.3g} | {cost.mean():.3g} | {100 * success.mean():.1f} % |"
            )
            bench.row(
                solver=name,
                budget=budget,
                iterations=iterations,
                seconds=seconds,
                median_cost=np.median(cost),
                mean_cost=cost.mean(),
                success=success.mean(),
                **gap_figures(gaps),
            )
            if name == "planner_jax":
                bench.count(success, gaps)


if __name__ == "__main__":
    main()
