"""Commands for one case, one plan or one robot: `plan`, `export`, `serve`, `robots`."""

import contextlib
import math
import os
import pkgutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from planner_jax.cli.options import (
    FAILED,
    Options,
    Parser,
    add_settings,
    pop_out,
    warnings_in_one_line,
)
from planner_jax.core.choices import CHOICES, require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.registry import Task
from planner_jax.host import signals as stopping
from planner_jax.host.compile_cache import keep_compiled_programs
from planner_jax.host.files import new_file_problem
from planner_jax.live.settings import ServeSettings
from planner_jax.runs.environment import require_backend
from planner_jax.runs.settings import recovery_options

if TYPE_CHECKING:
    from planner_jax.cli.plan.answer import Answer, Single
    from planner_jax.core.protocol import Plan
    from planner_jax.core.rules import Case


def add_plan(task: Task, parser: Parser) -> None:
    """Add the options of the command `planner-jax plan` for one task to its parser."""
    parser.description = (
        f"Plan one case of the task: {task.summary}. A referee judges the plan.\n"
        "Prints time and position of the contact, and how close the plan comes to each limit."
    )
    add_settings(parser, pkgutil.resolve_name(str(task.single)), task)
    parser.add("--rate", type=float, metavar="HZ", help="setpoints a second (default: 100)")
    parser.add("--out", metavar="DIR", help="new folder for plan, setpoints and pictures")
    parser.set_defaults(command=lambda given: _plan(task, given))


def _plan(task: Task, given: Options) -> int:
    out, rate = pop_out(given), given.pop("rate", None)
    settings = pkgutil.resolve_name(str(task.single))(**given).of(task)
    require(rate is None or out is not None, "rate", "left out without --out", rate)
    if out is not None and (problem := new_file_problem(out)):
        raise ArgumentError("out", problem.replace("file", "folder"), out)
    require_backend()
    keep_compiled_programs()
    single = pkgutil.resolve_name(settings.RUN)(task, settings)
    answer = single.answer()
    if rate is not None and answer.success:
        from planner_jax.export.setpoints import setpoints_of

        setpoints_of(answer.plan, rate)  # raises an error if the plan does not allow this rate
    print("\n".join(single.describe(answer)))
    if out is not None:
        _write_answer(single, answer, Path(out), rate)
    single.play(answer)
    return 0 if answer.success else FAILED


def _write_answer(single: "Single", answer: "Answer", out: Path, rate: float | None) -> None:
    from planner_jax.export.api import export
    from planner_jax.robot.quadrotor import QuadrotorPlan

    out.mkdir()
    written = [out / "plan.npz"]
    answer.plan.save(written[0])
    if answer.success:
        # The file of setpoints ends with the plan's own trajectory to standstill, if it has one.
        plan = answer.plan
        is_rested = isinstance(plan, QuadrotorPlan) and plan.recovery is not None
        how = {"rate": rate, "recovery": "brake" if is_rested else None, "case": answer.case}
        written.append(export(answer.plan, to="csv", out=out / "setpoints.csv", **how))
    written += single.write_pictures(answer, out)
    print("\n" + "\n".join(map(str, written)))


def add_export(parser: Parser) -> None:
    """Add the options of the command `planner-jax export` to its parser."""
    from planner_jax.export.api import FORMATS

    parser.description = (
        "One plan of a sweep, or of a file that plan.save wrote, in a format that controllers read."
    )
    parser.add_argument("plans", metavar="RUN", help="folder of a sweep, or a file of plans")
    rows = "index of the plan, from 0; left out for a file with one plan"
    parser.add("--row", type=int, metavar="K", help=rows)
    formats = "; ".join(f"{name}: {form.summary}" for name, form in FORMATS.items())
    parser.add("--to", metavar="FORMAT", required=True, help=formats)
    parser.add("--rate", type=float, metavar="HZ", help="setpoints a second (default: 100)")
    endings = "; ".join(f"{name}: {', '.join(form.writers)}" for name, form in FORMATS.items())
    name = "default: RUN-K-FORMAT with the first ending"
    parser.add("--out", metavar="FILE", help=f"new file; its ending says which ({endings}; {name})")
    port = "port of this machine that receives px4 in real time over UDP, instead of a file"
    parser.add("--udp", type=int, metavar="PORT", help=port)
    rest = "recovery trajectory behind a plan that does not end at rest"
    parser.add("--recovery", metavar="NAME", help=f"{rest}: {', '.join(CHOICES)} (default: brake)")
    names = "names of an arm's joints, separated by commas (default: the names of the arm's file)"
    parser.add("--joint-names", metavar="NAMES", help=names)
    parser.set_defaults(command=_export)


def _export(given: Options) -> None:
    from planner_jax.core.plan_files import PlanFileError
    from planner_jax.export import api
    from planner_jax.robot.arm import ArmPlan

    source, row = given.pop("plans"), given.pop("row", None)
    out, udp = pop_out(given, "file"), given.pop("udp", None)
    name, names = given.pop("recovery", "brake"), given.pop("joint_names", None)
    recovery = recovery_options(name).get("recovery")
    if out is not None and udp is not None:
        raise ArgumentError("udp", "given with --out", udp, verb="not be")
    try:
        out = out or api.default_name(source, row, given["to"])
        plan, against = _plan_of(source, row)
        lacks = recovery is not None and api.lacks_recovery(plan)
        needs_case = lacks or (isinstance(plan, ArmPlan) and os.path.isdir(source))
        given |= {"recovery": recovery, "case": _case_of(source, row, name) if needs_case else None}
        if udp is None:
            names = names and names.split(",")
            with warnings_in_one_line():
                written = str(api.export(plan, out=out, joint_names=names, **given))
        else:
            written = f"{api.stream(plan, udp=udp, **given)} setpoints sent"
    except PlanFileError as error:
        raise error.with_names({"path": "RUN"}) from None
    if against:
        print(f"planner-jax: warning: row {row} fails the referee: {against}", file=sys.stderr)
    if lacks:
        rest = f"row {row} is extended by a recovery trajectory ({name}) within its case's limits"
        print(f"planner-jax: {rest}; --recovery none leaves it out", file=sys.stderr)
    print(written)


def _plan_of(source: str, row: int | None) -> "tuple[Plan, str]":
    if os.path.isdir(source):
        from planner_jax.runs.run_folder import RunFolder
        from planner_jax.sweep.rows import read_plan

        return read_plan(RunFolder(source, name="RUN"), row)
    from planner_jax.export.setpoints import load_plan

    if not os.path.exists(source):
        raise ArgumentError("RUN", "the folder of a sweep or a file of plans", source)
    return load_plan(source, row), ""


def _case_of(source: str, row: int | None, recovery: str) -> "Case":
    if row is None or not os.path.isdir(source):
        rule = "none for plans of a file that do not come to rest, as it does not hold their limits"
        raise ArgumentError("recovery", rule, recovery)
    from planner_jax.runs.run_folder import RunFolder
    from planner_jax.sweep.rows import case_of_row

    keep_compiled_programs()
    return case_of_row(RunFolder(source, name="RUN"), row)


def add_serve(kind: type[ServeSettings], parser: Parser) -> None:
    """Add the options of the command `planner-jax serve` for one task to its parser."""
    parser.description = (
        "Receives observations of a ball and of the robot as UDP packets on localhost, plans as\n"
        "soon as the ball is known, and answers every packet with the setpoints that are due."
    )
    add_settings(parser, kind)
    parser.set_defaults(command=lambda given: _serve(kind(**given)))


def _serve(settings: ServeSettings) -> None:
    from planner_jax.live.planner import LivePlanner
    from planner_jax.live.server import Server, compute_in_place

    compute_in_place()
    require_backend()
    keep_compiled_programs()
    options = {name: vars(settings)[name] for name in ("rate", "horizon", "deadline", "noise")}
    server = Server(LivePlanner(settings.stroke(), **options), settings.port)
    print("Compiling the planner.", file=sys.stderr, flush=True)
    server.warm_up(lambda line: print(line, file=sys.stderr, flush=True))
    report = server.planner.report
    remainder = lambda: f"{report.counts['answered']:,} packets answered"  # noqa: E731
    with stopping.under_way(remainder, bar=False), contextlib.closing(server):
        waits = "waiting for states of the robot and observations of balls"
        print(f"Answering on 127.0.0.1:{server.port}; {waits}; Ctrl-C stops.", flush=True)
        ends = time.monotonic() + (settings.seconds or math.inf)
        server.run(lambda: not stopping.is_stopped() and time.monotonic() < ends)
        print("\n".join(report.lines() if settings.report else [report.headline()]), flush=True)
        stopping.check()


def robots(options: Options) -> None:
    """Run the command `robots`: print a table of the known robots, or one robot as YAML."""
    from planner_jax.robot.quadrotor_file import RobotError, to_yaml
    from planner_jax.robot.quadrotor_models import format_models, robot_named

    name = options["robot"]
    try:
        print(format_models() if name is None else to_yaml(robot_named(name)), end="")
    except RobotError as error:
        raise ArgumentError("NAME", f"a sound robot: {error}", shown="") from None
