"""Compare `planner_jax.optimise.minimise` with optax and optimistix on standard test functions.

    python -m benchmarks.optimiser [--num 1024] [--repeats 7] [--seed 0] [--out DIR]

Each problem has --num random starts. A solver takes them as one batch in float32. Its stopping
tolerance is the fastest of four with which it solves most starts: a start is solved if its cost
exceeds the known minimum by at most 1e-5 (1 + minimum). Times are medians of --repeats calls, in
which solvers and tolerances take turns. Compile times are separate. The minimum within bounds is
computed by SciPy's L-BFGS-B in float64.

`optax.lbfgs` and optimistix have no bounds. Within bounds `minimise` is therefore compared with
Adam of optax, whose steps are projected by `optax.projections`. Without the package optimistix its
rows are left out. The run's summary has the share of starts that `minimise` solves by its first
solver, and the numbers of problems that it solves faster than the other packages.
"""

import importlib
import importlib.util
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.optimize

from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.optimise import LbfgsConfig, LevenbergConfig, NewtonConfig, minimise

TOLERANCES = np.array([1e-2, 1e-3, 1e-4, 1e-5], np.float32)
MARGIN = 0.005  # shares of solved starts are equal up to this difference
TIMES = np.linspace(0.0, 2.0, 12)  # of the samples of an exponential


def rosenbrock(x):
    return jnp.concatenate([10.0 * (x[1:] - x[:-1] ** 2), 1.0 - x[:-1]])


def himmelblau(x):
    return jnp.stack([x[0] ** 2 + x[1] - 11.0, x[0] + x[1] ** 2 - 7.0])


def beale(x):
    powers = x[1] ** jnp.arange(1, 4)
    return jnp.array([1.5, 2.25, 2.625], x.dtype) - x[0] * (1.0 - powers)


def powell(x):
    a, b, c, d = x
    root = jnp.sqrt(jnp.array([5.0, 10.0], x.dtype))
    terms = [a + 10.0 * b, root[0] * (c - d), (b - 2.0 * c) ** 2, root[1] * (a - d) ** 2]
    return jnp.stack(terms)


def exponential(x):
    times = jnp.asarray(TIMES, x.dtype)
    return x[0] * jnp.exp(-x[1] * times) + x[2] - (2.0 * jnp.exp(-1.5 * times) + 0.5)


def matyas(x):
    return 0.26 * (x[0] ** 2 + x[1] ** 2) - 0.48 * x[0] * x[1]


def branin(x):
    a, b = x
    valley = b - 5.1 / (4.0 * np.pi**2) * a**2 + 5.0 / np.pi * a - 6.0
    return valley**2 + 10.0 * (1.0 - 1.0 / (8.0 * np.pi)) * jnp.cos(a) + 10.0


def zakharov(x):
    weighted = jnp.sum(0.5 * jnp.arange(1, x.size + 1) * x)
    return jnp.sum(x**2) + weighted**2 + weighted**4


def quadratic(x):
    return jnp.sum(jnp.logspace(0.0, 3.0, x.size, dtype=x.dtype) * (x - 1.0) ** 2)


class Case(NamedTuple):
    """A test function, whose local minima all have the value `least`, and its random starts.

    A function of several minima has no bounds, within which some of them would cost more.
    """

    function: Callable
    size: int
    starts: tuple[float, float]
    upper: float | None  # bound on the first variable, which excludes the minimum
    least: float = 0.0


RESIDUALS = {
    "Rosenbrock": Case(rosenbrock, 2, (-2.0, 2.0), 0.5),
    "Rosenbrock, n = 3": Case(rosenbrock, 3, (-2.0, 2.0), 0.5),
    "Himmelblau": Case(himmelblau, 2, (-4.0, 4.0), None),
    "Beale": Case(beale, 2, (-1.0, 3.0), 2.0),
    "Powell": Case(powell, 4, (-3.0, 3.0), -1.0),
    "exponential fit": Case(exponential, 3, (0.0, 3.0), 1.5),
}
COSTS = {name: case for name, case in RESIDUALS.items() if name != "exponential fit"} | {
    "Matyas": Case(matyas, 2, (-10.0, 10.0), -1.0),
    "Branin": Case(branin, 2, (0.0, 15.0), None, 0.39788736),
    "Zakharov, n = 6": Case(zakharov, 6, (-2.0, 2.0), -0.5),
    "quadratic, n = 20": Case(quadratic, 20, (-3.0, 3.0), 0.5),
}


def cost_of(case: Case) -> Callable:
    """Return the cost of a test function: its value, or the sum of its squared residuals."""
    return lambda x: jnp.sum(case.function(x) ** 2) if is_squares(case) else case.function(x)


def is_squares(case: Case) -> bool:
    return case.function in {each.function for each in RESIDUALS.values()}


def own_solver(function: Callable, settings: Any, bounds: Any) -> Callable:
    """Return a function of starts (B, n) and a tolerance: points by this library's solver."""

    def solve(starts, tolerance):
        limits: Any = bounds and [jnp.broadcast_to(each, starts.shape) for each in bounds]
        return minimise(
            function, starts, settings, bounds=limits, gradient_tolerance=tolerance
        ).point

    return solve


def by_optax(function: Callable, method: Any, bounds: Any, most: int = 300) -> Callable:
    """Return a solver as `own_solver` does, which repeats a transformation of optax."""
    project = lambda x: optax.projections.projection_box(x, *bounds) if bounds else x  # noqa: E731

    def solve_one(start, tolerance):
        is_lbfgs = bounds is None
        slope = optax.value_and_grad_from_state(function) if is_lbfgs else None

        def step(carry):
            point, state, count, _ = carry
            value, grad = (
                slope(point, state=state) if slope else jax.value_and_grad(function)(point)
            )
            extra = {"value": value, "grad": grad, "value_fn": function} if is_lbfgs else {}
            updates, state = method.update(grad, state, point, **extra)
            norm = jnp.max(jnp.abs(point - project(point - grad)))
            return project(optax.apply_updates(point, updates)), state, count + 1, norm

        is_open = lambda carry: (carry[2] < most) & (carry[3] > tolerance)  # noqa: E731
        return jax.lax.while_loop(is_open, step, (start, method.init(start), 0, jnp.inf))[0]

    return jax.vmap(solve_one, (0, None))


def by_optimistix(function: Callable, kind: str) -> Callable:
    """Return a solver as `own_solver` does, of optimistix at a tenth of the tolerance."""
    optimistix: Any = importlib.import_module("optimistix")  # may be absent
    squares = kind != "BFGS"
    run = optimistix.least_squares if squares else optimistix.minimise

    def solve_one(start, tolerance):
        solver = getattr(optimistix, kind)(rtol=0.1 * tolerance, atol=0.1 * tolerance)
        found = run(lambda x, _: function(x), solver, start, throw=False)
        return found.value

    return jax.vmap(solve_one, (0, None))


def solvers_of(case: Case, bounds: Any, by_residuals: bool) -> dict[str, Callable]:
    """Return the solvers of a problem by name; the names of this library's start with "own"."""
    has_peer = importlib.util.find_spec("optimistix") is not None
    if by_residuals:
        settings = LevenbergConfig(max_steps=100, settled=6, tolerance=1e-4, longest=5.0)
        solvers = {"own LevenbergConfig": own_solver(case.function, settings, bounds)}
        for kind in ("LevenbergMarquardt", "Dogleg") if has_peer and bounds is None else ():
            solvers[f"optimistix.{kind}"] = by_optimistix(case.function, kind)
        return solvers
    cost = cost_of(case)
    lbfgs = LbfgsConfig(max_steps=300, tolerance=1e-7, patience=6)
    newton = NewtonConfig(max_steps=100, subspace=case.size, tolerance=1e-6, patience=6)
    solvers = {"own LbfgsConfig": own_solver(cost, lbfgs, bounds)}
    if case.size <= 6:  # a program of Newton's method grows with its subspace
        solvers["own NewtonConfig"] = own_solver(cost, newton, bounds)
    if bounds is not None:
        return solvers | {"optax.adam, projected": by_optax(cost, optax.adam(0.1), bounds, 1000)}
    solvers["optax.lbfgs"] = by_optax(cost, optax.lbfgs(), None)
    if has_peer:
        solvers["optimistix.BFGS"] = by_optimistix(cost, "BFGS")
    return solvers


def least_within(case: Case, bounds: Any, starts: np.ndarray) -> float:
    """Return the least cost within bounds that SciPy's L-BFGS-B finds from the first 40 starts."""
    with jax.enable_x64(True):
        slope = jax.jit(jax.value_and_grad(cost_of(case)))
        limits = list(zip(*(np.asarray(each, float) for each in bounds), strict=True))
        options = {"ftol": 1e-15, "gtol": 1e-10}
        runs = (
            scipy.optimize.minimize(
                lambda x: tuple(map(np.asarray, slope(x))),
                start.astype(float),
                jac=True,
                bounds=limits,
                options=options,
            ).fun
            for start in starts[:40]
        )
        return min(map(float, runs))


def measure(
    solvers: dict[str, Callable], starts: np.ndarray, is_good: Callable, repeats: int
) -> dict[str, dict]:
    """Return for each solver the share of solved starts, ms of a batch, and seconds to compile."""
    compiled, rows = {}, {}
    for name, solve in solvers.items():
        began = time.perf_counter()
        compiled[name] = jax.jit(solve).lower(starts, TOLERANCES[0]).compile()
        rows[name] = {"compile": time.perf_counter() - began}
    runs = [(name, each) for name in solvers for each in TOLERANCES]
    solved = {(name, each): is_good(compiled[name](starts, each)) for name, each in runs}
    times = {run: [] for run in runs}
    for name, each in runs * repeats:
        began = time.perf_counter()
        jax.block_until_ready(compiled[name](starts, each))
        times[name, each].append(1e3 * (time.perf_counter() - began))
    for name, row in rows.items():
        settings = [
            {"share": solved[run].mean(), "ms": np.median(times[run]), "tolerance": run[1]}
            for run in runs
            if run[0] == name
        ]
        row |= select(settings)
        row["solved"] = solved[name, row["tolerance"]]
    return rows


def select(rows: list[dict]) -> dict:
    """Return the fastest of the rows that solve most starts."""
    most = max(row["share"] for row in rows) - MARGIN
    return min((row for row in rows if row["share"] >= most), key=lambda row: row["ms"])


def main() -> None:
    parser = argument_parser("optimiser", __doc__, num=1024, repeats=7, seed=0)
    options = parser.parse_args()
    wins, losses = [], []
    with begin(parser, options) as bench:
        bench.say(
            f"{options.num} starts, JAX {jax.__version__}, {jax.devices()[0].platform}",
            "| problem | bounds | solver | solved | ms | compile s |",
            "|---|---|---|---|---|---|",
        )
        problems = [(*each, False) for each in COSTS.items()]
        problems += [(*each, True) for each in RESIDUALS.items()]
        for number, (name, case, by_residuals) in enumerate(problems):
            random = np.random.default_rng((options.seed, number))
            starts = random.uniform(*case.starts, (options.num, case.size)).astype(np.float32)
            upper = np.full(case.size, np.inf, np.float32)
            upper[0] = np.inf if case.upper is None else case.upper
            within = (np.full_like(upper, -20.0), upper)
            for bounds in (None,) if case.upper is None else (None, within):
                least = case.least if bounds is None else least_within(case, bounds, starts)
                cost = jax.jit(jax.vmap(cost_of(case)))

                def is_good(x, cost=cost, least=least):
                    return np.asarray(cost(x) <= least + 1e-5 * (1.0 + least))

                rows: dict[str, list] = {"own": [], "peer": []}
                solvers = solvers_of(case, bounds, by_residuals)
                title = f"{name}{', residuals' if by_residuals else ''}"
                for solver, found in measure(solvers, starts, is_good, options.repeats).items():
                    solved = found.pop("solved")
                    if not rows["own"]:
                        bench.count(solved)
                    rows["own" if solver.startswith("own") else "peer"].append(found)
                    bench.row(problem=title, bounds=bounds is not None, solver=solver, **found)
                    bench.say(
                        f"| {title} | {'yes' if bounds else 'no'} | {solver} | "
                        f"{100 * found['share']:.1f} % | {found['ms']:.1f} | "
                        f"{found['compile']:.1f} |"
                    )
                if rows["peer"]:
                    mine, other = select(rows["own"]), select(rows["peer"])
                    is_win = mine["share"] >= other["share"] - MARGIN and mine["ms"] < other["ms"]
                    (wins if is_win else losses).append(f"{title}{' (bounds)' * bool(bounds)}")
        total = len(wins) + len(losses)
        bench.note(wins=len(wins), compared=total)
        bench.say(
            f"`minimise` is faster, and solves as many starts, on {len(wins)} of {total} problems.",
            f"Not on: {', '.join(losses) or 'none'}.",
        )


if __name__ == "__main__":
    main()
