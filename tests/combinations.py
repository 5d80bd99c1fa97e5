"""Every command with every task, suite, planner and option, as the registry lists them.

`python -m tests.combinations` runs all of them, and prints how many ran and how many were refused.
Words behind it, such as `sweep rally`, select the combinations that contain all of these words. A
combination must run, or be refused by one line. A new task, suite or planner is in the table
without an edit of this module.
"""

import collections
import dataclasses
import functools
import os
import pkgutil
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import yaml

from planner_jax.core.choices import CHOICES, EFFORTS
from planner_jax.core.registry import Task
from planner_jax.core.tasks import all_tasks
from planner_jax.export.api import FORMATS
from planner_jax.robot.quadrotor_file import to_yaml
from planner_jax.robot.quadrotor_model import RotorDrag
from planner_jax.robot.quadrotor_models import MODELS
from tests.faults.commands import Ended, is_one_line, run

# Arguments of `planner-jax plan` for one case of a task; tasks without an entry have none.
CASES = {
    "hit": "--pos 4 0 1 --vel -3 0.2 4 --target 4 0 0",
    "catch": "--pos 3 0 1 --vel -3 0.2 4 --horizon 1.2",
    "intercept": "--map case.yaml",
    "block": "--pos 9 0 1 --vel -8 0 5",
}
MAP = {"target": {"position": [3.0, 4.6], "velocity": [0.0, -0.1]}, "time": 4.0, "speed": 1.6}
ROBOTS = {model.tool.kind: model for model in MODELS.values()}  # one robot for each kind of tool
# Options beside the fields of the settings of a command.
BESIDE = {"sweep": {"resume", "workers"}, "fly": set(), "plan": set(), "bench": set()}
RUNS, REFUSED, EITHER = "runs", "is refused", "runs or is refused"


class Combination(NamedTuple):
    """A command line, how it must end, and the text that its error message must contain."""

    words: tuple[str, ...]
    must: str = EITHER
    line: str = ""

    def __str__(self) -> str:
        return " ".join(self.words)


def options_of(task: Task) -> dict[str, list[tuple[str, ...]]]:
    """Return the options that are crossed with every command and task: name -> their words."""
    try:
        decisions = list(pkgutil.resolve_name(f"{task.home}.spec:DECISIONS"))
    except (AttributeError, ImportError):
        decisions = ["greedy"]
    wind, windy = ("--wind", "1", "0", "0"), [f"{kind}.yaml" for kind in ROBOTS]
    return {
        "decide": [("--decide", name) for name in decisions],
        "effort": [("--effort", name) for name in EFFORTS],
        "recovery": [("--recovery", name) for name in CHOICES],
        "robot": [("--robot", model.name) for model in ROBOTS.values()],
        "wind": [wind, *((*wind, "--robot", file) for file in windy)],
        "observer": [("--observer", "published")],
        "robot_filter": [("--robot-filter",)],
        "resume": [("--resume",)],
        "workers": [("--workers", "ray")],
    }


def settings_of(command: str, task: Task) -> set[str]:
    """Return the names of the options of a command for a task; none: the command lacks the task."""
    name = {"fly": task.flight, "plan": task.single}.get(command, task.sweep)
    if name is None:
        return set()
    names = {field.name for field in dataclasses.fields(pkgutil.resolve_name(name))}
    return names & {"planner", "suite", "effort"} if command == "bench" else names | BESIDE[command]


def cross(command: str, task: Task) -> Iterator[Combination]:
    """Yield the combinations of a command and a task with every suite, planner and option."""
    start = (command, task.name, "--num", "1")
    if command == "plan":
        start = ("plan", task.name, *CASES.get(task.name, "").split())
    elif command == "bench":
        start = ("bench", "throughput", "--task", task.name, "--batch", "2", "--repeat", "1")
    names = settings_of(command, task)
    if not names:
        yield Combination(start, REFUSED, f"'{task.name}' (choose from")
        return
    suites = [("--suite", name) for name in task.all_suites()] if "suite" in names else [()]
    own = [name for name in task.all_planners() if name not in task.from_file]
    for suite in suites:
        yield Combination((*start, *suite), EITHER if command == "plan" else RUNS)
        yield from (Combination((*start, *suite, "--planner", name)) for name in own)
    for name in task.from_file:
        yield Combination((*start, "--planner", name), REFUSED, "--planner must name its file")
    place = "bench throughput" if command == "bench" else f"{command} {task.name}"
    for name, options in options_of(task).items():
        for words in options:
            line = f"unrecognized arguments: {' '.join(words)}; `planner-jax {place} --help` lists"
            if name == "effort" and command == "bench":
                line = f"--effort must be left out for the task {task.name}"
            fields = (word[2:].replace("-", "_") for word in words if word.startswith("--"))
            there = names.issuperset(fields)
            if there or name in names or "--robot" not in words:
                yield Combination((*start, *words), *(() if there else (REFUSED, line)))


def use_runs(command: str, task: Task) -> Iterator[Combination]:
    """Yield a run of a task, and the commands that read the run's folder."""
    folder = f"{command}-{task.name}"
    yield Combination((command, task.name, "--num", "1", "--out", folder), RUNS)
    yield Combination(("report", folder), RUNS)
    if command == "sweep":
        yield Combination(("sweep", task.name, "--resume", "--out", folder), RUNS)
    for name, form in FORMATS.items():
        for recovery in CHOICES:
            out = f"{folder}-{recovery}-{name}{next(iter(form.writers))}"
            how = ("--to", name, "--recovery", recovery, "--out", out)
            yield Combination(("export", folder, "--row", "0", *how))


@functools.cache
def all_combinations() -> dict[str, tuple[Combination, ...]]:
    """Return the table: groups by name, such as "sweep hit". A group's combinations run in turn."""
    found: dict[str, tuple[Combination, ...]] = {}
    for task in all_tasks().values():
        for command in BESIDE:
            found[f"{command} {task.name}"] = tuple(cross(command, task))
        for command in ("sweep", "fly"):
            if settings_of(command, task):
                found[f"runs of {command} {task.name}"] = tuple(use_runs(command, task))
    return found


def fault_of(combination: Combination, ended: Ended) -> str:
    """Return what is wrong with the end of a command; "" if nothing is."""
    # A command `plan` whose plan the referee rejects ends with code 1 and prints the verdict.
    has_run = ended.code == 0 or (ended.code == 1 and "Referee" in ended.out)
    is_refused = ended.code == 2 and is_one_line(ended)
    is_right = {RUNS: has_run, REFUSED: is_refused, EITHER: has_run or is_refused}
    if is_right[combination.must] and combination.line in ended.err:
        return ""
    return f"{combination} ends with {ended.code}, {ended.err[-400:]!r}"


def run_all(chosen: Iterable[Combination]) -> Iterator[tuple[Combination, Ended, str]]:
    """Run combinations in the current folder; yield each with its end and its fault."""
    (Path.cwd() / "case.yaml").write_text(yaml.safe_dump(MAP))
    for kind, model in ROBOTS.items():
        windy = dataclasses.replace(model, name=f"windy-{kind}", drag=RotorDrag(0.3, 0.5))
        (Path.cwd() / f"{kind}.yaml").write_text(to_yaml(windy))
    for combination in chosen:
        try:
            ended = run(*combination.words)
            yield combination, ended, fault_of(combination, ended)
        except Exception as error:  # of any class: no command may raise one
            trace = "".join(traceback.format_exception(error, limit=-3))
            yield combination, Ended(1, "", trace), f"{combination} raises {error!r}"


def main(words: list[str]) -> int:
    """Run the combinations that contain all words; print each, and the counts."""
    table = [each for group in all_combinations().values() for each in group]
    chosen = [each for each in table if set(words) <= set(each.words)]
    counts: collections.Counter[str] = collections.Counter()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for combination, ended, fault in run_all(chosen):
            outcome = "FAULT" if fault else "refused" if ended.code == 2 else "ran"
            counts[outcome] += 1
            print(f"{time.monotonic() - began:7.1f} s {outcome:8s}{combination}", flush=True)
            if outcome != "ran":
                print("    " + ended.err.strip().replace("\n", "\n    "), flush=True)
        os.chdir("/")
    print(
        f"{len(chosen):,} combinations: {counts['ran']:,} ran, {counts['refused']:,} were refused "
        f"in one line, {counts['FAULT']:,} did neither"
    )
    return 1 if counts["FAULT"] else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
