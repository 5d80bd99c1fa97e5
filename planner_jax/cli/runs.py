"""Commands on folders of many planned cases, simulated flights or policies: `sweep`, `fly`, ..."""

import contextlib
import os
import pkgutil
import shlex
import sys
from argparse import SUPPRESS
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from planner_jax.baselines.block.library.options import add_commands
from planner_jax.cli.options import Options, Parser, Unfinished, add_settings, pop_out
from planner_jax.core.errors import ArgumentError
from planner_jax.core.missing_extra import MissingExtra
from planner_jax.core.registry import Task
from planner_jax.host import signals as stopping
from planner_jax.host.compile_cache import keep_compiled_programs
from planner_jax.host.files import name_run_folder, new_file_problem, replacing
from planner_jax.runs.environment import require_backend
from planner_jax.runs.settings import WorkersFailed

_TRAIN = "planner_jax.policies.settings:TrainSettings"
_THROUGHPUT = "planner_jax.benchmarks.throughput_settings:ThroughputSettings"


def add_sweep(task: Task, parser: Parser) -> None:
    """Add the options of the command `planner-jax sweep` for one task to its parser."""
    parser.description = (
        f"Plan many cases of the task: {task.summary}.\nA referee judges every plan.\n"
        "Writes a run folder: index.html, table.md, figures, plans (Parquet), manifest.json."
    )
    add_settings(parser, pkgutil.resolve_name(task.sweep), task)
    where = f"run folder (default: runs/{task.name}-PLANNER-DATE-TIME)"
    parser.add("--out", metavar="DIR", help=where)
    parser.add("--resume", action="store_true", help="finish the interrupted run in --out")
    where = "ray: chunks are made by a Ray cluster, at RAY_ADDRESS or on this machine"
    parser.add("--workers", metavar="KIND", help=f"{where} (default: by this process)")
    parser.set_defaults(command=lambda given: _sweep(task, given))


def _sweep(task: Task, given: Options) -> None:
    resume, workers, out = given.pop("resume", False), given.pop("workers", None), pop_out(given)
    if resume and out is None:
        raise ArgumentError("out", "the folder to resume", verb="name", shown="nothing")
    settings = pkgutil.resolve_name(task.sweep)(**given).of(task)
    out = out or name_run_folder(f"{task.name}-{task.split_planner(settings.planner)[0]}")
    settings.require_disk_space(out)
    keep_compiled_programs()
    from planner_jax.sweep import run

    again = f"finish with: planner-jax sweep {task.name} --resume --out {shlex.quote(str(out))}"
    remainder = partial(_how_to_continue, Path(out), again)
    with stopping.under_way(remainder), _tell_how_to_continue(remainder):
        if resume:
            manifest = run.resume_sweep(task, out, workers=workers, **given)
        else:
            manifest = run.start_sweep(task, settings, out, workers=workers)
        _print_sweep(manifest, out)


def _print_sweep(manifest: Options, out: str) -> None:
    from planner_jax.runs.table import headline
    from planner_jax.sweep.sweep import sweep_of_run

    print("\n".join(headline(manifest, sweep_of_run(manifest).findings(manifest))))
    print(f"Look at {os.path.join(out, 'index.html')}")


def add_fly(task: Task, parser: Parser) -> None:
    """Add the options of the command `planner-jax fly` for one task to its parser."""
    parser.description = (
        f"Fly many cases of the task: {task.summary}.\n"
        "Flights are simulated in MuJoCo MJX with noise and latency.\n"
        "Writes a run folder: index.html, table.md, a figure, plans and flights (Parquet),\n"
        "manifest.json."
    )
    kind = pkgutil.resolve_name(str(task.flight))
    add_settings(parser, kind, task)
    recordings = "number of flights recorded for `planner-jax view`, the first ones (default: 16)"
    parser.add("--record", type=int, metavar="K", help=recordings)
    film = "film the first three of these into the run folder, .gif, or .mp4 if ffmpeg is installed"
    film += " (default name: flights.gif)"
    parser.add("--video", nargs="?", const="flights.gif", metavar="FILE", help=film)
    parser.add("--out", metavar="DIR", help=f"run folder (default: runs/fly-{task.name}-DATE-TIME)")
    parser.set_defaults(command=lambda given: _fly(task, kind, given))


def _fly(task: Task, kind: type, given: Options) -> None:
    out = pop_out(given) or name_run_folder(f"fly-{task.name}")
    recorded = {name: given.pop(name) for name in ("video", "record") if name in given}
    settings = kind(**given)
    keep_compiled_programs()
    from planner_jax.sims.run import start_flights

    with _tell_how_to_continue(lambda: "these flights are lost, fly again"):
        start_flights(settings, out, **recorded)
    _print_flights(Path(out))


def _print_flights(out: Path) -> None:
    from planner_jax.runs.run_folder import RunFolder
    from planner_jax.sims.run import headline, read_flights

    manifest, flight, _ = read_flights(RunFolder(out))
    print("\n".join(headline(manifest, flight)))
    print(f"Look at {out / 'index.html'}, or play it: planner-jax view {shlex.quote(str(out))}")


def add_train(parser: Parser) -> None:
    """Add the options of the command `planner-jax train` to its parser."""
    kind = pkgutil.resolve_name(_TRAIN)
    parser.description = kind.DESCRIPTION
    add_settings(parser, kind)
    parser.add("--out", metavar="DIR", help="folder of the run (default: runs/train)")
    parser.set_defaults(command=_train)


def _train(given: Options) -> None:
    out = pop_out(given) or "runs/train"
    settings = pkgutil.resolve_name(_TRAIN)(**given)
    require_backend()
    keep_compiled_programs()
    try:
        from planner_jax.policies.training import train_from_settings
    except ModuleNotFoundError as error:
        raise MissingExtra("train", error.name, "policies") from None
    remainder = partial(_how_to_continue, Path(out), _repeat_command(), "training.json")
    with stopping.under_way(remainder), _tell_how_to_continue(remainder):
        train_from_settings(settings, out)
    print(f"{Path(out) / 'policy.npz'}")


def report(options: Options) -> None:
    """Run the command `report`: write table, figures and page of a finished run again."""
    from planner_jax.runs.run_folder import RunFolder

    folder = RunFolder(options["run"], "RUN")
    manifest = folder.read_manifest()
    with folder.lock():
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


def compare(options: Options) -> None:
    """Run the command `compare`: print a comparison of runs, and write it as CSV if requested."""
    from planner_jax.sweep.compare import as_csv, describe, read_run, require_comparable

    out = pop_out(options, "file")
    if out is not None:
        if not out.endswith(".csv"):
            raise ArgumentError("out", ".csv", out, verb="end in")
        if problem := new_file_problem(out):
            raise ArgumentError("out", problem, out)
    runs = [read_run(path) for path in options["runs"]]
    require_comparable(runs)
    print("\n".join(describe(runs, None if options["all"] else 10)))
    if out is not None:
        with replacing(out) as scratch:
            scratch.write_text(as_csv(runs), encoding="utf-8")


def view(options: Options) -> None:
    """Run the command `view`: serve a 3-D view of a run's flights to a browser until Ctrl-C."""
    from planner_jax.runs.run_folder import RunFolder
    from planner_jax.sims.run import read_flights
    from planner_jax.sims.view import Viewer

    _, flight, recording = read_flights(RunFolder(options["run"], name="RUN"))
    viewer = Viewer(flight, recording, options["host"], options["port"])
    print(f"Playing {len(recording)} flights at {viewer.url}; Ctrl-C stops.", flush=True)
    viewer.run()


def add_throughput(parser: Parser) -> None:
    """Add the options of the command `planner-jax bench throughput` to its parser."""
    kind = pkgutil.resolve_name(_THROUGHPUT)
    parser.description = kind.DESCRIPTION
    add_settings(parser, kind)
    parser.add("--out", metavar="DIR", help="run folder (default: runs/bench-throughput-DATE-TIME)")
    parser.set_defaults(command=_throughput)


def _throughput(given: Options) -> None:
    out = pop_out(given)
    require_backend()
    keep_compiled_programs()
    from planner_jax.benchmarks.throughput import report as report_throughput

    report_throughput(out=out, **given)


def _repeat_command() -> str:
    return f"continue with: {shlex.join(['planner-jax', *sys.argv[1:]])}"


def _how_to_continue(out: Path, again: str, sign: str = "manifest.json") -> str:
    return again if (out / sign).exists() else stopping.NOTHING


@contextlib.contextmanager
def _tell_how_to_continue(
    remainder: Callable[[], str], rule: str = "--out must be a folder that can be written"
) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; {remainder()}") from None
    except WorkersFailed as error:
        raise Unfinished(f"--{error}; {remainder()}") from None
    except OSError as error:
        shown = f"{error.filename!r} ({error.strerror or error})"
        if error.filename is None:  # files that cannot be written are named
            rule, shown = "the standard output must be writable", str(error.strerror or error)
        raise Unfinished(f"{rule}, got {shown}; {remainder()}") from None


def add_library(library: Parser) -> None:
    """Add the commands `planner-jax library ...`, on stored motions of the arm, to the parser."""
    commands = library.add_subparsers(title="commands", required=True, metavar="command")

    def command(name: str, words: str) -> Callable[..., None]:
        added = commands.add_parser(name, help=words, description=words, argument_default=SUPPRESS)
        added.add_argument("path", metavar="FILE", help="of the library")
        added.set_defaults(command=partial(_library, name))
        return added.add

    add_commands(command)


def _library(name: str, given: Options) -> None:
    keep_compiled_programs()
    run = pkgutil.resolve_name(f"planner_jax.baselines.block.library.command:{name}_library")
    parts = Path(f"{given['path']}.parts")
    remainder = partial(_how_to_continue, parts, _repeat_command(), "what.json")
    rule = "FILE must be one that can be written"
    with stopping.under_way(remainder, patient=False), _tell_how_to_continue(remainder, rule):
        run(**given)
