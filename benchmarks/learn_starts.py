"""Train the networks that propose initial guesses of hits and catches, and measure their effect.

    python -m benchmarks.learn_starts [--tasks hit hard-hit catch] [--train MINUTES] [--num 1000]
        [--out DIR]

A network maps the numbers of a case to a correction of the planner's initial guess. Training
minimises the mean logarithm of the planner's objective at the guess, over batches from a large pool
of cases. Half of the cases are drawn like the cases of other benchmarks. The other half has random
initial states (some of them moving), limits, balls, rackets or nets, and targets.

The task `hard-hit` has a network of its own, for a trajectory with velocities at the waypoints as
additional variables. Its cases are serves planned 0.5 to 0.88 s late, or with limits multiplied by
0.29 to 0.5. Many of them are infeasible.

With --train the networks are trained and the shipped files are replaced. The printed table compares
plans with and without the network after several numbers of iterations, on cases that no network was
trained on. It has the cost above the minimum that very long searches find, and the share of plans
that keep every limit.
"""

import argparse
import dataclasses
import functools
import io
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

import planner_jax as pj
import planner_jax.task
from planner_jax.benchmarks.cost_gap import with_long_search
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.optimise.shipped import StartNetwork
from planner_jax.planning.decided import first_choice
from planner_jax.task.hit.default_planner import WITH_VELOCITIES
from planner_jax.task.hit.suites import GRAVITY

_POOL = 262_144  # Number of cases that are drawn once, from which all training batches are sampled.
_BATCH = 8192  # Number of cases in a training batch.
_RATE = 2e-3  # Initial learning rate of Adam, which decays to zero along a cosine.
_SEED_APART = 90_001  # Seed of the cases in the printed table. No network is trained on them.
_STEPS = 50  # Number of Adam steps in one compiled call.
_ITERATIONS = (0, 3, 5, 7, 12, 20)  # Numbers of planner iterations in the printed table.
_CHUNKS = 64  # Number of parts of the hard hits. A part has one delay, or one factor of limits.


def _draw_factors(random: np.random.Generator, num: int, low: float, high: float) -> np.ndarray:
    """Draw factors (num,) whose logarithms are uniform between log(low) and log(high)."""
    return np.exp(random.uniform(np.log(low), np.log(high), num))


def _add_motion(random: np.random.Generator, head: Any) -> Any:
    """Add random velocity, acceleration and jerk to half of B initial states.

    A state (4, 3) has position, velocity, acceleration and jerk.
    """
    num = len(head)
    sizes = np.array([1.5, 3.0, 15.0])[:, None] * random.uniform(size=(num, 1, 1))
    moving = random.uniform(size=(num, 1, 1)) < 0.5
    head = np.array(head, np.float32)
    head[:, 1:] += np.where(moving, sizes * random.normal(size=(num, 3, 3)), 0.0)
    return head


def draw_hits(num: int, seed: int) -> pj.hit.HitCase:
    """Draw `num` training cases of hits: usual serves, and as many with varied numbers.

    Initial states, balls, rackets, targets and limits are varied.
    """
    random, half = np.random.default_rng(seed), num // 2
    plain = pj.hit.draw(num - half, seed=seed)
    varied = pj.hit.draw(half, seed=seed + 1)
    limits, stroke = varied.limits, varied.hit_limits
    factor = functools.partial(_draw_factors, random, half)
    scale = factor(0.4, 1.6)
    late = random.uniform(size=half) < 0.4
    ball = jax.tree.map(np.asarray, varied.ball)
    delay = np.where(late, random.uniform(0.0, 0.7, half), 0.0)[:, None]
    head = _add_motion(random, varied.head_state)
    head[:, 0] += random.normal(size=(half, 3)) * (0.6, 0.6, 0.25)
    fall = np.array([0.0, 0.0, -GRAVITY])
    varied = dataclasses.replace(
        varied,
        ball=dataclasses.replace(
            ball,
            pos=ball.pos + delay * ball.vel + 0.5 * delay**2 * fall,
            vel=ball.vel + delay * fall,
        ),
        head_state=head,
        target=varied.target + random.normal(size=(half, 3)) * (0.8, 0.8, 0.0),
        drag=varied.drag * random.uniform(0.0, 1.5, half),
        restitution=random.uniform(0.6, 0.95, half),
        racket_height=random.uniform(0.0, 0.2, half),
        limits=dataclasses.replace(
            limits,
            speed=limits.speed * scale * factor(0.8, 1.25),
            acceleration=limits.acceleration * scale * factor(0.8, 1.25),
            body_rate=limits.body_rate * scale * factor(0.8, 1.25),
        ),
        hit_limits=dataclasses.replace(
            stroke, hitting_speed=stroke.hitting_speed * factor(0.7, 1.5)[:, None]
        ),
    )
    return _concatenate(plain, varied)


def draw_hard_hits(num: int, seed: int) -> pj.hit.HitCase:
    """Draw `num` training cases of hard hits.

    Half are planned 0.5 to 0.88 s late; in the other half limits are multiplied by 0.29 to 0.5.
    """
    random, serves = np.random.default_rng(seed), pj.hit.generate_serves(num, seed)
    parts = []
    for k, rows in enumerate(np.array_split(np.arange(num), _CHUNKS)):
        if k % 2 == 0:
            options: dict[str, Any] = {"delay": random.uniform(0.5, 0.88)}
        else:
            options = {"limit_scale": random.uniform(0.29, 0.5)}
        parts.append(pj.hit.to_cases(serves[rows], **options))
    return _concatenate(*parts)


def draw_catches(num: int, seed: int) -> pj.catch.CatchCase:
    """Draw `num` training cases of catches: usual throws, and as many with varied numbers.

    All are from the suites `throws` and `hard`, with estimates of the earliest catching times. The
    second half has varied initial states, catching times, nets and limits.
    """
    random, half = np.random.default_rng(seed), num // 2

    def draw_usual(num: int, seed: int) -> Any:
        suites = [
            pj.catch.draw(n, s, seed) for n, s in ((num // 2, "throws"), (num - num // 2, "hard"))
        ]
        return first_choice(pj.catch.Greedy(), _concatenate(*suites))

    plain, varied = draw_usual(num - half, seed), draw_usual(half, seed + 1)
    limits, net = varied.limits, varied.net
    factor = functools.partial(_draw_factors, random, half)
    scale = factor(0.6, 1.5)
    head = _add_motion(random, varied.head_state)
    head[:, 0] += random.normal(size=(half, 3)) * (0.5, 0.5, 0.2)
    varied = dataclasses.replace(
        varied,
        head_state=head,
        times=varied.times * factor(0.9, 1.3)[:, None],
        net=dataclasses.replace(
            net,
            height=net.height * factor(0.5, 1.5),
            radius=net.radius * factor(0.5, 1.5),
            max_angle=net.max_angle * factor(0.6, 1.6),
        ),
        limits=dataclasses.replace(
            limits,
            speed=limits.speed * scale,
            body_rate=limits.body_rate * scale * factor(0.8, 1.25),
        ),
    )
    return _concatenate(plain, varied)


def _concatenate(*batches: Any) -> Any:
    return jax.tree.map(
        lambda *parts: np.concatenate([np.asarray(p) for p in parts]).astype(parts[0].dtype),
        *batches,
    )


@dataclasses.dataclass(frozen=True)
class _NetworkSpec:
    """A network that corrects a planner's initial guess: its training cases, file and sizes.

    Plans with and without the network are compared on other cases.
    """

    file: str  # path of the shipped file, below the folder of planner_jax.task
    draw: Callable[[int, int], Any]  # draws training cases: (number, seed) -> cases
    planner: Any  # planner without the network
    usual: Callable[[int, int], Any]  # draws cases for the printed table: (number, seed) -> cases
    hidden: tuple[int, ...] = (128, 128)  # widths of the hidden layers
    # Training minimises the mean of log(cost + floor), so differences between costs far below the
    # floor have no effect.
    floor: float = 0.0
    iterations: tuple[int, ...] = _ITERATIONS  # numbers of planner iterations in the printed table


def _draw_throws(num: int, seed: int) -> Any:
    return first_choice(pj.catch.Greedy(), pj.catch.draw(num, "throws", seed))


TASKS = {
    "hit": _NetworkSpec(
        "hit/start_exact-12.npz",
        draw_hits,
        pj.hit.HitProblem.planner(learned=False),
        lambda num, seed: pj.hit.draw(num, seed=seed),
    ),
    "hard-hit": _NetworkSpec(
        "hit/start_exact-12-supple.npz",
        draw_hard_hits,
        pj.hit.HitProblem.planner(learned=False).with_settings(WITH_VELOCITIES),
        draw_hard_hits,
        hidden=(160, 160),
        floor=3e-5,
        iterations=(0, 20, 60, 150),
    ),
    "catch": _NetworkSpec(
        "catch/start_exact-6.npz",
        draw_catches,
        pj.catch.CatchProblem.planner(learned=False),
        _draw_throws,
    ),
}


def make_untrained(
    features: np.ndarray, outputs: int, hidden: tuple[int, ...], seed: int = 0
) -> StartNetwork:
    """Return an untrained network, whose output is zero: no correction of the planner's guess.

    Args:
        features: (B, F), F inputs for each of B cases. Their mean and standard deviation scale the
            inputs.
        outputs: number of outputs.
        hidden: widths of the hidden layers.
        seed: seed of the random weights.
    """
    random = np.random.default_rng(seed)
    sizes = (features.shape[-1], *hidden, outputs)
    weights = [
        random.normal(size=(a, b)) / math.sqrt(a) for a, b in zip(sizes, sizes[1:], strict=False)
    ]
    weights[-1] *= 0.0
    return StartNetwork(
        mean=features.mean(axis=0),
        deviation=np.maximum(features.std(axis=0), 1e-3),
        weights=tuple(each.astype(np.float32) for each in weights),
        biases=tuple(np.zeros(size, np.float32) for size in sizes[1:]),
    )


def to_bytes(network: StartNetwork) -> bytes:
    """Return a network as a compressed archive, with weight matrices in half precision."""
    arrays = {"mean": network.mean, "deviation": network.deviation}
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        arrays |= {f"weight{k}": weight, f"bias{k}": bias}
    file = io.BytesIO()
    rounded: Any = {
        name: np.asarray(array).astype(np.float32 if array.ndim == 1 else np.float16)
        for name, array in arrays.items()
    }
    np.savez_compressed(file, **rounded)
    return file.getvalue()


def train(
    spec: _NetworkSpec, minutes: float, seed: int, say: Callable[[str], None]
) -> StartNetwork:
    """Train a network that corrects the planner's initial guess, on a pool of drawn cases.

    The training takes `minutes`, and `say` prints its progress.
    """
    problem = spec.planner.problem
    pool = jax.device_put(jax.tree.map(jnp.asarray, spec.draw(_POOL, seed)))
    prepare = jax.jit(jax.vmap(problem.prepare))
    few = prepare(jax.tree.map(lambda leaf: leaf[:16_384], pool))
    features = np.asarray(jax.jit(jax.vmap(problem.start_features))(few), np.float64)
    network = make_untrained(features, len(problem.scale), spec.hidden)
    params = jax.tree.map(jnp.asarray, (network.weights, network.biases))

    def loss(params: Any, cases: Any) -> Any:
        own = dataclasses.replace(network, weights=params[0], biases=params[1])

        def of_case(case: Any) -> Any:
            context = problem.prepare(case)
            guess = problem.guesses(context, 1)[0] + own(problem.start_features(context))
            return jnp.log(problem.objective(guess, context).cost + spec.floor)

        logs = jax.vmap(of_case)(cases)
        return jnp.mean(jnp.where(jnp.isfinite(logs), logs, 20.0))

    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())
    state = optimiser.init(params)

    @jax.jit
    def steps(params: Any, state: Any, key: Any, rate: Any) -> Any:
        def one(carry: Any, key: Any) -> Any:
            params, state = carry
            lanes = jax.random.randint(key, (_BATCH,), 0, _POOL)
            value, slope = jax.value_and_grad(loss)(params, jax.tree.map(lambda x: x[lanes], pool))
            slope = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, 0.0), slope)
            update, state = optimiser.update(slope, state)
            params = jax.tree.map(lambda p, u: p - rate * u, params, update)
            return (params, state), value

        (params, state), values = jax.lax.scan(one, (params, state), jax.random.split(key, _STEPS))
        return params, state, jnp.mean(values)

    key, began, share, calls, value = jax.random.key(seed), None, 0.0, 0, np.nan
    while share < 1.0:
        key, own = jax.random.split(key)
        rate = _RATE * 0.5 * (1.0 + np.cos(np.pi * share))
        params, state, value = steps(params, state, own, rate)
        value.block_until_ready()
        began = began or time.perf_counter()  # The first call, which compiles, is not timed.
        calls += 1
        share = min((time.perf_counter() - began) / (60.0 * minutes), 1.0)
        if calls % 20 == 1:
            say(f"{calls * _STEPS:,} steps, mean log cost {float(value):.4f}")
    say(f"{calls * _STEPS:,} steps, mean log cost {float(value):.4f}")
    return dataclasses.replace(
        network, weights=jax.device_get(params[0]), biases=jax.device_get(params[1])
    )


def compare(bench: Bench, task: str, num: int) -> None:
    """Compare plans from initial guesses with and without the shipped network, on `num` cases."""
    spec = TASKS[task]
    cases = jax.tree.map(np.asarray, spec.usual(num, _SEED_APART))
    planners = {
        "smooth": spec.planner,
        "learned": spec.planner.with_settings((("learned", True),)),
    }
    best = np.minimum(*(pj.plan(with_long_search(each), cases).cost for each in planners.values()))
    bench.say(
        f"{task}: {num:,} cases",
        "| guess | iterations | limits hold | cost above the minimum found (median, p90, p99) |",
        "|---|---:|---:|---|",
    )
    holds = np.zeros(0, bool)
    for iterations in spec.iterations:
        for name, planner in planners.items():
            plans = pj.plan(planner.with_solver(pj.LbfgsConfig(max_steps=iterations)), cases)
            holds = pj.are_solved(plans)
            quantiles = np.quantile(plans.cost / best - 1.0, (0.5, 0.9, 0.99))
            text = ", ".join(f"{100.0 * each:.2f} %" for each in quantiles)
            bench.say(f"| {name} | {iterations} | {100.0 * holds.mean():.2f} % | {text} |")
            bench.row(
                task=task,
                guess=name,
                iterations=iterations,
                feasible=holds.mean(),
                gap_median=quantiles[0],
                gap_p90=quantiles[1],
                gap_p99=quantiles[2],
            )
    bench.count(holds)


def locate_file(task: str) -> Path:
    return Path(planner_jax.task.__path__[0]) / TASKS[task].file


def main() -> None:
    parser = argument_parser("learn_starts", __doc__, num=1000, seed=11)
    parser.add_argument(
        "--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="default: all"
    )
    parser.add_argument("--only-train", action="store_true", help="train only, without the table")
    parser.add_argument(
        "--train",
        type=float,
        metavar="MINUTES",
        help="train this long, and replace the shipped files",
    )
    options: argparse.Namespace = parser.parse_args()
    with begin(parser, options) as bench:
        for task in options.tasks:
            if options.train:
                network = train(TASKS[task], options.train, options.seed, bench.say)
                locate_file(task).write_bytes(to_bytes(network))
                bench.say(f"wrote {locate_file(task).name}")
            if not options.only_train:
                compare(bench, task, options.num)


if __name__ == "__main__":
    main()
