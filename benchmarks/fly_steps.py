"""Measure simulated physics steps per second in MJX, for batches of a quadrotor with one ball.

    python -m benchmarks.fly_steps [--worlds 4096,65536] [--seconds 0.4]

A world is one simulated quadrotor and one ball, and a batch has many worlds. Two simulations are
measured. The open loop computes the physics alone, with constant rotor thrusts. The closed loop is
a whole flight: observations, Kalman filter, reference, control, physics and contact. Its plan is
computed before and not changed in flight. A step covers 2 ms of simulated time. If the package
crazyflow is installed, its first-principles quadrotor without a ball is measured too. Compile time
is reported separately.
"""

import argparse
import dataclasses
import importlib
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.planning.plan import plan
from planner_jax.sims.launch import launch_ball, ready
from planner_jax.sims.loop import fly_leg
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.model import World, at_rest, step
from planner_jax.sims.noise import NOISES
from planner_jax.sims.tasks.catch import CATCH_WORLD, SEEN, throws
from planner_jax.sims.tasks.catch_ahead import predict_case, with_catch
from planner_jax.sims.tasks.catch_pilot import CatchPilot
from planner_jax.task import catch
from planner_jax.task.catch.case import START

RUNS = 3


def report_speed(name: str, steps: int, run: Callable[[], Any]) -> None:
    """Run a simulation several times; print the speed of the fastest run, and the compile time.

    `steps` is the number of physics steps that one call of `run` computes, summed over all
    simulated quadrotors.
    """
    began = time.perf_counter()
    jax.block_until_ready(run())
    first = time.perf_counter() - began
    seconds = []
    for _ in range(RUNS):
        began = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - began)
    print(
        f"{name}: {steps / min(seconds):.3g} steps/s ({min(seconds):.3f} s, "
        f"slowest of {RUNS} {max(seconds):.3f} s; first, with compilation, {first:.1f} s)",
        flush=True,
    )


def measure_open_loop(world: World, worlds: int, steps: int) -> None:
    """Report steps per second of the physics alone, with constant rotor thrusts.

    `world` is the model of one quadrotor with one ball; `worlds` copies are simulated in a batch.
    """
    start = at_rest(world, jnp.array(START))
    start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (worlds, *leaf.shape)), start)
    drag = jnp.zeros(1)

    @jax.jit
    @jax.vmap
    def run(physics: Any) -> Any:
        rotors = physics.act
        advance = lambda state, _: (step(world, state, rotors, drag), None)  # noqa: E731
        return jax.lax.scan(advance, physics, None, length=steps)[0]

    report_speed(f"open loop, {worlds} worlds", worlds * steps, lambda: run(start))


def measure_closed_loop(world: World, worlds: int, seconds: float) -> None:
    """Report physics steps per second of closed-loop flights, which follow one plan each.

    The time does not include planning. `worlds` flights are simulated in a batch, `seconds` of
    simulated time each. `world` is the model of one quadrotor with one ball.
    """
    loop = Loop(world, NOISES["lab"])
    few = min(worlds, 256)  # Number of different throws, which are repeated to fill the batch.
    cases = throws(few)
    drag, guess = jnp.asarray(cases.drag), jnp.asarray(cases.believed)
    starts = jnp.tile(jnp.array(START), (few, 1))
    flight = ready(loop, starts, jax.random.split(jax.random.key(0), few))
    balls = jax.tree.map(jnp.asarray, cases.balls)
    flight = launch_ball(loop, flight, balls, drag, guess, ball=0, seen=SEEN)
    known = predict_case(loop, flight, jnp.array([True]), jnp.asarray(cases.horizon))
    plans = plan(catch.planner(), jax.tree.map(np.asarray, known))
    on_device = jax.tree.map(jnp.asarray, plans)
    flight = with_catch(flight, on_device, jnp.ones((few, 1), bool)).replace(key=None)
    many = lambda leaf: jnp.resize(leaf, (worlds, *leaf.shape[1:]))  # noqa: E731
    keys = jax.random.split(jax.random.key(1), worlds)
    flight = dataclasses.replace(jax.tree.map(many, flight), key=keys)
    known, drag = jax.tree.map(many, (known, drag))
    periods = loop.num_periods(seconds)
    steps = worlds * periods * loop.observations_per_plan * loop.steps_per_observation
    run = lambda: fly_leg(loop, CatchPilot(), flight, known, drag, num_periods=periods)  # noqa: E731
    report_speed(f"closed loop, {worlds} worlds", steps, lambda: run()[0].physics)


def measure_crazyflow(worlds: int, steps: int) -> None:
    """Report steps per second of the simulator crazyflow, if it is installed."""
    os.environ.setdefault("SCIPY_ARRAY_API", "1")
    try:
        peer: Any = importlib.import_module("crazyflow.sim")
    except ImportError as error:
        print(f"crazyflow: not measured ({error})")
        return
    sim = peer.Sim(n_worlds=worlds, n_drones=1, freq=500, device=jax.default_backend())
    sim.reset()

    def run() -> Any:
        sim.step(steps)
        return sim.data.states.pos

    report_speed(f"crazyflow, {worlds} worlds, no ball", worlds * steps, run)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    default = "256" if jax.default_backend() == "cpu" else "4096,65536"
    parser.add_argument("--worlds", default=default, help=f"batch sizes; default: {default}")
    parser.add_argument(
        "--seconds", type=float, default=0.4, help="simulated time of each flight [s]; default: 0.4"
    )
    args = parser.parse_args()
    world = CATCH_WORLD
    steps = round(args.seconds / world.timestep)
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}, {steps} steps of 2 ms a world")
    for worlds in [int(number) for number in args.worlds.split(",")]:
        measure_open_loop(world, worlds, steps)
        measure_closed_loop(world, worlds, args.seconds)
        measure_crazyflow(worlds, steps)


if __name__ == "__main__":
    main()
