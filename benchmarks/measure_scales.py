"""Measure the scales of the variables of hits and catches, and the metric of rallies.

    python -m benchmarks.measure_scales [--write] [--out DIR]

Decision variables are divided by scales, so that the objective has a similar curvature along all
variables. The scale of variable i is 1 / sqrt(floor + median H_ii), with a small constant floor.
H_ii is the diagonal element i of H = J^T J, the Gauss-Newton approximation of the Hessian, from the
Jacobian J of the planner's residuals in SI units. For each case, H is the sum at the initial guess
and at a solution. The median is over cases.

The cases of hits are drawn serves, 100 of each of five hard kinds, so that limits are active. The
cases of catches are throws of the suite `hard`, with limits multiplied by 1 and 0.8. The program
prints the largest ratio of a measured to a shipped scale, and the share of plans with the measured
scales that the referee, an independent check in float64, accepts. --write replaces the shipped
files.

The metric of rallies is the inverse square root of the median over cases of the Hessian at the
optimum, in units of the shipped scale. The cases are those of the suite `juggle`.
"""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
import planner_jax.task
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.core.tasks import task_named
from planner_jax.cost.quadrotor import limits_along
from planner_jax.optimise.chain import ChainProblem
from planner_jax.optimise.multistart import minimise
from planner_jax.optimise.settings import LbfgsConfig
from planner_jax.planning.decided import first_choice
from planner_jax.trajectory.proportional_minco import (
    Chain,
    chain_rows,
    sample_motion,
    trajectory_energy,
)

HIT_PIECES, CATCH_PIECES = (6, 12), (6,)

# Scales of the variables at the end of a hit with which the measurement starts: logarithms of the
# duration, of the ball's flight time and of the thrust, the racket's two speeds within its plane
# [m/s], and jerk [m/s^3].
_FIRST_HIT = (0.05, 0.1, 0.2, 0.6, 0.8, 30.0, 30.0, 30.0)
# Scales of the variables at the end of a catch with which the measurement starts: logarithm of the
# duration, position in the net (2), velocity [m/s], acceleration [m/s^2], jerk [m/s^3].
_FIRST_CATCH = (0.03, 0.5, 0.5, 0.6, 0.6, 0.6, 2.0, 2.0, 2.0, 40.0, 40.0, 30.0)
# Constant added to curvatures of catches. It is larger than for hits, because the objective of easy
# throws hardly depends on the position in the net and the final jerk.
_CATCH_FLOOR = 0.1


# Type of a function that returns the residuals (R,) of a problem at n decision variables (n,). Its
# third argument is the result of the problem's `prepare` for one case.
Residuals = Callable[[Any, jax.Array, Any], jax.Array]
_LEAST_EIGENVALUE = 3e-3  # Least eigenvalue of the Hessian for a metric, relative to the greatest.
_ROUNDS = 3  # Number of measurements, each with the scales that the previous one measured.


def curvature_diagonal(residuals: Callable[[jax.Array], jax.Array], point: jax.Array) -> jax.Array:
    """Return the diagonal (n,) of J^T J, with the Jacobian J of residuals at a point (n,)."""
    jacobian = jax.jacfwd(residuals)(point)
    return jnp.sum(jacobian**2, axis=0)


def measure_scale(
    problem: Any, cases: Any, residuals: Residuals, *, floor: float = 1e-4
) -> np.ndarray:
    """Measure the scale of every decision variable of a problem on a batch of cases.

    The solutions at which curvature is measured depend on the scales with which they are computed.
    The measurement is therefore made three times, each time with the scales measured before. It
    converges in two or three measurements.

    Args:
        problem: a frozen dataclass with a `scale` field, whose initial value is only a rough guess.
        cases: a batch of a few hundred cases, some of them hard, so that limits are active.
        residuals: function of the problem, a point (n,) of the n decision variables, and the result
            of the problem's `prepare` for a case. Returns residuals whose squares sum to about
            twice the objective near its minimum.
        floor: added to the curvature, so that a variable with almost no effect gets a finite scale.

    Returns:
        (n,) float64, the scales.
    """
    config = LbfgsConfig(max_steps=30)
    for _ in range(_ROUNDS):

        def diagonals(case: Any, problem: Any = problem) -> jax.Array:
            context = problem.prepare(case)
            scale = jnp.asarray(problem.scale)
            start = problem.first_guess(context)
            optimum = minimise(lambda x: problem.objective(x, context), start, config)

            def at(point: jax.Array) -> jax.Array:
                return curvature_diagonal(
                    lambda natural: residuals(problem, natural / scale, context), point * scale
                )

            return at(start) + at(optimum.point)

        curvature = np.asarray(jax.jit(jax.vmap(diagonals))(cases), np.float64)
        scale = 1.0 / np.sqrt(floor + np.nanmedian(curvature, axis=0))
        problem = dataclasses.replace(problem, scale=tuple(scale.tolist()))
    return np.asarray(problem.scale)


def measure_metric(problem: Any, cases: Any) -> dict[str, np.ndarray]:
    """Measure the metric of a problem's n variables on a batch of cases.

    Returns:
        `factor` (n, n), the inverse square root of the median Hessian, whose small eigenvalues are
        raised; and `shift` (n,), the median displacement of the optimum from the first guess.
    """
    config = LbfgsConfig(max_steps=60, tolerance=1e-6, patience=6)

    def search(case: Any) -> tuple[jax.Array, jax.Array]:
        context = problem.prepare(case)
        cost = lambda x: problem.objective(x, context)  # noqa: E731
        start = problem.first_guess(context)
        point = minimise(cost, start, config).point
        return jax.hessian(lambda x: cost(x).cost)(point), point - start

    hessians, shifts = map(np.asarray, jax.jit(jax.vmap(search))(cases))
    sound = np.isfinite(hessians).all(axis=(1, 2))
    values, vectors = np.linalg.eigh(np.median(hessians[sound].astype(np.float64), axis=0))
    sizes = np.sqrt(np.maximum(values, _LEAST_EIGENVALUE * values[-1]))
    factor = np.median(sizes) * (vectors / sizes) @ vectors.T
    return {"factor": factor, "shift": np.median(shifts[sound], axis=0)}


def chain_residuals(problem: ChainProblem, point: jax.Array, context: Any) -> jax.Array:
    """Return residuals whose squares sum to about twice a problem's objective near its minimum.

    The residuals belong to the penalties of limits, the snap energy and the durations. A penalty is
    max(excess, 0), smoothed over an interval of the excess from 0 to `hinge_width`. Its second
    derivative is at most 3 / (2 hinge_width). The residuals have this second derivative for every
    positive excess, which overestimates the curvature of clearly exceeded limits.

    Args:
        problem: problem of hits or catches.
        point: (n,), its decision variables.
        context: result of the problem's `prepare` for one case.
    """
    case, along = context.case, problem.along(problem.nodes, context.case)
    offsets, natural = problem.split(point)
    ends = problem.meet(natural, context)
    durations = ends.durations / problem.num_pieces
    rows = chain_rows(case.head_state, ends.tail_states, durations)
    chain = Chain(rows=rows, offsets=offsets, piece_durations=durations)
    active = problem.active(context)
    sample = functools.partial(sample_motion, problem.maps, problem.nodes, orders=along.orders)
    motion = jax.vmap(sample)(chain.columns, durations)
    excess = jnp.stack(limits_along(motion, (case.gravity, case.limits, case.extras)))
    excess = jnp.where(active[:, None], excess, -1.0)
    inside = jnp.maximum(excess + jnp.asarray(along.margins, point.dtype)[:, None, None], 0.0)
    inside = inside * jnp.sqrt(durations[:, None] * jnp.asarray(along.weights(), point.dtype))
    at_ends = jnp.sqrt(problem.end_weight) * jnp.maximum(ends.excess + problem.margin, 0.0)
    bend = jnp.sqrt(1.5 / problem.hinge_width)
    if problem.time_weight:
        energy = jax.vmap(functools.partial(trajectory_energy, problem.maps))
        energy = jnp.where(active, energy(rows, offsets, durations), 0.0)
        smooth = jnp.sqrt(2.0 * problem.energy_weight * jnp.maximum(energy, 1e-6))
    else:
        unit = jnp.sqrt(problem.energy_weight / durations ** (2 * problem.maps.order - 1))
        smooth = unit[:, None, None] * np.sqrt(problem.maps.offset_energy) * offsets
    spent = jnp.where(active, ends.durations, 1e-6)
    late = jnp.sqrt(2.0 * problem.time_weight * jnp.maximum(spent, 1e-6))
    parts = (bend * inside, bend * at_ends, smooth, late)
    return jnp.concatenate([part.ravel() for part in parts])


def draw_hard_serves(num: int, seed: int) -> pj.hit.HitCase:
    """Draw `num` hits of each of five hard kinds.

    The kinds are: planned 0.5 s late, planned 0.6 s late, limits multiplied by 0.5 and by 0.35, and
    random initial positions.
    """
    kinds = (
        functools.partial(pj.hit.to_cases, delay=0.5),
        functools.partial(pj.hit.to_cases, delay=0.6),
        functools.partial(pj.hit.to_cases, limit_scale=0.5),
        functools.partial(pj.hit.to_cases, limit_scale=0.35),
        functools.partial(pj.hit.to_cases, start="uniform"),
    )
    serves = pj.hit.generate_serves(num * len(kinds), seed)
    batches = [kind(serves[i * num : (i + 1) * num]) for i, kind in enumerate(kinds)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches)


def draw_weak_throws(num: int, seed: int) -> pj.catch.CatchCase:
    """Draw `num` throws of the suite `hard`, each with full limits and with limits times 0.8.

    The limits of speed and body rate are multiplied.
    """
    cases = first_choice(pj.catch.Greedy(), pj.catch.draw(num, "hard", seed))

    def weaker(factor: float) -> pj.catch.CatchCase:
        limits = cases.limits
        limits = dataclasses.replace(
            limits, speed=limits.speed * factor, body_rate=limits.body_rate * factor
        )
        return dataclasses.replace(cases, limits=limits)

    batches = [weaker(factor) for factor in (1.0, 0.8)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches)


def hit_problems() -> dict[str, Any]:
    """Return problems of hits with 6 and 12 pieces, whose scales are rough initial guesses.

    The keys "exact-6" and "exact-12" name the measured scales in `measured_scales.json`.
    """
    found = {}
    for pieces in HIT_PIECES:
        first = (0.2,) * (3 * (pieces - 1)) + _FIRST_HIT
        proportions = (0.2, 0.5) + (1.0,) * (pieces - 2)
        found[f"exact-{pieces}"] = pj.hit.HitProblem(proportions=proportions, scale=first)
    return found


def catch_problems() -> dict[str, Any]:
    """Return a problem of catches with 6 pieces, whose scales are rough initial guesses.

    The key "exact-6" names the measured scales in `measured_scales.json`.
    """
    found = {}
    for pieces in CATCH_PIECES:
        first = (0.3,) * (3 * (pieces - 1)) + _FIRST_CATCH
        proportions = (0.3,) + (1.0,) * (pieces - 1)
        found[f"exact-{pieces}"] = pj.catch.CatchProblem(proportions=proportions, scale=first)
    return found


# Task -> function that draws cases, function that creates problems, and options of `measure_scale`.
TASKS = {
    "hit": (draw_hard_serves, hit_problems, {}),
    "catch": (draw_weak_throws, catch_problems, {"floor": _CATCH_FLOOR}),
}


def measure(bench: Bench, task: str, num: int, seed: int) -> dict[str, np.ndarray]:
    """Measure the scales of the variables of a task's problems, and compare with shipped scales.

    `task` is "hit" or "catch". `num` and `seed` define the drawn cases. Returns the scales by
    the problem's name, such as "exact-6" for a trajectory of 6 pieces.
    """
    draw, problems, options = TASKS[task]
    cases, found = draw(num, seed), {}
    shipped = json.loads(locate_file(task).read_text("utf-8"))
    for name, problem in problems().items():
        scale = found[name] = measure_scale(problem, cases, chain_residuals, **options)
        bench.say(f"{task} {name} {np.array2string(scale, precision=3, max_line_width=100)}")
        ratio = None
        if name in shipped:
            ratio = np.exp(np.abs(np.log(scale / np.asarray(shipped[name]))).max())
            bench.say(f"  largest ratio to the shipped scale: {ratio:.2f}")
        again = dataclasses.replace(problem, scale=tuple(scale.tolist()))
        plans = pj.plan(pj.SearchPlanner(again), cases)
        success = task_named(task).judge(cases, plans).success
        bench.count(success)
        bench.say(f"  refereed success with the measured scale: {100 * success.mean():.2f} %")
        bench.row(task=task, name=name, scale=scale, ratio=ratio, success=success.mean())
    return found


def locate_file(task: str) -> Path:
    return Path(planner_jax.task.__path__[0]) / task / "measured_scales.json"


def main() -> None:
    parser = argument_parser("measure_scales", __doc__, num=100, seed=7)
    parser.add_argument("--write", action="store_true", help="replace the shipped files")
    parser.add_argument(
        "--tasks",
        nargs="+",
        choices=[*TASKS, "rally"],
        default=[*TASKS],
        help="default: %(default)s",
    )
    options = parser.parse_args()
    with begin(parser, options) as bench:
        for task in options.tasks:
            if task == "rally":
                cases = pj.rally.draw(options.num, seed=options.seed)
                metric = measure_metric(pj.rally.RallyProblem(metric=False), cases)
                path = locate_file(task).with_name("metric_exact-6.npz")
                bench.say(f"condition of the metric: {np.linalg.cond(metric['factor']):.1f}")
                if options.write:
                    factor, shift = (each.astype(np.float32) for each in metric.values())
                    np.savez_compressed(path, factor=factor, shift=shift)
                continue
            found = measure(bench, task, options.num, options.seed)
            if options.write:
                rounded = {
                    name: [float(f"{value:.3g}") for value in scale]
                    for name, scale in found.items()
                }
                path = locate_file(task)
                path.write_text(json.dumps(rounded, indent=1) + "\n", "utf-8")
                bench.say(f"wrote {path.name} of {task}")


if __name__ == "__main__":
    main()
