"""Sweeps into an object store: files put whole, a lease, and failures that are told and resumed."""

import contextlib
import json
import socket
import subprocess
import sys

import pytest
from pyarrow import fs

from planner_jax.runs import stored_run
from planner_jax.runs.bucket import Bucket, bucket_of
from planner_jax.runs.settings import SettingError
from planner_jax.sweep.hit.sweep import HitSweep
from planner_jax.sweep.run import SweepInterrupted, resume_sweep, start_sweep
from tests.faults.commands import is_one_line, run
from tests.faults.runs import SETTINGS, TASK, quick_sweeps
from tests.sweeps import stop_after

ADDRESS = "s3://runs/hits"


class Store:
    """A store that keeps its objects in a folder, and stops to answer after so many puts."""

    def __init__(self, folder):
        self.folder, self.puts_left = fs.SubTreeFileSystem(str(folder), fs.LocalFileSystem()), None

    def open_output_stream(self, path):
        if self.puts_left is not None:
            if not self.puts_left:
                raise OSError("When putting:\n connection refused")
            self.puts_left -= 1
        self.folder.create_dir(path.rpartition("/")[0], recursive=True)
        return self.folder.open_output_stream(path)

    def open_input_stream(self, path):
        return self.folder.open_input_stream(path)

    def delete_file(self, path):
        self.folder.delete_file(path)

    def get_file_info(self, selector):
        return self.folder.get_file_info(selector)


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_sweeps():
        yield


@pytest.fixture
def store(tmp_path, monkeypatch):
    found = Store(tmp_path)
    monkeypatch.setattr(stored_run, "bucket_of", lambda *_: Bucket(ADDRESS, found))  # type: ignore
    return found


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """The rows of the same sweep into a folder of the disk."""
    out = tmp_path_factory.mktemp("local") / "run"
    start_sweep(TASK, SETTINGS, out, progress=False)
    return (out / "plans.parquet").read_bytes()


def kept(tmp_path):
    """What lies in the store, without folders."""
    place = tmp_path / "runs" / "hits"
    return {path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file()}


def test_a_run_in_a_store_has_the_rows_of_one_on_the_disk_and_is_reported(store, tmp_path, rows):
    start_sweep(TASK, SETTINGS, ADDRESS, progress=False)
    assert kept(tmp_path) == {"manifest.json", "plans.parquet", "table.md", "index.html"}
    assert (tmp_path / "runs" / "hits" / "plans.parquet").read_bytes() == rows
    (tmp_path / "runs" / "hits" / "table.md").unlink()
    ended = run("report", ADDRESS)
    assert ended.code == 0 and f"Look at {ADDRESS}/index.html" in ended.out
    assert "table.md" in kept(tmp_path)
    with pytest.raises(SettingError, match=f"out must be a new or .* with resume, got '{ADDRESS}'"):
        start_sweep(TASK, SETTINGS, ADDRESS, progress=False)


def test_an_interrupted_run_is_finished_from_what_the_store_has(store, tmp_path, rows, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(SweepInterrupted, match=ADDRESS):
        stop_after(patch, HitSweep, 3)
        start_sweep(TASK, SETTINGS, ADDRESS, progress=False)
    assert 1 <= sum(name.startswith("parts/") for name in kept(tmp_path)) < 4
    assert "lease.json" not in kept(tmp_path)
    resume_sweep(TASK, ADDRESS, progress=False)
    assert (tmp_path / "runs" / "hits" / "plans.parquet").read_bytes() == rows
    assert not any(name.startswith("parts/") for name in kept(tmp_path))


def test_a_store_that_goes_away_midway_is_told_in_one_line_and_the_run_resumes(
    store, tmp_path, rows
):
    store.puts_left = 4  # lease, manifest and two parts
    options = ("--num", "40", "--batch", "13", "--seed", "3", "--out", ADDRESS)
    ended = run("sweep", "hit", *options)
    last = ended.err.rstrip("\n").rpartition("\n")[2]
    assert ended.code == 1 and "connection refused" in last and "Traceback" not in ended.err
    assert last.endswith(f"finish with: planner-jax sweep hit --resume --out {ADDRESS}")
    store.puts_left = None
    assert run("sweep", "hit", "--resume", "--out", ADDRESS).code == 0
    assert (tmp_path / "runs" / "hits" / "plans.parquet").read_bytes() == rows


def test_a_store_that_takes_nothing_is_told_with_nothing_to_resume(store):
    store.puts_left = 0
    ended = run("sweep", "hit", "--num", "4", "--out", ADDRESS)
    assert is_one_line(ended) and ended.code == 1 and "there is nothing to resume" in ended.err


def lease(tmp_path, **entries):
    """Leave a lease in the store."""
    place = tmp_path / "runs" / "hits"
    place.mkdir(parents=True, exist_ok=True)
    whole = {"token": "x", "pid": 1, "host": "elsewhere", "at": "noon", "until": 1e12, **entries}
    (place / "lease.json").write_text(json.dumps(whole))


def test_a_second_writer_is_refused_in_a_line_that_names_the_first(store, tmp_path):
    lease(tmp_path)
    with pytest.raises(SettingError, match="owned by process 1 on elsewhere, at noon"):
        start_sweep(TASK, SETTINGS, ADDRESS, progress=False)
    assert kept(tmp_path) == {"lease.json"}


@pytest.mark.parametrize("why", ["it has run out", "its process is gone", "it is no lease"])
def test_a_lease_that_counts_no_more_is_taken(store, tmp_path, why):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    mine = {"pid": gone.pid, "host": socket.gethostname()}
    lease(tmp_path, **{"it has run out": {"until": 1.0}, "its process is gone": mine}.get(why, {}))
    if why == "it is no lease":
        (tmp_path / "runs" / "hits" / "lease.json").write_bytes(b"\xff{")
    folder = stored_run.run_folder(ADDRESS)
    with contextlib.suppress(SettingError), folder.begun():
        assert json.loads((tmp_path / "runs" / "hits" / "lease.json").read_text())["token"] != "x"
    assert kept(tmp_path) == set()


@pytest.mark.parametrize(
    "address", ["s3://", "s3://runs", "s3://runs/", "s3://UP/x", "s3://runs/a//b"]
)
def test_what_is_no_address_is_refused_in_one_line(address):
    with pytest.raises(ValueError, match="^out must be s3://BUCKET/PATH, got"):
        bucket_of(address, "out")


@pytest.mark.parametrize("command", ["fly hit", "train", "bench throughput"])
def test_other_commands_write_to_the_disk_alone(command):
    ended = run(*command.split(), "--out", ADDRESS)
    assert is_one_line(ended) and "--out must be a folder of this machine" in ended.err
