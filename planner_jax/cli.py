"""The command line: `planner-jax sweep|fly hit|catch`, `view`, `report`, `bench`, `doctor`."""

import argparse
import dataclasses
import datetime
import os
import shlex
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, get_args, get_type_hints

from planner_jax.compile_cache import keep_compiled_programs
from planner_jax.sweep.catch.settings import DECISIONS, NET_TESTS, SUITES, CatchSweep
from planner_jax.sweep.environment import installed_version, require_backend
from planner_jax.sweep.hit.settings import HitSweep
from planner_jax.sweep.settings import SettingError, SweepSettings, require
from planner_jax.task.catch.planners import PLANNERS as CATCH_PLANNERS
from planner_jax.task.hit.planners import PLANNERS as HIT_PLANNERS

_OPTIONS = {
    *HitSweep.__dataclass_fields__,
    *CatchSweep.__dataclass_fields__,
    *("out", "devices", "iterations", "repeat"),
    *("noise", "replan", "balls", "drag_error", "video", "record", "host", "port"),
}
_FAILED, _BAD_ARGUMENT, _INTERRUPTED = 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: of the command line; by default those of the process.

    Returns:
        The exit code: 0, 1 where the file system fails, 2 for a bad argument, 130 after Ctrl-C.
    """
    options = vars(_parser().parse_args(arguments))
    command = options.pop("command")
    try:
        return command(options) or 0
    except KeyboardInterrupt as stop:
        print(f"planner-jax: {str(stop) or 'interrupted'}", file=sys.stderr)
        return _INTERRUPTED
    except SettingError as error:
        return _fail(str(error))
    except OSError as error:
        _fail(str(error))
        return _FAILED


def _fail(message: str) -> int:
    """Print one line, in which an argument's name is written as on the command line."""
    name, _, rest = message.partition(" ")
    if name in _OPTIONS:
        message = f"--{name.replace('_', '-')} {rest}"
    print(f"planner-jax: error: {' '.join(message.split())}", file=sys.stderr)
    return _BAD_ARGUMENT


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with an argument in one line."""

    def error(self, message: str) -> NoReturn:
        sys.exit(_fail(message.removeprefix("argument ")))


class _Help(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str):
        super().__init__(prog, max_help_position=28, width=100)


def _parser() -> argparse.ArgumentParser:
    look: dict[str, Any] = {"formatter_class": _Help, "allow_abbrev": False}
    parser = _Parser(
        prog="planner-jax",
        description="Plan for robots that meet flying objects, thousands of cases at once.",
        epilog="examples:\n  planner-jax sweep hit --num 9000 --out runs/first\n"
        "  planner-jax sweep catch --suite triangle3 --num 1000",
        **look,
    )
    version = f"planner-jax {installed_version('planner-jax') or 'of a source tree'}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(title="commands", required=True, metavar="command")
    sweep = commands.add_parser("sweep", help="plan and referee many cases of a task", **look)
    tasks = sweep.add_subparsers(title="tasks", required=True, metavar="task")
    _add_hit(tasks, look)
    _add_catch(tasks, look)
    fly = commands.add_parser("fly", help="fly many cases of a task in closed loop", **look)
    tasks = fly.add_subparsers(title="tasks", required=True, metavar="task")
    from planner_jax.sims.settings import FLIGHTS, fly_settings

    for task in FLIGHTS:
        _add_fly(tasks, look, fly_settings(task))
    view = commands.add_parser("view", help="play a run's flights in a browser", **look)
    view.add_argument("run", metavar="RUN", help="folder of a run of flights")
    view.add_argument("--host", default="localhost", help="where to serve (default: localhost)")
    view.add_argument(
        "--port", type=int, default=8080, metavar="N", help="0 takes a free one (default: 8080)"
    )
    view.set_defaults(command=_view)
    report = commands.add_parser(
        "report", help="write table, figures and page of a run anew", **look
    )
    report.add_argument("run", metavar="RUN", help="folder of a finished run")
    report.set_defaults(command=_report)
    _add_bench(commands, look)
    doctor = commands.add_parser(
        "doctor", help="versions, devices, precision, cache and a timed plan", **look
    )
    doctor.set_defaults(command=_doctor)
    return parser


def _add_task(
    tasks: Any,
    look: dict[str, Any],
    kind: type[SweepSettings],
    planners: Sequence[str],
    words: tuple[str, str],
    cases: tuple[str, str, str],
) -> argparse.ArgumentParser:
    """The arguments that all sweeps have. One that is not given is absent from the namespace.

    Args:
        tasks: the parsers of all tasks.
        look: of this parser.
        kind: settings of the task.
        planners: its names.
        words: what the task is, short and long.
        cases: what follows the default number of cases, which limits are scaled, what the seed
            is of.
    """
    parser = tasks.add_parser(
        kind.TASK,
        help=words[0],
        description=f"{words[1]}\n"
        "Writes a run folder: index.html, table.md, figures, plans.parquet, manifest.json.",
        argument_default=argparse.SUPPRESS,
        **look,
    )
    default = kind()
    more, limits, drawn = cases
    add = parser.add_argument
    # fmt: off
    add("--planner", metavar="NAME", help=f"{', '.join(planners)} (default: {default.planner})")
    add("--num", type=int, metavar="N", help=f"cases (default: {kind.DEFAULT_NUM}{more})")
    add("--limit-scale", type=float, metavar="F",
        help=f"factor on {limits} (default: {default.limit_scale:g})")
    add("--batch", type=int, metavar="B",
        help="cases planned, judged and written at once; bounds the memory "
        f"(default: {kind.CPU_BATCH} on a CPU, {kind.GPU_BATCH} on a GPU)")
    add("--seed", type=int, metavar="K", help=f"of {drawn} (default: {default.seed})")
    add("--out", metavar="DIR", help=f"run folder (default: runs/{kind.TASK}-PLANNER-DATE-TIME)")
    add("--resume", action="store_true", help="finish the interrupted run in --out")
    # fmt: on
    parser.set_defaults(command=lambda given: _sweep(kind, given))
    return parser


def _add_hit(tasks: Any, look: dict[str, Any]) -> None:
    """The arguments of `sweep hit`."""
    parser = _add_task(
        tasks,
        look,
        HitSweep,
        list(HIT_PLANNERS),
        (
            "a quadrotor hits served balls to a target with a racket",
            "Plan a quadrotor's volley for thousands of serves and let a referee judge every plan.",
        ),
        (
            " drawn ones, or all of the folder",
            "the speed, acceleration and body-rate limits",
            "drawn serves and of uniform starts",
        ),
    )
    default = HitSweep()
    start = " ".join(f"{x:g}" for x in default.start)
    add = parser.add_argument
    # fmt: off
    add("--serves", metavar="DIR", help="read published trial files (default: draw serves)")
    add("--start", nargs="+", metavar="X",
        help=f"hover start X Y Z in m, or 'uniform' over the half court (default: {start})")
    add("--delay", type=float, metavar="S",
        help=f"seconds from the serve to the start of planning (default: {default.delay:g})")
    add("--drag-after-impact", action="store_true",
        help="plan and judge the returned ball with drag too (exact only)")
    # fmt: on


def _add_catch(tasks: Any, look: dict[str, Any]) -> None:
    """The arguments of `sweep catch`."""
    parser = _add_task(
        tasks,
        look,
        CatchSweep,
        list(CATCH_PLANNERS),
        (
            "a quadrotor catches flying targets with a net",
            "Decide when and in what order a quadrotor catches flying targets, plan it for "
            "thousands of\nscenarios of a suite, and let a referee judge every plan.",
        ),
        (
            "",
            "the speed and body-rate limits and on the thrust's distance from hover",
            "the suite's scenarios",
        ),
    )
    default = CatchSweep()
    add = parser.add_argument
    # fmt: off
    add("--suite", metavar="NAME", help=f"{', '.join(SUITES)} (default: {default.suite})")
    add("--decide", metavar="NAME",
        help=f"order and first times: {', '.join(DECISIONS)} (default: {default.decide})")
    add("--tolerance", type=float, metavar="R",
        help=f"relative, of the referee (default: {default.tolerance:g}; the published protocol "
        "has 0.05 with --net-test ball)")
    add("--net-test", metavar="NAME",
        help=f"where the net's radius counts, {' or '.join(NET_TESTS)}: across the net in its "
        f"plane, or all around its centre (default: {default.net_test})")
    # fmt: on


def _add_fly(tasks: Any, look: dict[str, Any], kind: Any) -> None:
    """The arguments of `fly` for a task, made from its settings; what is not given is absent."""
    parser = tasks.add_parser(
        kind.TASK,
        help=kind.WORDS,
        description=f"Plan and fly in MuJoCo MJX: {kind.WORDS}, with noise, latency and wrong drag."
        "\nWrites a run folder: index.html, table.md, a figure, plans.parquet, flights.parquet,\n"
        "manifest.json.",
        argument_default=argparse.SUPPRESS,
        **look,
    )
    add = parser.add_argument
    types = get_type_hints(kind)
    for field in dataclasses.fields(kind):
        value = next(t for t in (*get_args(types[field.name]), types[field.name]) if t is not None)
        told = "" if field.default is None else f" (default: {field.default})"
        add(
            f"--{field.name.replace('_', '-')}",
            type=value,
            metavar=field.metadata["metavar"],
            help=field.metadata["help"] + told,
        )
    # fmt: off
    add("--record", type=int, metavar="K",
        help="flights kept look by look for `planner-jax view`, the first ones (default: 16)")
    add("--video", nargs="?", const="flights.gif", metavar="FILE",
        help="film the first three of these into the run folder, .gif, or .mp4 where ffmpeg is "
        "installed (default name: flights.gif)")
    add("--out", metavar="DIR", help=f"run folder (default: runs/fly-{kind.TASK}-DATE-TIME)")
    # fmt: on
    parser.set_defaults(command=lambda given: _fly(kind, given))


def _fly(kind: Any, given: dict[str, Any]) -> None:
    keep_compiled_programs()
    from planner_jax.sims.run import start_flights

    out, video = given.pop("out", None), given.pop("video", None)
    out = out or os.path.join("runs", f"fly-{kind.TASK}-{datetime.datetime.now():%Y%m%d-%H%M%S}")
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
    viewer = Viewer(flight, recording, options["host"], options["port"])
    _let_ctrl_c_stop()
    print(f"Playing {len(recording)} flights at {viewer.url}; Ctrl-C stops.", flush=True)
    viewer.run()


def _let_ctrl_c_stop() -> None:
    """A shell starts background jobs deaf to SIGINT; here it is heard there too."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _add_bench(commands: Any, look: dict[str, Any]) -> None:
    """The arguments of `bench throughput`."""
    bench = commands.add_parser("bench", help="measure this machine", **look)
    kinds = bench.add_subparsers(title="benchmarks", required=True, metavar="benchmark")
    parser = kinds.add_parser(
        "throughput",
        help="plans a second, with success and cost",
        description="Plans a second of batches that stay on the devices, with what the referee "
        "says of them,\nthe cost beside a long search's, compile time and memory.",
        **look,
    )
    add = parser.add_argument
    # fmt: off
    add("--task", choices=("hit", "catch"), default="hit", help="(default: hit)")
    add("--batch", type=int, nargs="+", default=[1024, 8192], metavar="B",
        help="plans in one call, one or more sizes (default: 1024 8192)")
    add("--devices", type=int, metavar="N", help="how many share a batch (default: all)")
    add("--iterations", type=int, metavar="K",
        help="of the first round (default: the planner's own)")
    add("--repeat", type=int, default=5, metavar="R", help="timed calls (default: 5)")
    add("--seed", type=int, default=0, metavar="K", help="of the drawn scenarios (default: 0)")
    add("--agree", action="store_true", help="compare the lanes with those of a CPU, too")
    # fmt: on
    parser.set_defaults(command=_throughput)


def _throughput(options: dict[str, Any]) -> None:
    for name in ("devices", "iterations", "repeat"):
        value = options[name]
        require(value is None or value >= 1, name, ">= 1", value)
    require(min(options["batch"]) >= 1, "batch", ">= 1", min(options["batch"]))
    require(options["seed"] >= 0, "seed", ">= 0", options["seed"])
    require_backend()
    keep_compiled_programs()
    from planner_jax.benchmarks.throughput import report

    report(**options)


def _doctor(options: dict[str, Any]) -> int:
    from planner_jax.doctor import report

    return 0 if report() else _FAILED


def _sweep(kind: type[SweepSettings], given: dict[str, Any]) -> None:
    out, resume = given.pop("out", None), given.pop("resume", False)
    if given.get("start") == ["uniform"]:
        given["start"] = "uniform"
    settings = kind(**given)
    if resume and out is None:
        raise SettingError("out must name the folder to resume, got nothing")
    if out is None:
        now = datetime.datetime.now()
        out = os.path.join("runs", f"{kind.TASK}-{settings.planner}-{now:%Y%m%d-%H%M%S}")
    _let_ctrl_c_stop()
    keep_compiled_programs()
    from planner_jax.sweep import run

    try:
        if resume:
            manifest = run.resume_sweep(kind.TASK, out, **given)
        else:
            manifest = run.start_sweep(settings, out)
    except run.SweepInterrupted:
        again = f"planner-jax sweep {kind.TASK} --resume --out {shlex.quote(str(out))}"
        raise run.SweepInterrupted(f"interrupted; finish with: {again}") from None
    _print_result(manifest, Path(out))


def _print_result(manifest: dict[str, Any], out: Path) -> None:
    from planner_jax.sweep.table import headline
    from planner_jax.sweep.task import task_of

    print("\n".join(headline(manifest, task_of(manifest).findings(manifest))))
    print(f"Look at {out / 'index.html'}")


def _report(options: dict[str, Any]) -> None:
    from planner_jax.sweep.report import write_report
    from planner_jax.sweep.run_folder import RunFolder

    folder = RunFolder(options["run"], name="RUN")
    manifest = folder.read_manifest()
    if str(manifest["kind"]).startswith("fly "):
        from planner_jax.sims.run import write_flight_report

        write_flight_report(folder)
        _print_flights(folder.path)
    else:
        write_report(folder)
        _print_result(manifest, folder.path)


if __name__ == "__main__":
    sys.exit(main())
