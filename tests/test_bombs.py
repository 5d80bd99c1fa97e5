"""No small file makes a reader take much memory: see `tests/bombs.py` for the files."""

import json
import subprocess
import sys

import pytest

from tests.bombs import BOMBS, ROOT

MOST = 300.0  # [MB] memory above the memory of a process that read an ordinary file

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Read all files in one process, which forks another one for each file."""
    command = [sys.executable, "-m", "tests.bombs", str(tmp_path_factory.mktemp("bombs"))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return {each["name"]: each for each in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_takes_little_memory_and_has_a_clear_error(results, name):
    found = results[name]
    print(f"{name}: {found.get('memory')} MB, {found.get('seconds')} s, {found['error']}")
    assert found["is_clear"], found["error"]
    assert found["memory"] <= MOST
