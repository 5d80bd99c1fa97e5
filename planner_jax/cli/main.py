"""Entry point of the program `planner-jax`: it parses the command line and runs a command."""

import functools
import sys
from collections.abc import Callable, Sequence

from planner_jax.cli import runs, single
from planner_jax.cli.options import (
    FAILED,
    BadOption,
    Options,
    Parser,
    Unfinished,
    fail,
    warnings_in_one_line,
)
from planner_jax.core.errors import PlannerJaxError
from planner_jax.core.tasks import all_tasks, task_named
from planner_jax.host import signals as stopping
from planner_jax.live.settings import SERVED
from planner_jax.runs.environment import find_version

_INTERRUPTED = 130  # exit code after Ctrl-C


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command of `planner-jax`, by default with the arguments of the process.

    Returns the exit code: 0 for success, 1 for a failure, 2 for a bad argument, 130 after Ctrl-C.
    """
    flags: dict[str, str] = {}  # options of the command by argument name, such as "num": "--num"
    try:
        with warnings_in_one_line():  # such as that another package's task cannot be imported
            words = sys.argv[1:] if arguments is None else arguments
            if any("\0" in word for word in words):
                raise BadOption("arguments must not contain NUL")
            options = vars(_make_parser().parse_args(words))
        flags = options.pop("flags")
        return options.pop("command")(options) or 0
    except KeyboardInterrupt as stop:
        if stopping.is_stopped():
            stopping.leave()
        print(f"planner-jax: {str(stop) or 'interrupted'}", file=sys.stderr)
        return _INTERRUPTED
    except Unfinished as error:
        return fail(error, code=FAILED)
    except PlannerJaxError as error:
        return fail(error, flags)
    except MemoryError:
        return fail("the machine has too little memory: use a smaller batch", code=FAILED)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        return fail(f"{place}{error.strerror or error}", code=FAILED)


def _make_parser() -> Parser:
    """Make the parser of all commands; a command's options are added only when it is used."""
    parser = Parser(
        prog="planner-jax",
        description="Plan for robots that meet flying objects, thousands of cases at once.",
        epilog="examples:\n  planner-jax sweep hit --num 9000 --out runs/first\n"
        "  planner-jax sweep catch --suite triangle3 --num 1000",
    )
    version = f"planner-jax {find_version('planner-jax') or 'of a source tree'}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(title="commands", required=True, metavar="command")

    def command(name: str, words: str, run: Callable[[Options], int | None]) -> Parser:
        added = commands.add_parser(name, help=words, description=words)
        added.set_defaults(command=run)
        return added

    for name, words, add in (
        ("plan", "plan and referee one case that is specified by a few numbers", single.add_plan),
        ("sweep", "plan and referee many cases of a task", runs.add_sweep),
        ("fly", "fly many cases of a task in closed loop", runs.add_fly),
    ):
        among = commands.add_parser(name, help=words)
        tasks = among.add_subparsers(title="tasks", required=True, metavar="task")
        for task in all_tasks().values():
            if {"sweep": task.sweep, "fly": task.flight, "plan": task.single}[name] is not None:
                # `fill` imports the module of the task's settings, which is slow. The parser calls
                # it for the requested task only.
                fill = functools.partial(add, task)
                tasks.add_parser(task.name, help=task.summary, fill=fill)
    words = "train a policy that decides about catches"
    commands.add_parser("train", help=words, fill=runs.add_train)
    library = commands.add_parser("library", help="stored motions that the block planner looks up")
    runs.add_library(library)
    view = command("view", "play a run's flights in a browser", runs.view)
    view.add_argument("run", metavar="RUN", help="folder of a run of flights")
    view.add("--host", default="localhost", help="where to serve (default: localhost)")
    port = "0 uses a free one (default: 8080)"
    view.add("--port", type=int, default=8080, metavar="N", help=port)
    report = command("report", "write table, figures and page of a run again", runs.report)
    report.add_argument("run", metavar="RUN", help="folder of a finished run")
    words = "known robots with their main figures, or one of them as a YAML file to start from"
    robots = command("robots", words, single.robots)
    robots.add_argument("robot", metavar="NAME", nargs="?", help="one of them, or a file")
    words = "plan live for one robot: observations in, setpoints out, over UDP"
    serve = commands.add_parser("serve", help=words)
    served = serve.add_subparsers(title="tasks", required=True, metavar="task")
    for name, kind in SERVED.items():
        fill = functools.partial(single.add_serve, kind)
        served.add_parser(name, help=task_named(name).summary, fill=fill)
    words = "compare runs, and list the cases that only some of them solve"
    compare = command("compare", words, runs.compare)
    compare.add_argument("runs", nargs="+", metavar="RUN", help="folders of finished sweeps")
    compare.add("--all", action="store_true", help="list all cases that differ, not ten")
    compare.add("--out", metavar="FILE", help="new file, .csv, for the comparison as a table")
    words = "write a plan for a controller, or send it in real time"
    commands.add_parser("export", help=words, fill=single.add_export)
    bench = commands.add_parser("bench", help="measure this machine")
    kinds = bench.add_subparsers(title="benchmarks", required=True, metavar="benchmark")
    words = "plans a second, with success and cost"
    kinds.add_parser("throughput", help=words, fill=runs.add_throughput)
    command("doctor", "versions, devices, precision, cache and a timed plan", _doctor)
    return parser


def _doctor(options: Options) -> int:
    from planner_jax.cli import doctor

    return 0 if doctor.report() else FAILED
