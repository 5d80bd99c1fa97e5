"""Programs as they were traced are found again, and nothing spoils a plan if they are not."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.live import export_cache as module
from planner_jax.live.export_cache import FOLDER, traced
from planner_jax.planning import single_call as packed

SHAPE = (jax.ShapeDtypeStruct((3,), jnp.float32),)
NUMBERS = np.arange(3, dtype=np.float32)


@pytest.fixture
def folder(tmp_path):
    """That of the traced programs, empty."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path / FOLDER
    jax.config.update("jax_compilation_cache_dir", before)


class Traces:
    """How often a program was traced, as if each call were a process of its own."""

    def __init__(self):
        self.num = 0

    def call(self, described="", shape=SHAPE):
        found_out: list = []

        def program(x):
            self.num += 1
            found_out[:] = ["of the trace"]
            return 2.0 * x + 1.0

        run = traced(program, described, shape, found_out)
        result = np.asarray(run(NUMBERS[: shape[0].shape[0]]))
        assert found_out == ["of the trace"]
        np.testing.assert_array_equal(result, 2.0 * NUMBERS[: result.size] + 1.0)


def test_a_program_is_traced_once_for_all_processes(folder):
    traces = Traces()
    traces.call()
    traces.call()
    assert traces.num == 1 and len(list(folder.iterdir())) == 1


def test_what_it_is_traced_for_tells_programs_apart(folder, monkeypatch):
    traces = Traces()
    traces.call()
    traces.call("with a setting")
    traces.call(shape=(jax.ShapeDtypeStruct((2,), jnp.float32),))
    with jax.enable_x64(True):
        traces.call()
    monkeypatch.setattr(module, "_code", lambda: "of another version")
    traces.call()
    assert traces.num == 5 and len(list(folder.iterdir())) == 5


@pytest.mark.parametrize(
    "damage",
    [lambda data: data[:-1], lambda data: data[:40], lambda data: b"", lambda data: data + b"x"],
)
def test_a_file_that_is_not_whole_is_made_anew_in_silence(folder, damage):
    traces = Traces()
    traces.call()
    (place,) = folder.iterdir()
    whole = place.read_bytes()
    place.write_bytes(damage(whole))
    traces.call()
    assert traces.num == 2
    traces.call()
    assert traces.num == 2


def test_without_a_folder_that_can_be_written_it_works_as_before(folder):
    traces = Traces()
    folder.write_text("in the way")
    traces.call()
    jax.config.update("jax_compilation_cache_dir", None)
    traces.call()
    assert traces.num == 2


def test_what_has_no_name_that_lasts_is_not_kept(folder):
    Traces().call(repr(object()))
    assert not folder.exists()


def test_the_oldest_are_deleted(folder, monkeypatch):
    monkeypatch.setattr(module, "_KEPT", 2)
    traces = Traces()
    for number in range(4):
        traces.call(str(number))
    assert len(list(folder.iterdir())) == 2
    traces.call("3")
    assert traces.num == 4


def _doubled(factor, own, case):
    return {"doubled": factor * own * case["x"], "num": jnp.sum(case["n"])}


def test_a_packed_call_is_the_same_from_a_kept_program(folder, monkeypatch):
    case = {"x": NUMBERS, "n": np.arange(4, dtype=np.int32)}
    found = []
    for _ in range(2):  # processes, each of which finds its programs itself
        monkeypatch.setattr(packed, "_program", functools.cache(packed._program.__wrapped__))
        found.append(packed.call_packed(_doubled, 2.0, np.float32(3.0), case, compiler=traced))
    for each in found:
        np.testing.assert_array_equal(each["doubled"], 6.0 * NUMBERS)
        assert each["num"] == 6 and each["num"].dtype == np.int32
    assert len(list(folder.iterdir())) == 1
