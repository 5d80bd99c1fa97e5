import os
import subprocess
import sys
import time
import zlib

import numpy as np
import pytest
import zstandard

from planner_jax.cli import doctor
from planner_jax.host import compile_cache

# A call of `plan` or `solve` with wrong arguments raises an error, but only after the cache is set
# up.
SCRIPT = """
from concurrent.futures import ThreadPoolExecutor
import jax
import planner_jax as pj
def fail(_):
    try: pj.CALL(None, None)
    except (TypeError, AttributeError): pass
list(ThreadPoolExecutor(4).map(fail, range(4)))
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event))
jax.jit(lambda x: x + 3)(1.0)
print(pj.keep_compiled_programs(), "/jax/compilation_cache/cache_hits" in hits)
"""

CONTENTS = (np.random.default_rng(1).bytes(300_000), b"short", bytes(100_000))


def run(call="plan", **environment):
    """Compile a program in a new process after a `call`; return its output, without line's end."""
    usual = {name: text for name, text in os.environ.items() if not name.startswith("JAX_COMP")}
    usual.pop("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", None)
    command = [sys.executable, "-c", SCRIPT.replace("CALL", call)]
    env = {**usual, **environment}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.strip()


def test_the_first_plan_of_a_process_uses_the_cache_of_the_user(tmp_path):
    folder = tmp_path / "planner-jax" / "jax"
    assert run(XDG_CACHE_HOME=str(tmp_path)) == f"{folder} False"
    assert any(folder.iterdir())
    assert run(XDG_CACHE_HOME=str(tmp_path)) == f"{folder} True"
    assert run("solve", XDG_CACHE_HOME=str(tmp_path)) == f"{folder} True"


def test_a_folder_that_the_user_set_in_jax_is_used_instead(tmp_path):
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    chosen = {"XDG_CACHE_HOME": str(ours), "JAX_COMPILATION_CACHE_DIR": str(theirs)}
    assert run(**chosen) == f"{theirs} False"
    assert any(theirs.iterdir()) and not ours.exists()


def test_without_a_cache_because_of_a_switch_or_its_folder_a_process_goes_on(tmp_path):
    assert run(XDG_CACHE_HOME=str(tmp_path), PLANNER_JAX_CACHE="off") == "None False"
    assert not any(tmp_path.iterdir())
    (tmp_path / "file").touch()
    assert run(XDG_CACHE_HOME=str(tmp_path / "file")) == "None False"


def test_programs_that_were_used_least_recently_are_deleted(tmp_path, monkeypatch):
    monkeypatch.setattr(compile_cache, "LIMIT", 250)
    content, own = zlib.compress(np.random.default_rng(0).bytes(89)), tmp_path / "own"
    assert len(content) == 100
    monkeypatch.setattr(compile_cache, "cache_folder", lambda: own)
    for folder in (own, tmp_path / "other"):
        folder.mkdir()
        for age, name in enumerate(("new-cache", "middle-cache", "old-cache", "oldest-cache")):
            (folder / name).write_bytes(content)
            os.utime(folder / name, times=(1e9 - age, 1e9 - age))
        compile_cache._tidy(folder)
    assert {path.name for path in own.iterdir()} == {"new-cache", "middle-cache", "checked"}
    assert len(list(folder.iterdir())) == 5, "a folder of the user has no limit"
    compile_cache._tidy(tmp_path / "missing")


def damage(path, content):
    """Write other bytes to a stored program, some seconds ago."""
    path.write_bytes(content)
    os.utime(path, times=(time.time() - 10.0,) * 2)


def test_programs_that_are_not_whole_are_deleted_and_no_other_files(tmp_path):
    compressors = (zstandard.ZstdCompressor().compress, zlib.compress)
    kept = [compress(content) for compress in compressors for content in CONTENTS]
    cuts = [whole[:size] for whole in kept for size in (0, 3, 8, len(whole) // 2, len(whole) - 1)]
    for number, each in enumerate((*cuts, *kept)):
        damage(tmp_path / f"jit_f-{number:02d}-cache", each)
    (tmp_path / "jit_f-written-cache").write_bytes(b"")  # by another process, at this moment
    damage(tmp_path / "mine.txt", b"")
    compile_cache._tidy(tmp_path)
    whole = {f"jit_f-{number:02d}-cache" for number in range(len(cuts), len(cuts) + len(kept))}
    found = {path.name for path in tmp_path.iterdir()}
    assert found == {*whole, "checked", "mine.txt", "jit_f-written-cache"}


@pytest.mark.slow
def test_a_program_that_is_cut_is_compiled_and_stored_again(tmp_path):
    chosen = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    assert run(**chosen) == f"{tmp_path} False"
    for path in tmp_path.glob("*-cache"):
        damage(path, path.read_bytes()[:-9])
    os.utime(tmp_path / "checked", (0.0, 0.0))  # the time of the last check
    assert [run(**chosen) for _ in range(2)] == [f"{tmp_path} False", f"{tmp_path} True"]


@pytest.mark.parametrize("switch", ["on", "off"])
def test_the_doctor_names_folder_size_and_limit(tmp_path, monkeypatch, switch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PLANNER_JAX_CACHE", switch)
    folder = compile_cache.cache_folder()
    folder.mkdir(parents=True)
    (folder / "program").write_bytes(bytes(3_000_000))
    text = f"1 files, 3 MB of at most 2,000 MB of compiled programs in {folder}"
    assert doctor._cache(folder) == doctor.Finding("cache", text)
    assert "at most" not in doctor._cache(tmp_path).text
    assert doctor._cache(None).good is (switch == "off")
