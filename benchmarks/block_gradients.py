"""Compare gradients of blocks' contact times with differences of plans that are searched anew.

    python -m benchmarks.block_gradients [--num 100] [--suite pole] [--seed 31] [--out DIR]

`pj.gradient` differentiates the contact time by the ball's initial position. The reference moves
the ball by 0.1 mm and by 0.01 mm along a random direction, forwards and backwards, and minimises
the cost again in float64, from the same plan. The error is relative, by the nearer of the two
differences. The table has the number of solved cases, and how many of these have a gradient.
"""

import dataclasses
import time

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.planning.gradient import with_type
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.plan import BlockPlan

_STEPS = (1e-4, 1e-5)  # [m]


def differences(planner: OnlineBlock, cases: BlockCase, plans: BlockPlan, away: np.ndarray) -> list:
    """Return for each of `_STEPS` the derivatives (B,) of the contact time along `away` (3,)."""
    with jax.enable_x64(True):
        smooth, started = planner.settle(with_type(cases, np.float64), lambda *_: plans)
        long = dataclasses.replace(smooth.problem.solver, max_steps=400, settled=20)
        smooth = pj.SearchPlanner(dataclasses.replace(smooth.problem, solver=long))
        started = with_type(started, np.float64)

        def contact(step: float) -> np.ndarray:
            ball = started.ball.replace(pos=started.ball.pos + step * away)
            return np.asarray(pj.plan(smooth, started.replace(ball=ball)).contact_time)

        return [(contact(step) - contact(-step)) / (2.0 * step) for step in _STEPS]


def main() -> None:
    parser = argument_parser("block_gradients", __doc__, num=100, seed=31)
    parser.add_argument("--suite", default="pole", help="default: pole")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        planner = OnlineBlock()
        cases = pj.block.draw(options.num, options.suite, options.seed)
        began = time.process_time()
        found = pj.gradient(planner, cases, of="contact_time", by="ball.pos")
        first = time.process_time() - began
        away = np.random.default_rng(options.seed).normal(size=3)
        slope = np.asarray(found.by["ball.pos"], np.float64) @ away
        expected = differences(planner, cases, pj.plan(planner, cases), away)
        errors = np.min([np.abs(slope - each) / np.abs(each) for each in expected], axis=0)
        solved = pj.are_solved(found.plans)
        counted = errors[solved & np.isfinite(slope)]
        quantiles = np.quantile(counted, (0.5, 0.9, 1.0))
        bench.say(
            f"{options.num} cases: {solved.sum()} solved, {counted.size} of them with a gradient; "
            f"first call {first:.0f} CPU s",
            f"relative error: median {quantiles[0]:.1e}, 90 % {quantiles[1]:.1e}, greatest "
            f"{quantiles[2]:.1e}; at most 5e-3 in {np.sum(counted <= 5e-3)} cases",
        )
        bench.note(errors=counted.tolist(), first_cpu_seconds=first)


if __name__ == "__main__":
    main()
