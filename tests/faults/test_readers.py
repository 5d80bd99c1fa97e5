"""Damaged run files are rejected with one line, planned again, or read without any difference."""

import json
import os
import shutil
import socket
import uuid
import zlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from planner_jax.core.errors import ArgumentError
from planner_jax.host.files import name_run_folder, read_plain
from planner_jax.runs.manifest import parse_object
from planner_jax.runs.run_folder import LOCK, RunFolder
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


def tree_of(folder):
    """Return every path within a folder except its lock, with the bytes of files."""
    paths = sorted(path for path in folder.rglob("*") if path.name != LOCK)
    return [(path, path.read_bytes() if path.is_file() else None) for path in paths]


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


def test_runs_that_begin_within_one_second_have_folders_of_their_own():
    assert len({name_run_folder("hit-exact") for _ in range(3)}) == 3


def test_only_regular_files_of_a_bounded_size_are_opened(tmp_path):
    plain, link = tmp_path / "plain", tmp_path / "link"
    plain.write_bytes(b"four")
    link.symlink_to(plain)
    assert read_plain(link, 4) == b"four"
    for path in (plain, "/proc/self/status"):  # files of /proc have no size before they are read
        with pytest.raises(OSError, match="it is larger than 3 bytes"):
            read_plain(path, 3)
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(tmp_path / "socket"))
        for path in (tmp_path, tmp_path / "pipe", tmp_path / "socket", "/dev/zero"):
            with pytest.raises(OSError):
                read_plain(path)


@pytest.mark.parametrize("make", ["symlink_to", "hardlink_to", "write_bytes"])
def test_the_lock_is_not_written_into_a_file_of_another_program(runs, tmp_path, make):
    thesis, content = tmp_path / "thesis.txt", b"all of it"
    thesis.write_bytes(content)
    for command in (("report",), ("sweep", "hit", "--num", "3", "--out")):
        out = copy_run(runs, "whole", tmp_path) if command == ("report",) else tmp_path / "new"
        out.mkdir(exist_ok=True)
        (out / LOCK).unlink(missing_ok=True)
        getattr(out / LOCK, make)(content if make == "write_bytes" else thesis)
        ended = run(*command, out)
        assert is_one_line(ended) and ended.code == 2 and LOCK in ended.err
        assert {path.read_bytes() for path in (thesis, out / LOCK)} == {content}


def test_a_folder_that_is_not_empty_is_refused_before_its_lock_is_written(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    for text in (None, "", "12 on a.b, since 2026-01-01T10:00:00+01:00"):
        if text is not None:
            (tmp_path / ".lock").write_text(text)
        kept = [(path, path.read_text()) for path in sorted(tmp_path.iterdir())]
        with pytest.raises(ArgumentError, match="out must be a new or empty folder"):
            RunFolder(tmp_path).require_new()
        assert [(path, path.read_text()) for path in sorted(tmp_path.iterdir())] == kept


def test_parts_that_are_not_of_the_run_are_planned_again(runs, tmp_path):
    out = copy_run(runs, "begun", tmp_path)
    part = sorted((out / "plans").iterdir())[0]
    crc = part.stem.rpartition("-")[2]
    for name in ("part-999999-00000000.parquet", f"part-0000000-{crc}.parquet"):
        (out / "plans" / name).write_bytes(part.read_bytes())
    assert_resumed(runs, out, "checksum is not the one in its name", "is a duplicate", planned=2)


@pytest.mark.parametrize("name", ["notes.txt", f"part-{'9' * 200}-00000000.parquet"])
def test_a_file_that_no_run_writes_is_named_and_nothing_is_deleted(runs, tmp_path, name):
    out = copy_run(runs, "begun", tmp_path)
    part = sorted((out / "plans").iterdir())[0]
    part.write_bytes(b"damaged")
    (out / "plans" / name).write_text("mine")
    kept = tree_of(out)
    ended = run("sweep", "hit", "--resume", "--out", out)
    assert is_one_line(ended) and ended.code == 2 and f"{name}', which is not a part" in ended.err
    assert tree_of(out) == kept


@pytest.mark.parametrize("name", ["plans", "baselines", "figures"])
@pytest.mark.parametrize("command", [("sweep", "hit", "--resume", "--out"), ("report",)])
def test_a_link_in_the_place_of_a_folder_of_a_run_is_not_followed(runs, tmp_path, name, command):
    out = copy_run(runs, "whole", tmp_path)
    victim = tmp_path / "victim"
    (out / name).mkdir(exist_ok=True)
    (out / name).rename(victim)
    (out / name).symlink_to(victim)
    (victim / "thesis.txt").write_text("mine")
    (victim / ".1.tmp.draft").write_text("mine too")
    kept = tree_of(victim)
    ended = run(*command, out)
    assert is_one_line(ended) and f"{name} is no link to another folder" in ended.err
    assert tree_of(victim) == kept


def test_an_invalid_argument_does_not_delete_the_rows_of_a_resumed_run(runs, tmp_path, monkeypatch):
    out = copy_run(runs, "begun", tmp_path)
    kept = tree_of(out / "plans")

    def fail(*_):
        raise ArgumentError("wind", "calm")

    with monkeypatch.context() as patch:
        patch.setattr(HitSweep, "plan", fail)
        with pytest.raises(ArgumentError, match="wind must be calm"):
            resume_sweep(TASK, out, progress=False)
    assert tree_of(out / "plans") == kept
    assert_resumed(runs, out)
