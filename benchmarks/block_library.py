"""Measure the library of stored block motions: build, coverage, lookups, and blocked balls.

    python -m benchmarks.block_library [--library FILE] [--layout B] [--regime R2] [--num 2000]
        [--queries 20000] [--batch 1048576] [--shift -0.1] [--skip-repair] [--out DIR]

A robot arm blocks balls with a shield. Two boxes, one inside the other, stand around the region
that the arm protects. Their faces are divided into rectangular cells. The library stores a motion
for each pair of an outer and an inner cell. The tunnel of a pair is the space between its two
cells. Without --library a library is built first, for the joint limits --regime and the division of
the faces into cells --layout. Then the program reports:
* coverage: the share of pairs with a motion, among the pairs that a ball can pass through;
* random balls through the tunnels of stored motions: the share that is blocked, according to the
  referee, an independent check in float64;
* balls of the suites `pole` and `short`, drawn with a seed that no tuning used: the share that is
  blocked if the arm may start 0 or 0.133 s after it sees the ball;
* the time to look up the motion for one ball on the CPU, from and to NumPy arrays;
* the number of balls per second that the default device looks up in a batch. The table of motions
  is an argument of the compiled program, so that the compiler cannot precompute parts;
* a repair, after a pole in front of the arm has moved by --shift along y: the time to plan again
  all motions that collide with it, and how many motions the referee then rejects.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

import planner_jax as pj
from planner_jax.ball.flight import BallState
from planner_jax.baselines.block.library import build as building
from planner_jax.baselines.block.library.cells import LAYOUTS, tunnels
from planner_jax.baselines.block.library.coverage import check, coverage
from planner_jax.baselines.block.library.file import load_library
from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.baselines.block.library.table import (
    Answer,
    Library,
    Setting,
    Table,
    lookup,
    unpack_rows,
)
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.core import GRAVITY
from planner_jax.robot.arm import REGIMES
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_scene import paper_scene
from planner_jax.runs.timing import CompileClock

SEED = 20260
ROUNDS = 20  # The time of a batch lookup is measured over this number of calls.


def time_call(function: Any, *arguments: Any, **how: Any) -> tuple[Any, float]:
    """Call `function` with the arguments and the keyword arguments `how`.

    Returns its result, and the duration [s] of the call minus the time that JAX compiled.
    """
    began = time.perf_counter()
    with CompileClock() as clock:
        found = function(*arguments, **how)
    return found, time.perf_counter() - began - clock.seconds


def build_timed(bench: Bench, path: Path, layout: str, regime: str) -> Library:
    """Build a library of block motions in the file `path`; report build time and compile time.

    A ball flies through a cell (rectangle) of an outer box and then of an inner box around the arm.
    The library stores a motion for each pair of cells. `layout` names the division of the boxes
    into cells, `regime` the joint limits.
    """
    given: Any = REGIMES[regime]
    at_rest: Any = np.asarray(given.ends_at_rest)
    scene = paper_scene()
    setting = Setting(irb1600(), given.limits, at_rest, scene)
    home = irb1600().home
    own = LAYOUTS[layout]
    tunnel = tunnels(own, scene.inner, scene.outer)
    few = np.flatnonzero(tunnel.is_feasible)[:: tunnel.is_feasible.sum() // 64]
    began = time.perf_counter()
    for size in set(building.portions().lanes):
        building.plan_pairs(setting, np.asarray(home), tunnel, np.resize(few, max(size, len(few))))
    compiling = time.perf_counter() - began
    library, seconds = time_call(building.build, path, setting, home, own)
    bench.say(
        f"Build of {own.num_pairs} pairs, {tunnel.is_feasible.sum()} of them feasible: "
        f"{seconds:.2f} s; the first pairs, with compilation, took {compiling:.1f} s."
    )
    bench.note(build_seconds=seconds, first_pairs_seconds=compiling)
    return library


def describe(bench: Bench, library: Library) -> None:
    covered = coverage(library)
    shares = {
        "feasible": float(covered.share(covered.is_feasible)[0]),
        "centred": float(covered.share(covered.is_centred)[0]),
        "all": float(covered.found[0].mean()),
        "sure": float(covered.is_sure[0].sum() / covered.found[0].sum()),
    }
    bench.say(
        f"Motions for {100 * shares['feasible']:.2f} % of the feasible pairs, "
        f"{100 * shares['centred']:.2f} % of those feasible from the outer cell's middle, "
        f"{100 * shares['all']:.1f} % of all; {100 * shares['sure']:.1f} % of the shields block "
        f"their whole tunnel; {library.num_bytes / 1e6:.1f} MB."
    )
    bench.note(coverage=shares, megabytes=library.num_bytes / 1e6)


def referee(bench: Bench, library: Library, num: int, name: str) -> None:
    found = check(library, num, SEED)
    wrong = int((found.claimed & ~found.verdict.success).sum())
    bench.say(
        f"{name}: {100 * found.verdict.success.mean():.2f} % of {num} balls through stored tunnels "
        f"are blocked; of {found.claimed.sum()} claimed blocks the referee rejects {wrong}."
    )
    bench.note(**{f"refused_{name}": wrong, f"claims_{name}": int(found.claimed.sum())})


def block_rates(bench: Bench, library: Library, regime: str, num: int) -> None:
    """Report the shares of balls of the suites `pole` and `short` that stored motions block.

    In both suites a pole stands in front of the arm. The balls of `pole` are thrown from 6 to 12 m
    away, the balls of `short` from 6 to 8 m. `num` balls are drawn for each suite. `regime` names
    the joint limits of the arm.
    """
    planner = LibraryBlock(library)
    for suite in ("pole", "short"):
        for met in ("anywhere", "wide"):
            for delay in (0.0, 0.133):
                cases = pj.block.draw(
                    num,
                    suite,
                    SEED,
                    regime=regime,
                    delay=delay,
                    anywhere=met == "anywhere",
                    wide=met == "wide",
                )
                plans = pj.plan(planner, cases)
                verdict: Any = pj.block.judge(cases, plans)
                found = np.asarray(plans.status) != pj.Status.OUT_OF_REACH
                claims = pj.are_solved(plans)
                refused = int((claims & ~verdict.success).sum())
                bench.say(
                    f"{suite}, {met}, delay {delay} s: stored for {100 * found.mean():.1f} %, "
                    f"{100 * verdict.success.mean():.1f} % of {num} blocked, "
                    f"{refused} of {claims.sum()} claimed blocks rejected"
                )
                bench.row(
                    suite=suite,
                    met=met,
                    delay=delay,
                    regime=regime,
                    found=found.mean(),
                    success=verdict.success.mean(),
                    refused=refused,
                )
                bench.count(verdict.success)


class OneBall:
    """Lookup of stored motions for one ball at a time, with the least latency, on the CPU.

    A ball enters the compiled program as one vector, and the answer leaves it as one vector,
    because each argument and each result costs about a microsecond. The stored motion is not
    adapted to the ball.
    """

    def __init__(self, library: Library, gravity: float = GRAVITY, home: int = 0):
        """Compile the lookup of motions that start at the library's home pose with index `home`.

        `gravity` is in [m/s^2].
        """
        own = library.table

        def pack_rows(rows: Array, vector: Array) -> Array:
            table = Table(
                rows=rows, homes=own.homes, inner=own.inner, outer=own.outer, layout=own.layout
            )
            ball = BallState(pos=vector[:3], vel=vector[3:])
            found = lookup(table, ball, jnp.asarray(gravity, vector.dtype), home)
            numbers = (found.pair, found.stored, found.time, found.slack, *found.beside)
            numbers = jnp.stack([jnp.asarray(x, vector.dtype) for x in (*numbers, found.cosine)])
            return jnp.concatenate([rows[home, found.pair], numbers])

        self._rows = jax.device_put(own.rows, jax.local_devices(backend="cpu")[0])
        vector = jax.ShapeDtypeStruct((6,), np.float32)
        self._lookup = jax.jit(pack_rows).lower(self._rows, vector).compile()

    def answer(self, pos: ArrayLike, vel: ArrayLike) -> Answer:
        """Return the stored motion for a ball, in NumPy arrays and plain numbers.

        Args:
            pos: (3,) [m], position of the ball at time 0, when it is first seen.
            vel: (3,) [m/s], velocity of the ball at time 0.
        """
        vector = np.empty(6, np.float32)
        vector[:3], vector[3:] = pos, vel
        found = np.asarray(self._lookup(self._rows, vector))
        pair, stored, time, slack, along, across, cosine = found[-7:].tolist()
        row = unpack_rows(found[:-7])
        return Answer(row, int(pair), bool(stored), time, slack, (along, across), cosine)


def single_queries(bench: Bench, library: Library, num: int) -> None:
    """Look up stored motions for `num` balls one by one, and report quantiles of the time."""
    one, cases = OneBall(library), pj.block.draw(min(num, 2000), "pole", SEED)
    balls = list(zip(np.asarray(cases.ball.pos), np.asarray(cases.ball.vel), strict=True))
    seconds = []
    for k in range(-500, num):
        pos, vel = balls[k % len(balls)]
        began = time.perf_counter_ns()
        one.answer(pos, vel)
        if k >= 0:
            seconds.append(time.perf_counter_ns() - began)
    quantiles = np.percentile(np.array(seconds) / 1e6, [50, 95, 99])
    mean, spread = np.mean(seconds) / 1e6, np.std(seconds) / 1e6
    bench.say(
        f"Query of one, host to host: p50 {quantiles[0]:.4f} ms, p95 {quantiles[1]:.4f} ms, p99 "
        f"{quantiles[2]:.4f} ms, mean {mean:.4f} +- {spread:.4f} ms of {num}."
    )
    bench.note(query_p50_ms=quantiles[0], query_p99_ms=quantiles[2])


@jax.jit
def look_up(table: Table, balls: BallState, gravity: Any) -> Answer:
    return jax.vmap(lookup, (None, 0, None))(table, balls, gravity)


def batch_queries(bench: Bench, library: Library, batch: int) -> None:
    """Report for how many balls per second the default device looks up the stored arm motion.

    All `batch` balls are looked up in one call.
    """
    cases = pj.block.draw(2000, "pole", SEED)
    pick = np.random.default_rng(SEED).integers(0, 2000, batch)
    balls = jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[pick], cases.ball))
    table = jax.device_put(library.table)
    gravity = jnp.asarray(GRAVITY, jnp.float32)
    _, compiling = time_call(lambda: jax.block_until_ready(look_up(table, balls, gravity)))

    def rounds() -> None:
        found = look_up(table, balls, gravity)
        for _ in range(ROUNDS - 1):
            found = look_up(table, balls, gravity)
        jax.block_until_ready(found)

    rounds()
    _, seconds = time_call(rounds)
    rate = batch * ROUNDS / seconds
    device = jax.devices()[0].device_kind
    bench.say(f"Batch of {batch}: {rate:.3g} queries/s on {device}, compiled in {compiling:.1f} s.")
    bench.note(batch_queries_per_second=rate)


def measure_repair(bench: Bench, library: Library, shift: float, num: int) -> None:
    """Move an obstacle, and time planning again the stored arm motions that collide with it.

    The obstacle is the pole in front of the arm. It moves along y by `shift` [m]. Then draw `num`
    balls, and report how many of them the repaired library blocks, according to the referee, an
    independent check.
    """
    scene = library.setting.scene
    x, y = np.asarray(scene.capsule_ends)[0, 0, :2]
    moved = paper_scene(pole=(x, y + shift))
    (fixed, touched), seconds = time_call(building.repair, library, moved, progress=False)
    stored = int(library.found.sum())
    bench.say(
        f"Pole moved by {shift} m: {touched.sum()} of {stored} motions re-planned in "
        f"{seconds:.2f} s; motions for {fixed.found.sum()} pairs afterwards."
    )
    bench.note(repair_seconds=seconds, repaired=int(touched.sum()))
    referee(bench, fixed, num, "repaired")


def measure(bench: Bench, options: argparse.Namespace) -> None:
    if options.library is None:
        path = bench.path / "library.bin"
        library = build_timed(bench, path, options.layout, options.regime)
    else:
        library = load_library(options.library)
    describe(bench, library)
    referee(bench, library, options.num, "built")
    block_rates(bench, library, options.regime, options.num)
    single_queries(bench, library, options.queries)
    batch_queries(bench, library, options.batch)
    if not options.skip_repair:
        measure_repair(bench, library, options.shift, options.num)


def library_options(parser: argparse.ArgumentParser, layout: str) -> argparse.Namespace:
    """Add the options --library, --layout and --regime to a parser, and parse the command line.

    --library is a file of stored block motions. --layout names how two boxes around the arm,
    through which balls fly, are divided into cells; `layout` is its default. --regime names a set
    of joint limits. An unknown name ends the program with an error.
    """
    parser.add_argument("--library", type=Path, help="file of a built library; default: build one")
    known = ", ".join(LAYOUTS)
    parser.add_argument("--layout", default=layout, help=f"one of {known}; default: {layout}")
    parser.add_argument(
        "--regime", default="R2", help=f"joint limits, one of {', '.join(REGIMES)}; default: R2"
    )
    options = parser.parse_args()
    parse_names(parser, "--layout", options.layout, LAYOUTS)
    parse_names(parser, "--regime", options.regime, REGIMES)
    return options


def main() -> None:
    counts = {"num": 2000, "queries": 20000, "batch": 1 << 20}
    parser = argument_parser("block_library", __doc__, **counts)
    parser.add_argument(
        "--shift", type=float, default=-0.1, help="shift of the pole along y [m]; default: -0.1"
    )
    parser.add_argument("--skip-repair", action="store_true", help="skip the repair")
    options = library_options(parser, layout="B")
    with begin(parser, options) as bench:
        measure(bench, options)


if __name__ == "__main__":
    main()
