"""Train the networks that make the first guesses of hits and catches, and look what they are worth.

    python -m benchmarks.learn_starts [--tasks hit hard-hit catch] [--train MINUTES] [--num 1000]
        [--out DIR]

Trained on the planner's own objective: the mean logarithm of the cost at the guess goes down, over
batches from a large pool of cases. Half of them are of the usual suites; in the others start,
limits, ball, racket or net and target are anything sensible, moving starts among them. Those of
`hard-hit`, with velocities at the waypoints, are of serves planned for 0.5 to 0.88 s late, or with
0.29 to 0.5 of the limits, many of which nobody can hit. --train does so, and replaces the shipped
files. Prints the cost above the least that very long searches find,
and how many hold every limit, after so many iterations from the guess with the network and without
it, on cases that no network has seen.
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
from planner_jax.benchmarks.cost_gap import to_the_optimum
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.optimise.shipped import StartNetwork
from planner_jax.planning.decided import first_choice
from planner_jax.task.hit.default_planner import WITH_VELOCITIES

_POOL = 262_144  # cases that are drawn at first, and taken in another order again and again
_BATCH = 8192
_RATE = 2e-3  # of Adam at first; it falls to nothing along a cosine
_SEED_APART = 90_001  # of cases that no network has seen
_STEPS = 50  # a call
_ITERATIONS = (0, 3, 5, 7, 12, 20)
_CHUNKS = 64  # of hard hits, each with a delay or limits of its own


def _varied(random: np.random.Generator, num: int, low: float, high: float) -> np.ndarray:
    """Factors between two numbers, evenly by their logarithm, (num,)."""
    return np.exp(random.uniform(np.log(low), np.log(high), num))


def _moving(random: np.random.Generator, head: Any) -> Any:
    """Head states (B, 4, 3), half of them not at rest."""
    num = len(head)
    sizes = np.array([1.5, 3.0, 15.0])[:, None] * random.uniform(size=(num, 1, 1))
    moving = random.uniform(size=(num, 1, 1)) < 0.5
    head = np.array(head, np.float32)
    head[:, 1:] += np.where(moving, sizes * random.normal(size=(num, 3, 3)), 0.0)
    return head


def hits(num: int, seed: int) -> pj.hit.HitCase:
    """Half of them as `pj.hit.draw` makes them, half varied."""
    random, half = np.random.default_rng(seed), num // 2
    plain = pj.hit.draw(num - half, seed=seed)
    varied = pj.hit.draw(half, seed=seed + 1)
    limits, stroke = varied.limits, varied.hit_limits
    factor = functools.partial(_varied, random, half)
    scale = factor(0.4, 1.6)
    late = random.uniform(size=half) < 0.4
    ball = jax.tree.map(np.asarray, varied.ball)
    delay = np.where(late, random.uniform(0.0, 0.7, half), 0.0)[:, None]
    head = _moving(random, varied.head_state)
    head[:, 0] += random.normal(size=(half, 3)) * (0.6, 0.6, 0.25)
    fall = np.array([0.0, 0.0, -9.8])
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
    return _joined(plain, varied)


def hard_hits(num: int, seed: int) -> pj.hit.HitCase:
    """Half of them planned late, half with weak limits."""
    random, serves = np.random.default_rng(seed), pj.hit.generate_serves(num, seed)
    parts = []
    for k, rows in enumerate(np.array_split(np.arange(num), _CHUNKS)):
        if k % 2 == 0:
            options: dict[str, Any] = {"delay": random.uniform(0.5, 0.88)}
        else:
            options = {"limit_scale": random.uniform(0.29, 0.5)}
        parts.append(pj.hit.to_cases(serves[rows], **options))
    return _joined(*parts)


def catches(num: int, seed: int) -> pj.catch.CatchCase:
    """Half of them of the suites `throws` and `hard` in the greedy order, half varied."""
    random, half = np.random.default_rng(seed), num // 2

    def drawn(num: int, seed: int) -> Any:
        suites = [
            pj.catch.draw(n, s, seed) for n, s in ((num // 2, "throws"), (num - num // 2, "hard"))
        ]
        return first_choice(pj.catch.Greedy(), _joined(*suites))

    plain, varied = drawn(num - half, seed), drawn(half, seed + 1)
    limits, net = varied.limits, varied.net
    factor = functools.partial(_varied, random, half)
    scale = factor(0.6, 1.5)
    head = _moving(random, varied.head_state)
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
    return _joined(plain, varied)


def _joined(*batches: Any) -> Any:
    return jax.tree.map(
        lambda *parts: np.concatenate([np.asarray(p) for p in parts]).astype(parts[0].dtype),
        *batches,
    )


@dataclasses.dataclass(frozen=True)
class _Learnt:
    """A network to train."""

    file: str  # below planner_jax.task
    draw: Callable[[int, int], Any]
    planner: Any  # without the network
    usual: Callable[[int, int], Any]  # cases of the usual suite
    hidden: tuple[int, ...] = (128, 128)
    floor: float = 0.0  # added to a cost, so that little is gained where it is far below
    iterations: tuple[int, ...] = _ITERATIONS


def _throws(num: int, seed: int) -> Any:
    return first_choice(pj.catch.Greedy(), pj.catch.draw(num, "throws", seed))


TASKS = {
    "hit": _Learnt(
        "hit/start_exact-12.npz",
        hits,
        pj.hit.ExactHit(learned=False),
        lambda num, seed: pj.hit.draw(num, seed=seed),
    ),
    "hard-hit": _Learnt(
        "hit/start_exact-12-supple.npz",
        hard_hits,
        pj.hit.ExactHit(learned=False).with_settings(WITH_VELOCITIES),
        hard_hits,
        hidden=(160, 160),
        floor=3e-5,
        iterations=(0, 20, 60, 150),
    ),
    "catch": _Learnt(
        "catch/start_exact-6.npz",
        catches,
        pj.catch.ExactCatch(learned=False),
        _throws,
    ),
}


def make_untrained(
    features: np.ndarray, outputs: int, hidden: tuple[int, ...], seed: int = 0
) -> StartNetwork:
    """Return a network that adds nothing yet, for features (B, F) of a batch of cases."""
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
    """Return a network as an archive of arrays in half precision, which is more than it knows."""
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


def train(learnt: _Learnt, minutes: float, seed: int, say: Callable[[str], None]) -> StartNetwork:
    """The network, after so much time."""
    planner = learnt.planner
    pool = jax.device_put(jax.tree.map(jnp.asarray, learnt.draw(_POOL, seed)))
    prepare = jax.jit(jax.vmap(planner.prepare))
    few = prepare(jax.tree.map(lambda leaf: leaf[:16_384], pool))
    features = np.asarray(jax.jit(jax.vmap(planner.start_features))(few), np.float64)
    network = make_untrained(features, len(planner.scale), learnt.hidden)
    params = jax.tree.map(jnp.asarray, (network.weights, network.biases))

    def loss(params: Any, cases: Any) -> Any:
        own = dataclasses.replace(network, weights=params[0], biases=params[1])

        def of_case(case: Any) -> Any:
            context = planner.prepare(case)
            guess = planner.guesses(context, 1)[0] + own(planner.start_features(context))
            return jnp.log(planner.objective(guess, context).cost + learnt.floor)

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
        began = began or time.perf_counter()  # the first call compiles
        calls += 1
        share = min((time.perf_counter() - began) / (60.0 * minutes), 1.0)
        if calls % 20 == 1:
            say(f"{calls * _STEPS:,} steps, mean log cost {float(value):.4f}")
    say(f"{calls * _STEPS:,} steps, mean log cost {float(value):.4f}")
    return dataclasses.replace(
        network, weights=jax.device_get(params[0]), biases=jax.device_get(params[1])
    )


def compare(bench: Bench, task: str, num: int) -> None:
    """What the shipped network is worth, a row for each number of iterations."""
    learnt = TASKS[task]
    cases = jax.tree.map(np.asarray, learnt.usual(num, _SEED_APART))
    planners = {
        "smooth": learnt.planner,
        "learned": dataclasses.replace(learnt.planner, learned=True),
    }
    best = np.minimum(*(pj.plan(to_the_optimum(each), cases).cost for each in planners.values()))
    bench.say(
        f"{task}: {num:,} cases",
        "| guess | iterations | limits hold | cost above the least found (median, p90, p99) |",
        "|---|---:|---:|---|",
    )
    holds = np.zeros(0, bool)
    for iterations in learnt.iterations:
        for name, planner in planners.items():
            plans = pj.plan(planner.with_solver(pj.LbfgsConfig(max_steps=iterations)), cases)
            holds = pj.solved(plans)
            quantiles = np.quantile(plans.cost / best - 1.0, (0.5, 0.9, 0.99))
            told = ", ".join(f"{100.0 * each:.2f} %" for each in quantiles)
            bench.say(f"| {name} | {iterations} | {100.0 * holds.mean():.2f} % | {told} |")
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


def shipped_file(task: str) -> Path:
    """Where the network of a task is kept."""
    return Path(planner_jax.task.__path__[0]) / TASKS[task].file


def main() -> None:
    """Train, if asked to, and compare."""
    parser = argument_parser("learn_starts", __doc__, num=1000, seed=11)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--only-train", action="store_true", help="print no table")
    parser.add_argument("--train", type=float, metavar="MINUTES", help="make the files anew")
    options: argparse.Namespace = parser.parse_args()
    with begin(parser, options) as bench:
        for task in options.tasks:
            if options.train:
                network = train(TASKS[task], options.train, options.seed, bench.say)
                shipped_file(task).write_bytes(to_bytes(network))
                bench.say(f"wrote {shipped_file(task).name}")
            if not options.only_train:
                compare(bench, task, options.num)


if __name__ == "__main__":
    main()
