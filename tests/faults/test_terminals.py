"""Full disks behind the output, and characters that a terminal or a file name lacks."""

import json
import os
import subprocess
import sys

import pytest

from planner_jax.core.errors import ArgumentError
from planner_jax.runs.run_folder import RunFolder
from tests.faults.commands import ROOT, is_one_line, run

SCRIPT = """
import sys
from tqdm import tqdm
from planner_jax.host.terminal import prepare_streams
prepare_streams()
print("caf\\xe9 \\U0001f600")
for _ in tqdm(range(3), mininterval=0.0):
    print("progress " * 1000, file=sys.stderr, flush=True)
sys.exit(3)
"""
SWEEP = ("-m", "planner_jax", "sweep", "hit", "--num", "40", "--batch", "13", "--out")


def run_process(*arguments, **pipes):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, env=environment, check=False, **pipes)


def test_lost_progress_and_missing_characters_do_not_end_a_command():
    with open("/dev/full", "wb") as full:
        done = run_process("-c", SCRIPT, stdout=subprocess.PIPE, stderr=full)
    assert (done.returncode, done.stdout) == (3, b"caf\\xe9 \\U0001f600\n")


def test_a_path_that_is_not_utf_8_is_refused_before_anything_is_planned(tmp_path):
    out = f"{tmp_path}/sw\udcff"
    ended = run("sweep", "hit", "--num", "3", "--out", out)
    assert is_one_line(ended) and ended.code == 2
    assert "--out must be a path in UTF-8, got '" in ended.err and "sw\\udcff'" in ended.err
    with pytest.raises(ArgumentError, match="RUN must be a path in UTF-8"):
        RunFolder(out, "RUN")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_sweep_whose_log_is_on_a_full_disk_ends(tmp_path):
    with open("/dev/full", "wb") as full:
        done = run_process(*SWEEP, tmp_path / "out", stdout=subprocess.PIPE, stderr=full)
    assert done.returncode == 0 and done.stdout
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["state"] == "complete"


@pytest.mark.slow
def test_a_summary_that_cannot_be_printed_is_blamed_on_the_output(tmp_path):
    with open("/dev/full", "wb") as full:
        done = run_process(*SWEEP, tmp_path / "out", stdout=full, stderr=subprocess.PIPE)
    last = done.stderr.decode().splitlines()[-1]
    assert done.returncode == 1
    assert "the standard output must be writable, got No space left on device; finish with" in last
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["state"] == "complete"
