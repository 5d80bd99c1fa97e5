"""Files of serves for hits by a quadrotor, and of their outcomes, published with [Yu2023bat]."""

import math
import os
import re
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from planner_jax.core.checks import require_path_name
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.host.files import read_plain
from planner_jax.task.hit import court
from planner_jax.task.hit.court import landing
from planner_jax.task.hit.spec import DRAG
from planner_jax.task.hit.suites import GRAVITY, Serves

_FILE_NAME = re.compile(r"([1-4])_([1-4])_([1-4])_([plb])\.csv")
_FILE_PLANNER = {"p": "bat", "l": "bat-lite", "b": "juggle"}
_SERVE_COLUMNS = ("serve position", "serve velocity", "landing position", "target")
_HIT_COLUMNS = (("hitting position", 3), ("hitting velocity", 3), ("hitting attitude", 4))
_LARGEST = 1 << 20  # [B] greatest size of a trial file; the published files have 1,000 lines
_LISTED = 5  # greatest number of problems that an error message lists

# Line number -> 12 numbers of a serve (`Trial.numbers`: positions, velocity, target), and whether
# the planner solved it; None if parsing failed.
_Table: TypeAlias = dict[int, tuple[list[float], bool] | None]


class Trial(NamedTuple):
    """One serve of a trial file, and which published planners solved it."""

    line: int  # line number in the file, from 1
    scenario: int  # index in court.SCENARIOS
    file: str
    numbers: list[float]  # 12: serve position, serve velocity, landing position, target
    solved: tuple[float, ...]  # by court.PLANNERS: 1 planned, 0 failed, NaN not published


def read_serves(folder: str | os.PathLike) -> Serves:
    """Read all serves of a folder of published trial files, sorted by line and scenario.

    A wrong file or line raises `ArgumentError`, which lists up to five problems.
    """
    problems: list[str] = []
    trials: list[Trial] = []
    for scenario, paths in _find_trial_files(folder).items():
        tables = {letter: _read_file(path, problems) for letter, path in paths.items()}
        full = {letter: table for letter, table in tables.items() if table}
        trials += _merge(scenario, paths, full, problems)
    trials.sort(key=lambda trial: (trial.line, trial.scenario))
    problems += _list_out_of_play(trials)
    if problems:
        listed = "; ".join(problems[:_LISTED])
        rest = f"; and {len(problems) - _LISTED} more" if len(problems) > _LISTED else ""
        rule = f"sound, not as in {str(folder)!r}: {listed}{rest}"
        raise ArgumentError("serves", rule, tuple(problems), shown="")
    numbers = np.array([trial.numbers for trial in trials])
    return Serves(
        position=numbers[:, 0:3],
        velocity=numbers[:, 3:6],
        target=numbers[:, 9:12],
        scenario=np.array([trial.scenario for trial in trials]),
        index=np.arange(len(trials)),
        published=np.array([trial.solved for trial in trials]),
        file=np.array([trial.file for trial in trials]),
        line=np.array([trial.line for trial in trials]),
    )


def _find_trial_files(folder) -> dict[int, dict[str, Path]]:
    require_path_name("serves", folder)
    folder = Path(folder)
    require(folder.is_dir(), "serves", "an existing folder", str(folder))
    files: dict[int, dict[str, Path]] = {}
    for path in sorted(folder.iterdir()):
        if match := _FILE_NAME.fullmatch(path.name):
            name = "".join(court.REGIONS[int(code) - 1] for code in match.groups()[:3])
            if name not in court.SCENARIOS:
                raise ArgumentError(
                    "serves",
                    f"one of the court's {len(court.SCENARIOS)} scenarios",
                    verb="name",
                    shown=f"{path.name} ({name}, the mirror image of another)",
                )
            files.setdefault(court.SCENARIOS.index(name), {})[match[4]] = path
    shown = f"none in {str(folder)!r}"
    require(bool(files), "serves", "a folder of S_L_T_M.csv files", shown=shown)
    return files


def _read_file(path: Path, problems: list[str]) -> _Table:
    """Read the table of one trial file; append a problem for each line that does not parse."""
    try:
        lines = read_plain(path, _LARGEST).decode("utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        problems.append(f"{path.name}: file must be readable, got {error.strerror}")
        return {}
    rows: _Table = {}
    for number, line in enumerate(lines, start=1):
        if number == 1 and line.startswith("number,") or not line.strip():
            continue
        try:
            rows[number] = _parse(line)
        except ValueError as error:
            rows[number] = None
            problems.append(f"{path.name}:{number}: {error}")
    if not rows:
        problems.append(f"{path.name}: file must have a row of numbers, got {len(lines)} lines")
    return rows


def _parse(line: str) -> tuple[list[float], bool]:
    cells = [cell.strip() for cell in line.split(",")]
    if len(cells) != 8:
        raise ArgumentError("row", "8 columns between commas", len(cells), verb="have")
    numbers = []
    for name, cell in zip(_SERVE_COLUMNS, cells[1:5], strict=True):
        numbers += _vector(name, cell, 3)
    solved = cells[5:] != ["failed"] * 3
    if solved:
        for (name, size), cell in zip(_HIT_COLUMNS, cells[5:], strict=True):
            _vector(name, cell, size)
    return numbers, solved


def _vector(name: str, cell: str, size: int) -> list[float]:
    try:
        vector = [float(word) for word in cell.split()]
    except ValueError:
        vector = []
    is_valid = len(vector) == size and all(map(math.isfinite, vector))
    require(is_valid, name, f"{size} finite numbers", cell)
    return vector


def _merge(
    scenario: int, paths: dict[str, Path], tables: dict[str, _Table], problems: list[str]
) -> list[Trial]:
    trials = []
    for line in sorted(set().union(*tables.values())):
        present = [letter for letter, table in tables.items() if line in table]
        rule = f"serve must be the one in {paths[present[0]].name}"
        problems += [
            f"{paths[letter].name}:{line}: {rule}, got no such line"
            for letter in tables.keys() - present
        ]
        rows = {letter: row for letter in present if (row := tables[letter][line]) is not None}
        if len(rows) < len(tables):
            continue
        numbers, _ = rows[present[0]]
        problems += [
            f"{paths[letter].name}:{line}: {rule}, {numbers}, got {other}"
            for letter, (other, _) in rows.items()
            if other != numbers
        ]
        outcome = {_FILE_PLANNER[letter]: float(solved) for letter, (_, solved) in rows.items()}
        solved = tuple(outcome.get(planner, math.nan) for planner in court.PLANNERS)
        trials.append(Trial(line, scenario, paths[present[0]].name, numbers, solved))
    return trials


def _list_out_of_play(trials: list[Trial]) -> list[str]:
    """List the serves that start below the ground or land outside the hitting half, x < 0."""
    numbers = np.array([trial.numbers for trial in trials]).reshape(-1, 12)
    height = numbers[:, 2]
    position = np.column_stack([numbers[:, :2], np.where(height > 0.0, height, 1.0)])
    _, point = landing(position, numbers[:, 3:6], DRAG, GRAVITY)
    problems = []
    for trial, z, x in zip(trials, height, point[:, 0], strict=True):
        where = f"{trial.file}:{trial.line}"
        if z <= 0.0:
            problems.append(f"{where}: serve height must be > 0, got {z:g}")
        elif not x < 0.0:
            problems.append(f"{where}: serve must land in the hitting half, x < 0, got x = {x:.3g}")
    return problems
