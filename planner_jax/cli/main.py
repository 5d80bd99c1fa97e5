"""The command line: `planner-jax` with `sweep`, `fly`, `serve`, `train`, `library`, `view`, ...

Tasks come from the registry, and the options of `sweep` and `fly` from the fields of a task's
settings: nothing here knows a task.
"""

import argparse
import contextlib
import dataclasses
import datetime
import functools
import math
import os
import pkgutil
import re
import shlex
import sys
import time
import typing
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from planner_jax.core.choices import CHOICES
from planner_jax.core.digits import written_number, written_whole
from planner_jax.core.errors import ArgumentError, MissingExtra, PlannerJaxError
from planner_jax.core.registry import Task, all_tasks, task_named
from planner_jax.host import signals as stopping
from planner_jax.host.compile_cache import keep_compiled_programs
from planner_jax.host.files import new_file_problem, replacing
from planner_jax.live.settings import SERVED
from planner_jax.runs.environment import installed_version, require_backend
from planner_jax.runs.settings import (
    WorkersFailed,
    ending_options,
    require_ending,
)

_HELP = argparse.RawDescriptionHelpFormatter
_FAILED, _BAD_ARGUMENT, _INTERRUPTED = 1, 2, 130
_TRAIN = "planner_jax.policies.settings:TrainSettings"
_THROUGHPUT = "planner_jax.benchmarks.throughput_settings:ThroughputSettings"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command of these arguments, by default those of the process.

    Returns:
        The exit code: 0, 1 where file system or workers fail, 2 for a bad argument, 130 after
        Ctrl-C. Where the process hears signals by `stopping.listen`, they end it.
    """
    try:
        with warnings.catch_warnings():  # of another package, such as a task that does not work
            warnings.simplefilter("always")
            warnings.showwarning = lambda told, *_, **__: print(
                f"planner-jax: warning: {told}", file=sys.stderr
            )
            words = sys.argv[1:] if arguments is None else arguments
            if any("\0" in word for word in words):
                return _fail("arguments must hold no NUL")
            options = vars(_parser().parse_args(words))
        return options.pop("command")(options) or 0
    except KeyboardInterrupt as stop:
        if stopping.is_told():
            stopping.leave()
        print(f"planner-jax: {str(stop) or 'interrupted'}", file=sys.stderr)
        return _INTERRUPTED
    except _NotFinished as error:
        _fail(str(error))
        return _FAILED
    except PlannerJaxError as error:
        return _fail(error)
    except MemoryError:
        _fail("the machine has not memory enough: ask for less at once")
        return _FAILED
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}{error.strerror or error}")
        return _FAILED


class _NotFinished(Exception):
    """The file system or workers failed while a run was under way; one line."""


_ARGUMENTS: set[str] = set()  # names of all options, as they are written in Python


def _fail(error: str | PlannerJaxError) -> int:
    """Print one line, in which an argument's name is written as on the command line."""
    if isinstance(error, ArgumentError | MissingExtra):
        error = error.renamed({name: f"--{name.replace('_', '-')}" for name in _ARGUMENTS})
    print(f"planner-jax: error: {' '.join(str(error).split())}", file=sys.stderr)
    return _BAD_ARGUMENT


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with an argument in one line; has no options until it is asked."""

    def __init__(self, *, fill: Callable[["_Parser"], None] = lambda parser: None, **look: Any):
        shape = functools.partial(_HELP, max_help_position=28, width=100)
        super().__init__(**{"formatter_class": shape, "allow_abbrev": False, **look})
        self._fill = fill
        # What is a number and no option: argparse's own pattern knows no exponents, before 3.14.
        self._negative_number_matcher = re.compile(r"-\.?[0-9]")

    def parse_known_args(self, *arguments: Any, **how: Any) -> Any:
        self._fill(self)
        return super().parse_known_args(*arguments, **how)

    def add(self, flag: str, **how: Any) -> None:
        """Add an option."""
        _ARGUMENTS.add(self.add_argument(flag, **how).dest)

    def error(self, message: str) -> NoReturn:
        sys.exit(_fail(message.removeprefix("argument ").replace(": must be", " must be", 1)))


def _written(read: Callable[[str], Any]) -> Callable[[str], Any]:
    """What makes a number of an option's word, by a function that raises `ValueError`."""

    def of(word: str) -> Any:
        try:
            return read(word)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return of


_whole, _number = _written(written_whole), _written(written_number)
_NUMBERS: dict[Any, Callable[[str], Any]] = {int: _whole, float: _number}


def _parser() -> _Parser:
    _ARGUMENTS.clear()  # of an earlier command in this process
    parser = _Parser(
        prog="planner-jax",
        description="Plan for robots that meet flying objects, thousands of cases at once.",
        epilog="examples:\n  planner-jax sweep hit --num 9000 --out runs/first\n"
        "  planner-jax sweep catch --suite triangle3 --num 1000",
    )
    version = f"planner-jax {installed_version('planner-jax') or 'of a source tree'}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(title="commands", required=True, metavar="command")

    def command(name: str, words: str, run: Callable) -> _Parser:
        added = commands.add_parser(name, help=words, description=words)
        added.set_defaults(command=run)
        return added

    hidden: Any = {"argument_default": argparse.SUPPRESS}
    for name, words, add in (
        ("plan", "plan and referee one case that is given in a few numbers", _add_plan),
        ("sweep", "plan and referee many cases of a task", _add_sweep),
        ("fly", "fly many cases of a task in closed loop", _add_fly),
    ):
        among = commands.add_parser(name, help=words)
        tasks = among.add_subparsers(title="tasks", required=True, metavar="task")
        for task in all_tasks().values():
            if {"sweep": task.sweep, "fly": task.flight, "plan": task.single}[name] is not None:
                # Settings are imported for the one task that is asked for.
                fill = functools.partial(add, task)
                tasks.add_parser(task.name, help=task.summary, fill=fill, **hidden)
    words = "train a policy that decides about catches"
    commands.add_parser("train", help=words, fill=_add_train, **hidden)
    library = commands.add_parser("library", help="motions that the block planner looks up")
    _add_library(library.add_subparsers(title="commands", required=True, metavar="command"))
    view = command("view", "play a run's flights in a browser", _view)
    view.add_argument("run", metavar="RUN", help="folder of a run of flights")
    view.add("--host", default="localhost", help="where to serve (default: localhost)")
    free = "0 takes a free one (default: 8080)"
    view.add("--port", type=_whole, default=8080, metavar="N", help=free)
    report = command("report", "write table, figures and page of a run anew", _report)
    report.add_argument("run", metavar="RUN", help="folder of a finished run")
    words = "ready robots with their main figures, or one of them as a YAML file to begin from"
    robots = command("robots", words, _robots)
    robots.add_argument("robot", metavar="NAME", nargs="?", help="one of them, or a file")
    words = "plan live for one robot: what it sees in, setpoints out, over UDP"
    serve = commands.add_parser("serve", help=words)
    served = serve.add_subparsers(title="tasks", required=True, metavar="task")
    for name, kind in SERVED.items():
        fill = functools.partial(_add_serve, kind)
        served.add_parser(name, help=task_named(name).summary, fill=fill, **hidden)
    words = "set runs side by side, and say which cases tell them apart"
    compare = command("compare", words, _compare)
    compare.add_argument("runs", nargs="+", metavar="RUN", help="folders of finished sweeps")
    compare.add("--all", action="store_true", help="list all cases that differ, not ten")
    compare.add("--out", metavar="FILE", help="new file, .csv, for the same as a table")
    words = "write a plan for a controller, or send it in real time"
    commands.add_parser("export", help=words, fill=_add_export, **hidden)
    bench = commands.add_parser("bench", help="measure this machine")
    kinds = bench.add_subparsers(title="benchmarks", required=True, metavar="benchmark")
    words = "plans a second, with success and cost"
    kinds.add_parser("throughput", help=words, fill=_add_throughput, **hidden)
    command("doctor", "versions, devices, precision, cache and a timed plan", _doctor)
    return parser


def _robots(options: dict[str, Any]) -> None:
    from planner_jax.robot.quadrotor_file import RobotError, as_yaml
    from planner_jax.robot.quadrotor_models import listing, robot_named

    name = options["robot"]
    try:
        print(listing() if name is None else as_yaml(robot_named(name)), end="")
    except RobotError as error:
        raise ArgumentError("NAME", f"a sound robot: {error}", shown="") from None


def _add_library(commands: Any) -> None:
    """What can be done with a file of stored motions."""
    hidden: Any = {"argument_default": argparse.SUPPRESS}

    def command(name: str, words: str) -> _Parser:
        added = commands.add_parser(name, help=words, description=words, **hidden)
        added.add_argument("path", metavar="FILE", help="of the library")
        added.set_defaults(command=functools.partial(_library, f"{name}_library"))
        return added

    build = command("build", "plan for every pair of cells; goes on where it was interrupted")
    build.add("--layout", metavar="NAME", help="full, or A, B, C, D of fewer (default: full)")
    build.add("--regime", metavar="NAME", help="limits of the joints: R1, R2, R3 (default: R2)")
    build.add("--no-pole", dest="pole", action="store_false", help="the scene without its pole")
    build.add("--arm", metavar="FILE", help="an MJCF file (default: the IRB 1600)")
    angles = "six angles [rad] where the arm waits, or six for each of several homes"
    build.add("--home", type=_number, nargs="+", metavar="Q", help=angles)
    show = command("show", "coverage, memory and hashes of a library")
    show.add("--map", metavar="FILE", help="write a picture of the coverage")
    check = command("check", "have the referee judge stored motions as answers to random balls")
    check.add("--num", type=_whole, metavar="N", help="balls for each home (default: 2000)")
    check.add("--seed", type=_whole, metavar="K", help="of the balls (default: 0)")
    repair = command("repair", "plan anew what touches a pole that has moved")
    place = "where it stands now [m]"
    repair.add("--pole", type=_number, nargs=2, metavar="M", help=place, required=True)
    repair.add("--out", metavar="FILE", help="of the new library", required=True)
    repair.add("--retry", action="store_true", help="pairs without a motion, too")


def _library(name: str, given: dict[str, Any]) -> None:
    keep_compiled_programs()
    from planner_jax.cli import library

    parts = Path(f"{given['path']}.parts")
    rest = functools.partial(_rest, parts, f"go on with: {_same_command()}", "what.json")
    rule = "FILE must be one that can be written"
    with stopping.under_way(rest, patient=False), _told_how_to_go_on(rest, rule):
        getattr(library, name)(**given)


def _add_train(parser: _Parser) -> None:
    kind = pkgutil.resolve_name(_TRAIN)
    parser.description = kind.DESCRIPTION
    _add_settings(parser, kind)
    parser.add("--out", metavar="DIR", help="folder of the run (default: runs/train)")
    parser.set_defaults(command=_train)


def _train(given: dict[str, Any]) -> None:
    out = _out(given) or "runs/train"
    settings = pkgutil.resolve_name(_TRAIN)(**given)
    require_backend()
    keep_compiled_programs()
    try:
        from planner_jax.policies.training import train_as_asked
    except ModuleNotFoundError as error:
        raise MissingExtra("train", error.name, "policies") from None
    rest = functools.partial(_rest, Path(out), f"go on with: {_same_command()}", "training.json")
    with stopping.under_way(rest), _told_how_to_go_on(rest):
        train_as_asked(settings, out)
    print(f"{Path(out) / 'policy.npz'}")


def _add_export(parser: _Parser) -> None:
    from planner_jax.export.api import FORMATS

    parser.description = (
        "One plan of a sweep, or of a file that plan.save wrote, in a format that controllers read."
    )
    parser.add_argument("plans", metavar="RUN", help="folder of a sweep, or a file of plans")
    rows = "of the plan, from 0; left out for a file that holds one plan"
    parser.add("--row", type=_whole, metavar="K", help=rows)
    formats = "; ".join(f"{name}: {form.summary}" for name, form in FORMATS.items())
    parser.add("--to", metavar="FORMAT", required=True, help=formats)
    parser.add("--rate", type=_number, metavar="HZ", help="setpoints a second (default: 100)")
    endings = "; ".join(f"{name}: {', '.join(form.writers)}" for name, form in FORMATS.items())
    name = "default: RUN-K-FORMAT with the first ending"
    parser.add("--out", metavar="FILE", help=f"new file; its ending says which ({endings}; {name})")
    port = "of this machine, to which px4 is sent in real time over UDP in the place of a file"
    parser.add("--udp", type=_whole, metavar="PORT", help=port)
    rest = "how a plan comes to rest behind its end, where it does not do so itself"
    parser.add("--ending", metavar="NAME", help=f"{rest}: {', '.join(CHOICES)} (default: brake)")
    parser.set_defaults(command=_export)


def _export(given: dict[str, Any]) -> None:
    from planner_jax.core.plan_files import PlanFileError
    from planner_jax.export import api

    source, row = given.pop("plans"), given.pop("row", None)
    out, udp = _out(given, "file"), given.pop("udp", None)
    require_ending(name := given.pop("ending", "brake"))
    ending = ending_options(name).get("ending")
    if out is not None and udp is not None:
        raise ArgumentError("udp", "given with --out", udp, verb="not be")
    try:
        out = out or api.default_name(source, row, given["to"])
        plan, against = _plan_of(source, row)
        lacks = ending is not None and api.lacks_ending(plan)
        given |= {"ending": ending, "case": _case_of(source, row, name) if lacks else None}
        if udp is None:
            told = str(api.export(plan, out=out, **given))
        else:
            told = f"{api.stream(plan, udp=udp, **given)} setpoints sent"
    except PlanFileError as error:
        raise error.renamed({"path": "RUN"}) from None
    if against:
        print(f"planner-jax: warning: row {row} fails the referee: {against}", file=sys.stderr)
    if lacks:
        rest = f"row {row} goes on to rest behind its end ({name}), within the limits of its case"
        print(f"planner-jax: {rest}; --ending none leaves that out", file=sys.stderr)
    print(told)


def _plan_of(source: str, row: int | None) -> tuple[Any, str]:
    """The plan of a row of a sweep or of a file, and what the referee says against it, if known."""
    if os.path.isdir(source):
        from planner_jax.runs.run_folder import RunFolder
        from planner_jax.sweep.rows import planned_row

        return planned_row(RunFolder(source, name="RUN"), row)
    from planner_jax.export.setpoints import load_plan

    if not os.path.exists(source):
        raise ArgumentError("RUN", "the folder of a sweep or a file of plans", source)
    return load_plan(source, row), ""


def _case_of(source: str, row: Any, ending: str) -> Any:
    """The case of a row of a sweep, whose limits a way to rest has to keep."""
    if not os.path.isdir(source):
        rule = "none for plans of a file that do not come to rest, as it does not hold their limits"
        raise ArgumentError("ending", rule, ending)
    from planner_jax.runs.run_folder import RunFolder
    from planner_jax.sweep.rows import case_of_row

    keep_compiled_programs()
    return case_of_row(RunFolder(source, name="RUN"), row)


def _add_serve(kind: type, parser: _Parser) -> None:
    parser.description = (
        "Takes what is seen of a ball and of the robot as packets of UDP on localhost, plans as\n"
        "soon as the ball is known, and answers every packet with the setpoints that are due."
    )
    _add_settings(parser, kind)
    parser.set_defaults(command=lambda given: _serve(kind(**given)))


def _serve(settings: Any) -> None:
    from planner_jax.live.planner import LivePlanner
    from planner_jax.live.server import Server, compute_in_place

    compute_in_place()
    require_backend()
    keep_compiled_programs()
    names = ("rate", "horizon", "deadline", "noise")
    options = {name: getattr(settings, name) for name in names}
    planner = LivePlanner(settings.stroke(), **options)
    server = Server(planner, settings.port)
    server.warm_up()
    report = server.planner.report
    rest = lambda: f"{report.counts['answered']:,} packets answered"  # noqa: E731
    with stopping.under_way(rest, bar=False), contextlib.closing(server):
        print(f"Answering on 127.0.0.1:{server.port}; Ctrl-C stops.", flush=True)
        ends = time.monotonic() + (settings.seconds or math.inf)
        server.run(lambda: not stopping.is_told() and time.monotonic() < ends)
        print("\n".join(report.lines() if settings.report else [report.headline()]), flush=True)
        stopping.check()


def _add_throughput(parser: _Parser) -> None:
    kind = pkgutil.resolve_name(_THROUGHPUT)
    parser.description = kind.DESCRIPTION
    _add_settings(parser, kind)
    parser.add("--out", metavar="DIR", help="run folder (default: runs/bench-throughput-DATE-TIME)")
    parser.set_defaults(command=_throughput)


def _add_settings(parser: _Parser, kind: Any, task: Task | None = None) -> None:
    """An option for every field of settings. One that is not given is absent from the namespace."""
    hints = typing.get_type_hints(kind)
    names = {"planner": task.all_planners(), "suite": task.all_suites()} if task else {}
    defaults: dict[str, Any] = {}
    if hasattr(kind, "DEFAULT_NUM"):
        batch = f"{kind.CPU_BATCH} on a CPU, {kind.GPU_BATCH} on a GPU"
        defaults = {"num": kind.DEFAULT_NUM, "batch": batch}
    for field in dataclasses.fields(kind):
        words, default = field.metadata["help"], field.default
        if field.name in names:
            words = ", ".join(names[field.name])
            defaults[field.name] = next(iter(names[field.name]))
        default = defaults.get(field.name) if default is None else default
        how: dict[str, Any] = {"action": "store_true"}
        if not isinstance(default, bool):
            if default not in (None, (), dataclasses.MISSING) and "(default:" not in words:
                shown = (
                    " ".join(f"{x:g}" for x in default) if isinstance(default, tuple) else default
                )
                words += f" (default: {shown})"
            how = {"type": _type_of(hints[field.name]), "metavar": field.metadata["metavar"]}
            how |= {"nargs": "+"} if isinstance(default, tuple) else {}
            how |= _of_several(field)
        parser.add(f"--{field.name.replace('_', '-')}", help=words, **how)


def _of_several(field: dataclasses.Field) -> dict[str, Any]:
    """How an option is read that has to be given, has as many numbers as names, or is repeated."""
    names = field.metadata["metavar"].split()
    how: dict[str, Any] = {"required": True} if field.default is dataclasses.MISSING else {}
    if len(names) > 1:
        how |= {"metavar": tuple(names), "nargs": len(names)}
        how |= {"action": "append"} if field.default == () else {}
    return how


def _type_of(hint: Any) -> Callable[[str], Any]:
    """What makes a value of a word: a number where a field holds these, or nothing."""
    held = typing.get_args(hint) or (hint,)
    if str in held:  # beside numbers, as where "uniform" may stand for three of them
        return str
    inner = [_type_of(kind) for kind in held if typing.get_args(kind)]
    return next((_NUMBERS[kind] for kind in held if kind in _NUMBERS), next(iter(inner), str))


def _add_sweep(task: Task, parser: _Parser) -> None:
    parser.description = (
        f"Many cases of one task, {task.summary}:\nplanned, and every plan judged by a referee.\n"
        "Writes a run folder: index.html, table.md, figures, plans (Parquet), manifest.json."
    )
    _add_settings(parser, pkgutil.resolve_name(task.sweep), task)
    where = f"run folder (default: runs/{task.name}-PLANNER-DATE-TIME)"
    parser.add("--out", metavar="DIR", help=where)
    parser.add("--resume", action="store_true", help="finish the interrupted run in --out")
    where = "ray: chunks are made by a Ray cluster, that of RAY_ADDRESS or one of this machine"
    parser.add("--workers", metavar="KIND", help=f"{where} (default: by this process)")
    parser.set_defaults(command=lambda given: _sweep(task, given))


def _add_plan(task: Task, parser: _Parser) -> None:
    parser.description = (
        f"One case, {task.summary}: planned, and the plan judged by a referee.\n"
        "Says when and where the contact is, and how close the plan comes to each limit."
    )
    _add_settings(parser, pkgutil.resolve_name(str(task.single)), task)
    parser.add("--rate", type=_number, metavar="HZ", help="setpoints a second (default: 100)")
    parser.add("--out", metavar="DIR", help="new folder for plan, setpoints and pictures")
    parser.set_defaults(command=lambda given: _plan(task, given))


def _plan(task: Task, given: dict[str, Any]) -> int:
    out, rate = _out(given), given.pop("rate", None)
    settings = pkgutil.resolve_name(str(task.single))(**given).of(task)
    if rate is not None and out is None:
        raise ArgumentError("rate", "left out without --out", rate)
    if out is not None and (problem := new_file_problem(out)):
        raise ArgumentError("out", problem.replace("file", "folder"), out)
    require_backend()
    keep_compiled_programs()
    single = pkgutil.resolve_name(settings.RUN)(task, settings)
    answer = single.answer()
    if rate is not None and answer.success:
        _require_rate(answer.plan, rate)
    print("\n".join(single.described(answer)))
    if out is not None:
        _write_answer(task, settings.planner, answer, Path(out), rate)
    return 0 if answer.success else _FAILED


def _require_rate(plan: Any, rate: float) -> None:
    """Raise `ArgumentError` unless a plan can be sampled at a rate [Hz]."""
    from planner_jax.export.setpoints import setpoints_of

    setpoints_of(plan, rate)


def _write_answer(task: Task, planner: str, answer: Any, out: Path, rate: float | None) -> None:
    """Write a new folder: the plan, its setpoints where the referee lets it pass, and pictures."""
    from planner_jax.export.api import export
    from planner_jax.sweep.single_pictures import write_pictures

    out.mkdir()
    written = [out / "plan.npz"]
    answer.plan.save(written[0])
    if answer.success:
        ending = None if answer.plan.ending is None else "brake"  # one of its own stays
        how = {"rate": rate, "ending": ending}
        written.append(export(answer.plan, to="csv", out=out / "setpoints.csv", **how))
    written += write_pictures(task, planner, answer, out)
    print("\n" + "\n".join(map(str, written)))


def _add_fly(task: Task, parser: _Parser) -> None:
    parser.description = (
        f"Many flights of one task, {task.summary},\n"
        "in MuJoCo MJX with noise and latency.\n"
        "Writes a run folder: index.html, table.md, a figure, plans and flights (Parquet),\n"
        "manifest.json."
    )
    kind = pkgutil.resolve_name(str(task.flight))
    _add_settings(parser, kind, task)
    kept = "flights kept look by look for `planner-jax view`, the first ones (default: 16)"
    parser.add("--record", type=_whole, metavar="K", help=kept)
    film = (
        "film the first three of these into the run folder, .gif, or .mp4 where ffmpeg is "
        "installed (default name: flights.gif)"
    )
    parser.add("--video", nargs="?", const="flights.gif", metavar="FILE", help=film)
    parser.add("--out", metavar="DIR", help=f"run folder (default: runs/fly-{task.name}-DATE-TIME)")
    parser.set_defaults(command=lambda given: _fly(task, kind, given))


def _out(given: dict[str, Any], kind: str = "folder") -> str | None:
    """The folder, or file, of the option `--out`, which is taken out of what was given.

    Args:
        given: options.
        kind: what it is.
    """
    out = given.pop("out", None)
    if out == "":
        raise ArgumentError("out", f"a {kind}", verb="name", shown="''")
    if out and "://" in out:
        raise ArgumentError("out", f"a {kind} of this machine", out)
    return out


def _run_folder(name: str) -> str:
    """The run folder of this name and moment."""
    return os.path.join("runs", f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S}")


def _sweep(task: Task, given: dict[str, Any]) -> None:
    resume, workers, out = given.pop("resume", False), given.pop("workers", None), _out(given)
    if resume and out is None:
        raise ArgumentError("out", "the folder to resume", verb="name", shown="nothing")
    settings = pkgutil.resolve_name(task.sweep)(**given).of(task)
    out = out or _run_folder(f"{task.name}-{task.split_planner(settings.planner)[0]}")
    settings.require_room(out)
    keep_compiled_programs()
    from planner_jax.sweep import run

    again = f"finish with: planner-jax sweep {task.name} --resume --out {shlex.quote(str(out))}"
    rest = functools.partial(_rest, Path(out), again)
    with stopping.under_way(rest), _told_how_to_go_on(rest):
        if resume:
            manifest = run.resume_sweep(task, out, workers=workers, **given)
        else:
            manifest = run.start_sweep(task, settings, out, workers=workers)
        _print_sweep(manifest, out)


def _same_command() -> str:
    """The command of this process, as a shell takes it."""
    return shlex.join(["planner-jax", *sys.argv[1:]])


def _rest(out: Path, again: str, sign: str = "manifest.json") -> str:
    """How to go on with a run that was stopped, where there is one yet, as that file says."""
    return again if (out / sign).exists() else stopping.NOTHING


@contextlib.contextmanager
def _told_how_to_go_on(
    rest: Callable[[], str], rule: str = "out must be a folder that can be written"
) -> Iterator[None]:
    """Add `rest()` to the message of an interruption, and of a file system or workers that fail."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; {rest()}") from None
    except WorkersFailed as error:
        raise _NotFinished(f"{error}; {rest()}") from None
    except OSError as error:
        shown = f"{error.filename!r} ({error.strerror or error})"
        raise _NotFinished(f"{rule}, got {shown}; {rest()}") from None


def _print_sweep(manifest: dict[str, Any], out: str) -> None:
    from planner_jax.runs.table import headline
    from planner_jax.sweep.sweep import sweep_of_run

    print("\n".join(headline(manifest, sweep_of_run(manifest).findings(manifest))))
    print(f"Look at {os.path.join(out, 'index.html')}")


def _fly(task: Task, kind: type, given: dict[str, Any]) -> None:
    out = _out(given) or _run_folder(f"fly-{task.name}")
    kept = {name: given.pop(name) for name in ("video", "record") if name in given}
    settings = kind(**given)
    keep_compiled_programs()
    from planner_jax.sims.run import start_flights

    with _told_how_to_go_on(lambda: "nothing is kept of these flights, fly again"):
        start_flights(settings, out, **kept)
    _print_flights(Path(out))


def _print_flights(out: Path) -> None:
    from planner_jax.runs.run_folder import RunFolder
    from planner_jax.sims.run import headline, read_flights

    manifest, flight, _ = read_flights(RunFolder(out))
    print("\n".join(headline(manifest, flight)))
    print(f"Look at {out / 'index.html'}, or play it: planner-jax view {shlex.quote(str(out))}")


def _view(options: dict[str, Any]) -> None:
    from planner_jax.runs.run_folder import RunFolder
    from planner_jax.sims.run import read_flights
    from planner_jax.sims.view import Viewer

    _, flight, recording = read_flights(RunFolder(options["run"], name="RUN"))
    viewer = Viewer(flight, recording, options["host"], options["port"])
    print(f"Playing {len(recording)} flights at {viewer.url}; Ctrl-C stops.", flush=True)
    viewer.run()


def _throughput(given: dict[str, Any]) -> None:
    out = _out(given)
    require_backend()
    keep_compiled_programs()
    from planner_jax.benchmarks.throughput import report

    report(out=out, **given)


def _report(options: dict[str, Any]) -> None:
    from planner_jax.runs.run_folder import RunFolder

    folder = RunFolder(options["run"], "RUN")
    manifest = folder.read_manifest()
    with folder.owned():
        if str(manifest["kind"]).startswith("fly "):
            from planner_jax.sims.run import require_sound, write_flight_report

            require_sound(folder)
            write_flight_report(folder)
            _print_flights(folder.path)
        else:
            from planner_jax.sweep.report import require_sound, write_report

            require_sound(folder)
            write_report(folder)
            _print_sweep(manifest, str(folder.path))


def _compare(options: dict[str, Any]) -> None:
    from planner_jax.sweep import compare

    out = _out(options, "file")
    if out is not None:
        _require_new_file(out, ".csv")
    runs = [compare.read_run(path) for path in options["runs"]]
    compare.require_comparable(runs)
    print("\n".join(compare.described(runs, None if options["all"] else 10)))
    if out is not None:
        with replacing(out) as scratch:
            scratch.write_text(compare.as_csv(runs), encoding="utf-8")


def _require_new_file(out: str, ending: str) -> None:
    """Raise `ArgumentError` unless a path of the option `--out` is that of a file to be made."""
    if not out.endswith(ending):
        raise ArgumentError("out", ending, out, verb="end in")
    if problem := new_file_problem(out):
        raise ArgumentError("out", problem, out)


def _doctor(options: dict[str, Any]) -> int:
    from planner_jax.cli.doctor import report

    return 0 if report() else _FAILED
