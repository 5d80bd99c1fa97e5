"""Small run folders whose files tests damage, and checks of what readers of these files do."""

import contextlib
import dataclasses
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pytest

import planner_jax as pj
from planner_jax.core.errors import ArgumentError
from planner_jax.core.plan_files import PlanFileError
from planner_jax.planning.plan import plan
from planner_jax.policies.progress import to_text
from planner_jax.runs.dataset import Dataset
from planner_jax.runs.manifest import to_write
from planner_jax.runs.run_folder import RunFolder
from planner_jax.sims.recording import FLIGHTS, read_recording, to_rows
from planner_jax.sims.settings import CatchFly
from planner_jax.sweep.hit.settings import HitSettings
from planner_jax.sweep.hit.sweep import HitSweep
from planner_jax.sweep.run import SweepInterrupted, start_sweep
from planner_jax.task.hit.plan import HitPlan
from tests.faults.commands import Ended, is_one_line, run
from tests.faults.damage import damage
from tests.recordings import recording
from tests.sweeps import rows_of, stop_after

TASK = pj.task_named("hit")
SETTINGS = HitSettings(num=40, batch=13, seed=3)  # shares the program of tests/test_sweep.py
IDENTICAL, REFUSED, MENDED = "identical", "refused", "mended"


def make_runs(place: Path) -> None:
    start_sweep(TASK, SETTINGS, place / "whole", progress=False)
    other = dataclasses.replace(SETTINGS, seed=4)
    start_sweep(TASK, other, place / "other", progress=False)
    with pytest.MonkeyPatch.context() as patch, contextlib.suppress(SweepInterrupted):
        stop_after(patch, HitSweep, 3)
        start_sweep(TASK, SETTINGS, place / "begun", progress=False)
    make_flights(place / "flights")
    make_training(place / "training")
    cases = jax.tree.map(np.asarray, pj.hit.draw(3, seed=1))
    (place / "plans").mkdir()
    plan(HitSweep(TASK).planner(SETTINGS), cases, chunk=16).save(place / "plans" / "plans.npz")


def make_flights(out: Path) -> None:
    manifest = {"kind": "fly catch", "state": "complete", "seed": 0, "device": {}, "loop": {}}
    manifest |= {"parameters": dataclasses.asdict(CatchFly())}
    manifest |= {"times": {"compile_seconds": 0.0, "wall_seconds": 1.0}}
    summary = {"num": 1, "successes": 1, "success_rate": 1.0, "wilson_95": [0.2, 1.0]}
    summary |= {"tracking_rms_median": 0.0, "tracking_worst": 0.0}
    folder = RunFolder(out)
    with folder.lock():
        Dataset(out / FLIGHTS).write_rows(to_rows(recording()))
        folder.plans.write_rows(pa.table({"index": [0]}))
        folder.write_manifest({**manifest, "summary": summary})


def make_training(out: Path) -> None:
    out.mkdir()
    (out / "training.json").write_text(json.dumps(to_write({"suites": ["throws"], "seed": 0})))
    names = ("per_second", "reward", "solved", "last", "ratio", "violation")
    rows = [{"part": 0, "decisions": k, **{name: 0.5 + k for name in names}} for k in range(1, 4)]
    (out / "progress.jsonl").write_text(to_text(rows))


def verdict(place: Path, target: str, name: str, random: Any, scratch: Path) -> str:
    which, _, reader = target.partition(":")
    shutil.copytree(place / which, scratch)
    path = random.choice(sorted(scratch.glob(name)))
    before = path.read_bytes()
    how = damage(path, random)
    try:
        found = _READERS[reader](place, scratch)
    except Exception as error:
        raise AssertionError(f"{target}: {path.name} after {how}: {error!r}") from error
    finally:
        kept = path.read_bytes() if path.exists() else before
        shutil.rmtree(scratch, ignore_errors=True)
    assert found is not None, f"{target}: {path.name} after {how}, {len(kept)} bytes"
    return found


def _same_or_refused(ended: Ended, wanted: str) -> str | None:
    if ended.code == 0:
        return IDENTICAL if ended.out == wanted else None
    return REFUSED if is_one_line(ended) else None


def _report(place: Path, out: Path) -> str | None:
    ended = run("report", out)
    text = (place / "whole" / "table.md").read_text()
    same = (out / "table.md").exists() and (out / "table.md").read_text() == text
    return _same_or_refused(ended, ended.out if same and "plans/s" in ended.out else "")


def _resume(place: Path, out: Path) -> str | None:
    ended = run("sweep", "hit", "--resume", "--out", out)
    if ended.code:
        return REFUSED if is_one_line(ended) else None
    if rows_of(out) != rows_of(place / "whole") or "Traceback" in ended.err:
        return None
    return MENDED if "planned again" in ended.err else IDENTICAL


def _view(place: Path, out: Path) -> str | None:
    shown: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        closes_at_once = SimpleNamespace(url="nowhere", run=lambda: None)
        viewer = SimpleNamespace(Viewer=lambda _, found, *__: shown.append(found) or closes_at_once)
        patch.setitem(__import__("sys").modules, "planner_jax.sims.view", viewer)
        ended = run("view", out)
    if ended.code:
        return REFUSED if is_one_line(ended) else None
    wanted = vars(read_recording(Dataset(place / "flights" / FLIGHTS).read()))
    same = [
        np.array_equal(getattr(shown[0], name), value, equal_nan=value.dtype.kind == "f")
        for name, value in wanted.items()
    ]
    return IDENTICAL if all(same) else None


def _curves(place: Path, out: Path) -> str | None:
    from planner_jax.policies import curves

    drawn: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(curves.style, "draw", lambda *data: drawn.append(data[-1]))
        try:
            curves.draw_curves([out], out / "curves.png")
        except ArgumentError as error:
            return REFUSED if "\n" not in str(error) else None
        curves.draw_curves([place / "training"], out / "curves.png")
    return IDENTICAL if drawn[0] == drawn[1] else None


def _load(place: Path, out: Path) -> str | None:
    wanted = HitPlan.load(place / "plans" / "plans.npz")
    try:
        found = HitPlan.load(out / "plans.npz")
    except PlanFileError as error:
        return REFUSED if "\n" not in str(error) else None
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    same = all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in pairs)
    return IDENTICAL if same else None


_READERS = {"report": _report, "resume": _resume, "view": _view, "curves": _curves, "load": _load}
# Name of a group of files -> pairs of "RUN:READER" (a small run, and the program that reads it) and
# a pattern of the files in the run's folder that are damaged.
TARGETS = {
    "manifest": [("whole:report", "manifest.json"), ("whole:resume", "manifest.json")],
    "manifest of an interrupted run": [("begun:resume", "manifest.json")],
    "parts of an interrupted run": [("begun:resume", "plans/*.parquet")],
    "parts": [("whole:report", "plans/*.parquet"), ("whole:resume", "plans/*.parquet")],
    "flights": [("flights:view", "flights/*.parquet"), ("flights:view", "manifest.json")],
    "training": [("training:curves", "training.json"), ("training:curves", "progress.jsonl")],
    "plans.npz": [("plans:load", "plans.npz")],
}


def copy_run(place: Path, which: str, under: Path) -> Path:
    return Path(shutil.copytree(place / which, under / which))
