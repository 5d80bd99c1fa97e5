"""Damaged run files are rejected with one line, planned again, or read without any difference."""

import json
import os
import shutil
import uuid
import zlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from planner_jax.core.errors import ArgumentError
from planner_jax.runs.manifest import parse_object
from planner_jax.runs.run_folder import RunFolder
from planner_jax.sweep.hit.sweep import HitSweep
from planner_jax.sweep.run import resume_sweep
from tests.faults.commands import is_one_line, run
from tests.faults.runs import TARGETS, TASK, copy_run, verdict
from tests.sweeps import rows_of


@pytest.mark.parametrize("what", TARGETS)
@settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(random=st.randoms(use_true_random=False), choice=st.integers(0, 7))
def test_damage_is_refused_in_one_line_or_mended_or_changes_nothing(runs, what, random, choice):
    targets = TARGETS[what]
    target, name = targets[choice % len(targets)]
    verdict(runs, target, name, random, runs / uuid.uuid4().hex)


def manifest_of(out):
    return parse_object((out / "manifest.json").read_text())


def assert_resumed(runs, out, *told, planned=None):
    ended = run("sweep", "hit", "--resume", "--out", out)
    assert ended.code == 0 and all(part in ended.err for part in told)
    assert planned is None or ended.err.count("planned again") == planned
    assert rows_of(out) == rows_of(runs / "whole")


@pytest.mark.parametrize(
    ("found", "told"),
    [(1, "has format 1, and"), (3, "has format 3, and"), (None, "has no format, and")],
)
def test_another_format_is_named_beside_the_one_that_is_understood(runs, tmp_path, found, told):
    out = copy_run(runs, "whole", tmp_path)
    manifest = {**manifest_of(out), "format": found}
    (out / "manifest.json").write_text(json.dumps(manifest))
    ended = run("report", out)
    assert is_one_line(ended) and told in ended.err and "reads format 2 alone" in ended.err


def test_an_edited_manifest_is_refused(runs, tmp_path):
    out = copy_run(runs, "begun", tmp_path)
    text = (out / "manifest.json").read_text()
    (out / "manifest.json").write_text(text.replace('"batch": 13', '"batch": 7'))
    ended = run("sweep", "hit", "--resume", "--out", out)
    assert is_one_line(ended) and "manifest.json is whole" in ended.err and "edited" in ended.err


def test_a_summary_that_its_rows_do_not_have_is_refused(runs, tmp_path):
    out = copy_run(runs, "whole", tmp_path)
    manifest = manifest_of(out)
    manifest["summary"]["successes"] -= 1
    RunFolder(out).write_manifest(manifest)
    ended = run("report", out)
    assert is_one_line(ended) and "RUN must be a run whose entry successes agrees" in ended.err


def test_other_versions_code_or_devices_do_not_resume_a_run(runs, tmp_path):
    out = copy_run(runs, "begun", tmp_path)
    manifest = manifest_of(out)
    for what, value, told in (
        ("jax", "0.0.1", r"jax 0\.0\.1, as it started, got 0\."),
        ("devices of kind", "abacus", "devices of kind abacus, as it"),
        ("processor", "Z80", "processor Z80, as it started, got "),
        ("threads of a computation (NPROC)", 99, r"\(NPROC\) 99, as it started, got "),
        ("files of planner-jax", "0" * 12, "files of planner-jax 000000000000, as it started, got"),
    ):
        makers = {**manifest["makers"], what: value}
        RunFolder(out).write_manifest({**manifest, "makers": makers})
        with pytest.raises(ArgumentError, match=told):
            resume_sweep(TASK, out, progress=False)


def test_parts_of_another_run_are_planned_again(runs, tmp_path):
    out = copy_run(runs, "begun", tmp_path)
    for path in (out / "plans").iterdir():
        path.unlink()
    for path in (runs / "other" / "plans").iterdir():
        shutil.copy(path, out / "plans")
    ended = run("sweep", "hit", "--resume", "--out", out)
    assert ended.code == 0 and ended.err.count("is of another run or number") == 4
    assert rows_of(out) == rows_of(runs / "whole")


def test_a_part_in_the_place_of_another_is_planned_again(runs, tmp_path):
    out = copy_run(runs, "begun", tmp_path)
    first, *_ = sorted((out / "plans").iterdir())
    first.rename(first.with_name(first.name.replace("000000", "000003")))
    assert_resumed(runs, out, "is of another run or number")


def test_only_the_damaged_part_of_a_finished_run_is_planned_again(runs, tmp_path, monkeypatch):
    out, drawn = copy_run(runs, "whole", tmp_path), []
    _, second, *_ = sorted((out / "plans").iterdir())
    second.write_bytes(second.read_bytes()[:-1])
    real = HitSweep.plan
    monkeypatch.setattr(HitSweep, "plan", lambda *given: drawn.append(1) or real(*given))
    assert_resumed(runs, out, planned=1)
    assert len(drawn) == 1


@pytest.mark.parametrize("content", [b"", b"PAR1", b"PAR1\x19\x0c\0\3\0\0\0PAR1"])
def test_a_part_whose_name_fits_and_whose_footer_does_not_is_planned_again(runs, tmp_path, content):
    out = copy_run(runs, "begun", tmp_path)
    path = sorted((out / "plans").iterdir())[0]
    path.unlink()
    path.with_name(f"part-000000-{zlib.crc32(content):08x}.parquet").write_bytes(content)
    assert_resumed(runs, out, planned=1)


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
@pytest.mark.parametrize(
    ("run_of", "name", "command"),
    [
        ("begun", "manifest.json", ("sweep", "hit", "--resume", "--out")),
        ("begun", "plans/part-*.parquet", ("sweep", "hit", "--resume", "--out")),
        ("whole", "manifest.json", ("report",)),
        ("whole", "plans/part-*.parquet", ("report",)),
        ("flights", "flights/part-*.parquet", ("view",)),
        ("flights", "manifest.json", ("view",)),
    ],
)
def test_what_is_no_plain_file_is_refused_without_waiting(
    runs, tmp_path, kind, run_of, name, command
):
    out = copy_run(runs, run_of, tmp_path)
    path = sorted(out.glob(name))[0]
    path.unlink()
    if kind == "device":
        path.symlink_to("/dev/zero")
    else:
        (os.mkfifo if kind == "pipe" else os.mkdir)(path)
    kept = sorted(out.rglob("[!.]*"))
    ended = run(*command, out)
    assert is_one_line(ended) and ended.code == 2, ended
    assert sorted(out.rglob("[!.]*")) == kept


def test_a_pipe_in_the_place_of_the_lock_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / ".lock")
    with pytest.raises(ArgumentError, match="out must be a folder that can be written"):
        RunFolder(tmp_path).require_new()


def test_what_is_no_part_of_the_run_is_removed_from_its_rows(runs, tmp_path):
    out = copy_run(runs, "begun", tmp_path)
    part = sorted((out / "plans").iterdir())[0]
    crc = part.stem.rpartition("-")[2]
    names = ("part-999999-00000000.parquet", f"part-{'9' * 200}-00000000.parquet", "notes.txt")
    for name in (*names, f"part-0000000-{crc}.parquet"):
        (out / "plans" / name).write_bytes(part.read_bytes())
    assert_resumed(runs, out, "is not a part of a run", "is a duplicate", planned=4)
