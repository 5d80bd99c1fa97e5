"""The command line: `planner-jax sweep|fly TASK`, `view`, `report`, `bench`, `doctor`.

Tasks come from the registry, and the options of `sweep` and `fly` from the fields of a task's
settings: nothing here knows a task.
"""

import argparse
import contextlib
import dataclasses
import datetime
import os
import pkgutil
import shlex
import signal
import sys
import threading
import types
import typing
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from planner_jax.compile_cache import keep_compiled_programs
from planner_jax.registry import Task, all_tasks, task_named
from planner_jax.sweep.environment import installed_version, require_backend
from planner_jax.sweep.settings import SettingError, SweepSettings, require

_FAILED, _BAD_ARGUMENT, _INTERRUPTED = 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: of the command line; by default those of the process.

    Returns:
        The exit code: 0, 1 where the file system fails, 2 for a bad argument, 130 after Ctrl-C.
    """
    try:
        with _warnings_in_lines():
            options = vars(_parser().parse_args(arguments))
        return options.pop("command")(options) or 0
    except KeyboardInterrupt as stop:
        print(f"planner-jax: {str(stop) or 'interrupted'}", file=sys.stderr)
        return _INTERRUPTED
    except SettingError as error:
        return _fail(str(error))
    except OSError as error:
        _fail(str(error))
        return _FAILED


@contextlib.contextmanager
def _warnings_in_lines() -> Iterator[None]:
    """Print a line for every warning, such as one of another package whose task does not work."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            yield
        finally:
            for warning in told:
                print(f"planner-jax: warning: {warning.message}", file=sys.stderr)


_ARGUMENTS: set[str] = set()  # names of all arguments, as they are written in Python


def _fail(message: str) -> int:
    """Print one line, in which an argument's name is written as on the command line."""
    name, _, rest = message.partition(" ")
    if name in _ARGUMENTS:
        message = f"--{name.replace('_', '-')} {rest}"
    print(f"planner-jax: error: {' '.join(message.split())}", file=sys.stderr)
    return _BAD_ARGUMENT


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with an argument in one line; has no options until it is asked."""

    def __init__(self, *, fill: Callable[["_Parser"], None] = lambda parser: None, **look: Any):
        super().__init__(**{"formatter_class": _Help, "allow_abbrev": False, **look})
        self._fill = fill

    def parse_known_args(self, *arguments: Any, **how: Any) -> Any:
        self._fill(self)
        return super().parse_known_args(*arguments, **how)

    def add(self, flag: str, **how: Any) -> None:
        """Add an option."""
        _ARGUMENTS.add(self.add_argument(flag, **how).dest)

    def error(self, message: str) -> NoReturn:
        sys.exit(_fail(message.removeprefix("argument ")))


class _Help(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str):
        super().__init__(prog, max_help_position=28, width=100)


def _parser() -> _Parser:
    parser = _Parser(
        prog="planner-jax",
        description="Plan for robots that meet flying objects, thousands of cases at once.",
        epilog="examples:\n  planner-jax sweep hit --num 9000 --out runs/first\n"
        "  planner-jax sweep catch --suite triangle3 --num 1000",
    )
    version = f"planner-jax {installed_version('planner-jax') or 'of a source tree'}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(title="commands", required=True, metavar="command")

    def command(name: str, words: str, run: Callable, **look: Any) -> _Parser:
        added = commands.add_parser(name, help=words, description=look.pop("description", words))
        added.set_defaults(command=run, **look)
        return added

    _add_tasks(commands, "sweep", "plan and referee many cases of a task", _add_sweep)
    _add_tasks(commands, "fly", "fly many cases of a task in closed loop", _add_fly)
    view = command("view", "play a run's flights in a browser", _view)
    view.add_argument("run", metavar="RUN", help="folder of a run of flights")
    view.add("--host", default="localhost", help="where to serve (default: localhost)")
    view.add(
        "--port", type=int, default=8080, metavar="N", help="0 takes a free one (default: 8080)"
    )
    report = command("report", "write table, figures and page of a run anew", _report)
    report.add_argument("run", metavar="RUN", help="folder of a finished run")
    bench = commands.add_parser("bench", help="measure this machine")
    kinds = bench.add_subparsers(title="benchmarks", required=True, metavar="benchmark")
    _add_throughput(kinds.add_parser("throughput", help="plans a second, with success and cost"))
    command("doctor", "versions, devices, precision, cache and a timed plan", _doctor)
    return parser


def _add_tasks(commands: Any, name: str, words: str, add: Callable[[_Parser, Task], None]) -> None:
    """A command with a parser for every task."""
    parser = commands.add_parser(name, help=words)
    tasks = parser.add_subparsers(title="tasks", required=True, metavar="task")
    for task in all_tasks().values():
        if name == "sweep" or task.flight is not None:
            # Settings are imported for the one task that is asked for.
            tasks.add_parser(
                task.name,
                help=task.summary,
                argument_default=argparse.SUPPRESS,
                fill=lambda parser, task=task: add(parser, task),
            )


def _add_settings(parser: _Parser, kind: type, task: Task) -> None:
    """An option for every field of settings. One that is not given is absent from the namespace."""
    hints = typing.get_type_hints(kind)
    names = {"planner": task.all_planners(), "suite": task.all_suites()}
    for field in dataclasses.fields(kind):
        flag, default = f"--{field.name.replace('_', '-')}", field.default
        words = field.metadata["help"]
        if field.name in names:
            known = list(names[field.name])
            words, default = f"{', '.join(known)}", known[0] if default is None else default
        if field.name in ("num", "batch") and default is None and hasattr(kind, "DEFAULT_NUM"):
            default = {
                "num": kind.DEFAULT_NUM,  # type: ignore[attr-defined]
                "batch": f"{kind.CPU_BATCH} on a CPU, {kind.GPU_BATCH} on a GPU",  # type: ignore[attr-defined]
            }[field.name]
        if isinstance(default, bool):
            parser.add(flag, action="store_true", help=words)
            continue
        if default is not None and "(default:" not in words:
            shown = " ".join(f"{x:g}" for x in default) if isinstance(default, tuple) else default
            words += f" (default: {shown})"
        several = {"nargs": "+"} if isinstance(field.default, tuple) else {}
        metavar = field.metadata["metavar"]
        parser.add(flag, type=_type_of(hints[field.name]), metavar=metavar, help=words, **several)


def _type_of(hint: Any) -> Callable[[str], Any]:
    """What makes a value of a word: `int` or `float` where a field holds these, or nothing."""
    held = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    return next((kind for kind in held if kind in (int, float)), str)


def _add_sweep(parser: _Parser, task: Task) -> None:
    parser.description = (
        f"Many cases of one task, {task.summary}:\nplanned, and every plan judged by a referee.\n"
        "Writes a run folder: index.html, table.md, figures, plans.parquet, manifest.json."
    )
    _add_settings(parser, pkgutil.resolve_name(task.sweep), task)
    parser.add(
        "--out", metavar="DIR", help=f"run folder (default: runs/{task.name}-PLANNER-DATE-TIME)"
    )
    parser.add("--resume", action="store_true", help="finish the interrupted run in --out")
    parser.set_defaults(command=lambda given: _sweep(task, given))


def _add_fly(parser: _Parser, task: Task) -> None:
    parser.description = (
        f"Many flights of one task, {task.summary},\n"
        "in MuJoCo MJX with noise, latency and wrong drag.\n"
        "Writes a run folder: index.html, table.md, a figure, plans.parquet, flights.parquet,\n"
        "manifest.json."
    )
    kind = pkgutil.resolve_name(str(task.flight))
    _add_settings(parser, kind, task)
    parser.add(
        "--record",
        type=int,
        metavar="K",
        help="flights kept look by look for `planner-jax view`, the first ones (default: 16)",
    )
    parser.add(
        "--video",
        nargs="?",
        const="flights.gif",
        metavar="FILE",
        help="film the first three of these into the run folder, .gif, or .mp4 where ffmpeg is "
        "installed (default name: flights.gif)",
    )
    parser.add("--out", metavar="DIR", help=f"run folder (default: runs/fly-{task.name}-DATE-TIME)")
    parser.set_defaults(command=lambda given: _fly(task, kind, given))


def _add_throughput(parser: _Parser) -> None:
    parser.description = (
        "Plans a second of batches that stay on the devices, with what the referee says of them,\n"
        "the cost beside a long search's, compile time and memory."
    )
    tasks = list(all_tasks())
    for flag, how in {
        "--task": {"choices": tasks, "default": tasks[0], "help": f"(default: {tasks[0]})"},
        "--planner": {"metavar": "NAME", "help": "(default: the task's first)"},
        "--suite": {"metavar": "NAME", "help": "(default: the task's first)"},
        "--batch": {
            "type": int,
            "nargs": "+",
            "default": [1024, 8192],
            "metavar": "B",
            "help": "plans in one call, one or more sizes (default: 1024 8192)",
        },
        "--devices": {"type": int, "metavar": "N", "help": "how many share a batch (default: all)"},
        "--iterations": {
            "type": int,
            "metavar": "K",
            "help": "of the first round (default: the planner's own)",
        },
        "--repeat": {"type": int, "default": 5, "metavar": "R", "help": "timed calls (default: 5)"},
        "--seed": {"type": int, "default": 0, "metavar": "K", "help": "of the cases (default: 0)"},
        "--agree": {"action": "store_true", "help": "compare the lanes with those of a CPU, too"},
        "--out": {
            "metavar": "DIR",
            "help": "run folder (default: runs/bench-throughput-DATE-TIME)",
        },
    }.items():
        parser.add(flag, **how)
    parser.set_defaults(command=_throughput)


def _out(given: dict[str, Any], name: str) -> str:
    """The run folder that is asked for, or one of this name and moment."""
    out = given.pop("out", None)
    return out or os.path.join("runs", f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S}")


def _sweep(task: Task, given: dict[str, Any]) -> None:
    kind, resume = pkgutil.resolve_name(task.sweep), given.pop("resume", False)
    if resume and "out" not in given:
        raise SettingError("out must name the folder to resume, got nothing")
    out = given.pop("out", None)
    settings = kind(**given).of(task)
    out = _out({"out": out}, f"{task.name}-{settings.planner}")
    _let_ctrl_c_stop()
    keep_compiled_programs()
    from planner_jax.sweep import run

    try:
        if resume:
            manifest = run.resume_sweep(task, out, **given)
        else:
            manifest = run.start_sweep(task, settings, out)
    except run.SweepInterrupted:
        again = f"planner-jax sweep {task.name} --resume --out {shlex.quote(str(out))}"
        raise run.SweepInterrupted(f"interrupted; finish with: {again}") from None
    _print_sweep(manifest, Path(out))


def _print_sweep(manifest: dict[str, Any], out: Path) -> None:
    from planner_jax.sweep.sweep import sweep_of_run
    from planner_jax.sweep.table import headline

    print("\n".join(headline(manifest, sweep_of_run(manifest).findings(manifest))))
    print(f"Look at {out / 'index.html'}")


def _fly(task: Task, kind: type, given: dict[str, Any]) -> None:
    keep_compiled_programs()
    from planner_jax.sims.run import start_flights

    out, video = _out(given, f"fly-{task.name}"), given.pop("video", None)
    keep = {"record": given.pop("record")} if "record" in given else {}
    start_flights(kind(**given), out, video, **keep)
    _print_flights(Path(out))


def _print_flights(out: Path) -> None:
    from planner_jax.sims.run import headline, read_flights
    from planner_jax.sweep.run_folder import RunFolder

    manifest, flight, _ = read_flights(RunFolder(out))
    print("\n".join(headline(manifest, flight)))
    print(f"Look at {out / 'index.html'}, or play it: planner-jax view {shlex.quote(str(out))}")


def _view(options: dict[str, Any]) -> None:
    from planner_jax.sims.run import read_flights
    from planner_jax.sims.view import Viewer
    from planner_jax.sweep.run_folder import RunFolder

    _, flight, recording = read_flights(RunFolder(options["run"], name="RUN"))
    titles = [flight.title(recording, row) for row in range(len(recording))]
    where = options["host"], options["port"]
    viewer = Viewer(flight.world(), recording, titles, flight.CONTACT, *where)
    _let_ctrl_c_stop()
    print(f"Playing {len(recording)} flights at {viewer.url}; Ctrl-C stops.", flush=True)
    viewer.run()


def _let_ctrl_c_stop() -> None:
    """A shell starts background jobs deaf to SIGINT; here it is heard there too."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _throughput(options: dict[str, Any]) -> None:
    for name in ("devices", "iterations", "repeat"):
        value = options[name]
        require(value is None or value >= 1, name, ">= 1", value)
    require(min(options["batch"]) >= 1, "batch", ">= 1", min(options["batch"]))
    named = {name: options[name] for name in ("planner", "suite", "seed")}
    SweepSettings(**named).of(task_named(options["task"]))
    require_backend()
    keep_compiled_programs()
    from planner_jax.benchmarks.throughput import report

    out = _out(options, "bench-throughput")
    report(**options, out=out)


def _report(options: dict[str, Any]) -> None:
    from planner_jax.sweep.run_folder import RunFolder

    folder = RunFolder(options["run"], name="RUN")
    manifest = folder.read_manifest()
    if str(manifest["kind"]).startswith("fly "):
        from planner_jax.sims.run import write_flight_report

        write_flight_report(folder)
        _print_flights(folder.path)
    else:
        from planner_jax.sweep.report import write_report

        write_report(folder)
        _print_sweep(manifest, folder.path)


def _doctor(options: dict[str, Any]) -> int:
    from planner_jax.doctor import report

    return 0 if report() else _FAILED


if __name__ == "__main__":
    sys.exit(main())
