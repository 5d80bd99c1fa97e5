"""The compiled programs of default planners: their equations and compile times.

    python -m benchmarks.compilation [--tasks "hit,catch throws"] [--num 64] [--out DIR]

A program is a function that JAX compiles. The table shows the size of each program, and how long
its compilation takes without the cache on the disk, for four calls: `pj.plan` of one case and of a
batch, and `jax.jit` of `pj.solve` for one case, without and with `pj.quick_options()`. The CPU time
of the first call includes tracing, compiling and planning.
"""

import collections
import contextlib
import dataclasses
import functools
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import PyTree

from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.core.compiled import quick_options
from planner_jax.core.protocol import take
from planner_jax.core.tasks import task_named
from planner_jax.planning.plan import plan
from planner_jax.planning.solve import solve

BATCH = 64  # number of cases of the batch whose programs are listed
# Tasks whose default planners are examined, as "TASK" or "TASK SUITE": the suite is the family of
# random cases that are planned, by default the first of the task.
EXAMINED = ("hit", "catch throws", "catch triangle3", "rally", "intercept hard", "block")
_SMALL = 0.05  # [s] programs that compile faster have no row, and only count in the sums
# NAME of JAX's event /jax/core/compile/NAME_duration -> field of `Program` that sums its durations.
_EVENTS = dict(jaxpr_trace="tracing", jaxpr_to_mlir_module="lowering", backend_compile="compiling")
_HEAD = (
    "| planner | call | cases | program | versions | equations | tracing [s] | lowering [s] "
    "| compiling [s] | first call, CPU [s] |",
    "|---|---|---|---|---|---|---|---|---|---|",
)


@dataclasses.dataclass
class Program:
    """Size and compile times of one function, summed over all shapes of its arguments."""

    versions: int = 0  # number of compiled programs, one for each combination of argument shapes
    equations: int = 0  # number of equations in the jaxprs (traced functions), with inner jaxprs
    tracing: float = 0.0  # [s] time of tracing to jaxprs
    lowering: float = 0.0  # [s] time of lowering to MLIR
    compiling: float = 0.0  # [s] time of compiling


@contextlib.contextmanager
def record_programs() -> Iterator[dict[str, Program]]:
    """Record the programs that JAX compiles in a `with` block; the record is complete after it."""
    programs: dict[str, Program] = collections.defaultdict(Program)

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        event = event.removeprefix("/jax/core/compile/").removesuffix("_duration")
        if field := _EVENTS.get(event):
            name = str(kwargs.get("fun_name", ""))
            program = programs[name.removeprefix("jit(").removesuffix(")")]
            setattr(program, field, getattr(program, field) + duration_secs)
            program.versions += field == "compiling"

    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_dump_ir_modes", "jaxpr")
        jax.config.update("jax_dump_ir_to", folder)  # JAX writes a text file for each program
        jax.monitoring.register_event_duration_secs_listener(listen)
        try:
            yield programs
        finally:
            jax.monitoring.unregister_event_duration_listener(listen)
            jax.config.update("jax_dump_ir_to", "")
        for path in Path(folder).iterdir():
            name = re.sub(r"^jax_\d+_|\.jaxpr\.txt$", "", path.name)
            programs[name].equations += len(re.findall(r"^\s*\S.* = ", path.read_text(), re.M))
    # Functions within a program are traced as well, but not compiled alone; they have no row.
    for name in [name for name, program in programs.items() if not program.versions]:
        del programs[name]


def format_rows(
    planner: str, call: str, num: int, seconds: float, programs: dict[str, Program]
) -> list[str]:
    """Format the table rows of one call: a row for each slow program, then a row of sums.

    `num` is the number of cases that were planned together, and `seconds` the CPU time of the first
    call. A program that compiles in less than 0.05 s has no row of its own.
    """
    columns = zip(*map(dataclasses.astuple, programs.values()), strict=True)
    shown = [row for row in programs.items() if row[1].compiling >= _SMALL]
    shown.sort(key=lambda row: -row[1].compiling)
    rows = [*shown, ("all", Program(*map(sum, columns)))]
    return [
        f"| {planner} | {call} | {num} | {name} | {made.versions} | {made.equations:,} "
        f"| {made.tracing:.1f} | {made.lowering:.1f} | {made.compiling:.1f} "
        f"| {f'{seconds:.1f}' * (name == 'all')} |"
        for name, made in rows
    ]


def main() -> None:
    parser = argument_parser("compilation", __doc__, num=BATCH)
    parser.add_argument(
        "--tasks", default=",".join(EXAMINED), help="comma-separated: TASK or TASK SUITE"
    )
    options = parser.parse_args()
    with begin(parser, options) as bench:
        measure(bench, options.tasks.split(","), options.num)


def measure(bench: Bench, tasks: Sequence[str], size: int) -> None:
    """Print the programs of each task's default planner, for each kind of call."""
    jax.config.update("jax_enable_compilation_cache", False)
    bench.say(*_HEAD)
    for name in tasks:
        task, *suite = name.split()
        planner, judge = task_named(task).planner(), task_named(task).judge
        batch = jax.tree.map(np.asarray, task_named(task).draw(size, *suite))
        one, solve_one = take(batch, 0), functools.partial(solve, planner)
        plan_all = functools.partial(plan, planner)
        calls: list[tuple[str, int, PyTree, Callable]] = [
            ("pj.plan", 1, one, plan_all),
            ("pj.plan", size, batch, plan_all),
            ("jit(pj.solve)", 1, one, jax.jit(solve_one)),
            ("jit(pj.solve), quick", 1, one, jax.jit(solve_one, compiler_options=quick_options())),
        ]
        for call, num, cases, function in calls:
            jax.clear_caches()
            start = time.process_time()
            with record_programs() as programs:
                plans = jax.block_until_ready(function(cases))
            seconds = time.process_time() - start
            bench.say(*format_rows(name, call, num, seconds, programs))
            bench.count(np.atleast_1d(judge(cases, plans).success))


if __name__ == "__main__":
    main()
