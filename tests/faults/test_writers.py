"""Killed runs, two writers and full disks: nothing is lost, and nothing fails silently."""

import contextlib
import errno
import os
import resource
import shutil
import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from planner_jax.core.errors import ArgumentError
from planner_jax.host import files as whole_files
from planner_jax.runs.run_folder import LOCK, RunFolder
from planner_jax.sweep.run import resume_sweep, start_sweep
from tests.faults.commands import is_one_line, run
from tests.faults.runs import SETTINGS, TASK
from tests.sweeps import rows_of

CACHE = os.path.abspath(os.environ["JAX_COMPILATION_CACHE_DIR"])
COMMAND = ("sweep", "hit", "--num", "40", "--batch", "13", "--seed", "3", "--out")


class Killed(BaseException):
    """An exception that tests raise in place of a SIGKILL, which would end the tests, too."""


def failing(monkeypatch, number, error):
    real, count = os.replace, [0]

    def replace(*names):
        if os.path.abspath(names[1]).startswith(CACHE):  # only the first run stores programs
            return real(*names)
        count[0] += 1
        if count[0] == number:
            raise error
        return real(*names)

    monkeypatch.setattr(whole_files.os, "replace", replace)
    return count


def test_a_sweep_killed_before_any_of_its_writes_is_resumed_to_the_same_rows(
    runs, tmp_path, monkeypatch
):
    with monkeypatch.context() as patch:
        count = failing(patch, 0, Killed())
        start_sweep(TASK, SETTINGS, tmp_path / "counted", progress=False)
    assert count[0] >= 9  # manifests, four parts, table, page
    for number in range(2, count[0] + 1):
        out = tmp_path / str(number)
        with monkeypatch.context() as patch:
            failing(patch, number, Killed())
            with pytest.raises(Killed):
                start_sweep(TASK, SETTINGS, out, progress=False)
        resume_sweep(TASK, out, progress=False)
        assert rows_of(out) == rows_of(runs / "whole")
        assert [path.name for path in out.rglob(".*")] == [LOCK]


def test_a_folder_without_its_first_manifest_is_new(runs, tmp_path, monkeypatch):
    out = tmp_path / "run"
    out.mkdir()
    (out / LOCK).write_text("4711 on host, since 2026-01-01T00:00:00+00:00")  # of a killed process
    (out / ".4711.tmp.manifest.json").write_text("{")
    start_sweep(TASK, SETTINGS, out, progress=False)
    assert rows_of(out) == rows_of(runs / "whole")
    assert [path.name for path in out.rglob(".*")] == [LOCK]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES])
def test_a_failed_write_names_file_option_and_how_to_resume(runs, tmp_path, monkeypatch, code):
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        failing(patch, 3, OSError(code, os.strerror(code)))
        ended = run(*COMMAND, out)
    assert ended.code == 1 and ended.out == ""
    last = ended.err.splitlines()[-1]
    assert last.startswith("planner-jax: error: --out must be a folder that can be written, got '")
    assert f"{out}/plans/part-" in last and os.strerror(code) in last
    assert last.endswith(f"; finish with: planner-jax sweep hit --resume --out {out}")
    assert run("sweep", "hit", "--resume", "--out", out).code == 0
    assert rows_of(out) == rows_of(runs / "whole")


def test_files_that_may_not_grow_are_told_of(runs, tmp_path):
    """Limit the size of files such that only the smallest file of `plans/` can be written."""
    out, before = tmp_path / "run", resource.getrlimit(resource.RLIMIT_FSIZE)
    small, other, *_ = sorted(path.stat().st_size for path in (runs / "whole/plans").iterdir())
    resource.setrlimit(resource.RLIMIT_FSIZE, ((small + other) // 2, before[1]))
    try:
        ended = run(*COMMAND, out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert ended.code == 1 and f"{out}/plans/part-" in ended.err.splitlines()[-1]
    assert run("sweep", "hit", "--resume", "--out", out).code == 0
    assert rows_of(out) == rows_of(runs / "whole")


def test_a_name_that_is_too_long_is_refused_in_one_line(tmp_path):
    ended = run(*COMMAND, tmp_path / ("x" * 300))
    assert is_one_line(ended) and ended.code == 2
    assert "--out must be a folder that can be written, got" in ended.err


def test_the_second_writer_is_refused_and_told_of_the_first(runs, tmp_path):
    out = tmp_path / "run"
    with RunFolder(out).lock():
        shutil.copytree(runs / "whole" / "plans", out / "plans")
        for arguments in (COMMAND, ("sweep", "hit", "--resume", "--out")):
            (out / "manifest.json").write_bytes((runs / "whole" / "manifest.json").read_bytes())
            ended = run(*arguments, out)
            assert is_one_line(ended) and ended.code == 2
            assert "--out must be a folder that no other process writes, got" in ended.err
            assert f"owned by process {os.getpid()} on {socket.gethostname()}, since " in ended.err
        ended = run("report", out)
        assert is_one_line(ended) and "RUN must be a folder that no other process" in ended.err
    assert run("report", out).code == 0


def test_of_many_that_begin_at_once_one_owns_the_folder(tmp_path):
    barrier, won = threading.Barrier(4), []

    def hold(number):
        barrier.wait()
        with contextlib.suppress(ArgumentError), RunFolder(tmp_path).lock():
            won.append(number)
            barrier.wait()
            return
        barrier.wait()

    for count in range(1, 11):
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(hold, range(4)))
        assert len(won) == count
