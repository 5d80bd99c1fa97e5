"""Measure the speed of the environment in which catching policies are trained, in steps per second.

    python -m benchmarks.environment_speed [--suite triangle3] [--iterations 25] [--lanes 16384]
        [--steps 20] [--out DIR]

A policy decides in which order and when a quadrotor catches several balls. It is trained in the
environment `CatchEnv`, a batch of --lanes catching problems. In each step, an action of the policy
sets order and times for each problem, and the planner plans with this decision. The step returns
rewards, the next problems and their observations. Here actions are random, with a standard
deviation of 0.1 in a range from -1 to 1, similar to a policy in training.

A run is one compiled loop of --steps steps, and the fastest of three runs after a first run counts.
The program also prints the share of plans that keep all limits after --iterations iterations. The
planner itself checks the limits, because a step stores no plans that could be judged independently.
"""

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp

from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.policies.environment import CatchEnv
from planner_jax.task.catch.spec import SUITES


def measure(bench: Bench, options: argparse.Namespace) -> None:
    """Time steps of the environment `CatchEnv`; print steps/s and the share of solved plans."""
    env = CatchEnv((options.suite,), (options.iterations,))
    keys = jax.random.split(jax.random.key_data(jax.random.key(options.seed)), options.lanes)

    def one(state: Any, key: Any) -> tuple[Any, Any]:
        action = 0.1 * jax.random.normal(key, (options.lanes, env.action_size))
        state = env.step(state, jnp.clip(action, -1.0, 1.0))
        return state, jnp.mean(state.info["episode_metrics"]["solved"])

    @jax.jit
    def steps(state: Any, key: Any) -> tuple[Any, Any]:
        return jax.lax.scan(one, state, jax.random.split(key, options.steps))

    state = jax.jit(env.reset)(keys)
    began = time.perf_counter()
    compiled = steps.lower(state, jax.random.key(1)).compile()
    compiling = time.perf_counter() - began
    seconds, shares = [], []
    for turn in range(4):
        began = time.perf_counter()
        state, solved = jax.block_until_ready(compiled(state, jax.random.key(turn)))
        seconds.append(time.perf_counter() - began)
        shares.append(float(solved.mean()))
    speed = options.steps * options.lanes / min(seconds[1:])
    share = shares[-1]
    bench.row(suite=options.suite, per_second=speed, solved=share, compiling=compiling)
    bench.note(per_second=speed, solved=share)
    bench.say(
        f"{options.suite}, {options.iterations} iterations, {options.lanes:,} lanes, "
        f"{jax.devices()[0].device_kind}: {speed:,.0f} steps/s, {100.0 * share:.1f} % of plans "
        f"solved; compiled in {compiling:.1f} s"
    )


def main() -> None:
    parser = argument_parser(
        "environment_speed", __doc__, iterations=25, lanes=16_384, steps=20, seed=0
    )
    parser.add_argument("--suite", default="triangle3", choices=SUITES, help="default: triangle3")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        measure(bench, options)


if __name__ == "__main__":
    main()
