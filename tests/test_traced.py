"""Traced programs are stored on the disk, and used until something they depend on changes."""

import dataclasses
import json
import os
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.host.compile_cache import SWITCH
from planner_jax.planning import traced

traces = []


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Pair:
    left: jax.Array
    right: jax.Array | None
    name: str = dataclasses.field(metadata={"static": True}, default="one")


def scale(static, numbers: jax.Array, pair: Pair):
    traces.append(static)
    total = pair.left + numbers.astype(float)
    return {"sum": total, "pair": Pair(pair.left * 2, None, "two"), "none": ()}


@pytest.fixture
def folder(monkeypatch, tmp_path):
    monkeypatch.setattr(traced, "_PACKAGE", __name__.partition(".")[0])
    traces.clear()
    usual = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path / "traced"
    jax.config.update("jax_compilation_cache_dir", usual)


PAIR = Pair(jnp.arange(3.0), None)
NUMBERS = jnp.ones(3)


def call(static=None, numbers=NUMBERS, pair=PAIR, function=scale):
    return traced.Stored(function)("cpu", static, numbers, pair)


def files(folder) -> list:
    return sorted(folder.iterdir()) if folder.exists() else []


def test_a_stored_program_gives_the_same_results_and_is_not_traced(folder):
    first, again = call(), call()
    assert len(traces) == 1 and len(files(folder)) == 1
    assert jax.tree.structure(first) == jax.tree.structure(again)
    assert first["pair"].name == again["pair"].name == "two"
    np.testing.assert_array_equal(again["sum"], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(again["pair"].left, first["pair"].left)


def test_threads_that_call_at_once_share_one_program(folder):
    stored = traced.Stored(scale)
    with ThreadPoolExecutor(4) as pool:
        found = pool.map(lambda _: stored("cpu", None, NUMBERS, PAIR)["sum"], range(4))
        np.testing.assert_array_equal(list(found), np.tile([1.0, 2.0, 3.0], (4, 1)))
    assert len(traces) == 1


@pytest.mark.parametrize(
    "change",
    [
        dict(static=(1, 2.5, "word", np.float32(1.0))),
        dict(numbers=jnp.ones(())),
        dict(numbers=jnp.ones(3, jnp.int32)),
        dict(pair=Pair(PAIR.left, PAIR.left)),
        dict(pair=Pair(PAIR.left, None, "three")),
    ],
    ids=lambda change: next(iter(change)),
)
def test_other_arguments_have_another_program(folder, change):
    call()
    for _ in range(2):
        call(**change)
    assert len(traces) == 2 and len(files(folder)) == 2


def test_a_change_of_settings_or_of_the_library_makes_another_program(folder, monkeypatch):
    call()
    with jax.default_matmul_precision("highest"):
        call()
    monkeypatch.setenv("PLANNER_JAX_KERNELS", "off")
    call()
    monkeypatch.setattr(traced, "_library_digest", lambda: "a new version")
    call()
    assert len(traces) == 4


def test_the_digest_of_the_library_changes_with_a_file(monkeypatch, tmp_path):
    monkeypatch.setattr(traced, "_FILES", tmp_path)
    digest = traced._library_digest.__wrapped__
    (tmp_path / "inner").mkdir()
    file = tmp_path / "inner" / "module.py"
    file.write_text("x = 1\n")
    os.utime(file, (2, 2))
    (tmp_path / "link").symlink_to("nowhere")
    before = digest()
    assert digest() == before
    os.utime(file, ns=(1, 1))
    assert digest() != before


@pytest.mark.parametrize("damage", [b"", b"no JSON\n", b"{}\n", None])
def test_a_damaged_file_is_written_again(folder, damage):
    call()
    (file,) = files(folder)
    whole = file.read_bytes()
    file.write_bytes(whole[:-100] if damage is None else damage)
    np.testing.assert_array_equal(call()["sum"], [1.0, 2.0, 3.0])
    assert len(traces) == 2 and len(file.read_bytes()) == len(whole)


class Word(str):
    pass


def test_what_another_package_or_a_local_function_makes_is_not_stored(folder, monkeypatch):
    def local(static, numbers, pair):
        return scale(static, numbers, pair)

    np.testing.assert_array_equal(call(function=local)["sum"], [1.0, 2.0, 3.0])
    call(static=Word("a class that may mean anything"))
    monkeypatch.setattr(traced, "_PACKAGE", "planner_jax")
    np.testing.assert_array_equal(call()["sum"], [1.0, 2.0, 3.0])
    assert files(folder) == []


def test_nothing_is_stored_after_a_file_of_the_library_changed(folder, monkeypatch, tmp_path):
    monkeypatch.setattr(traced, "_FILES", tmp_path)
    monkeypatch.setattr(traced, "_library_digest", traced._library_digest.__wrapped__)
    tmp_path.joinpath("module.py").touch()
    np.testing.assert_array_equal(call()["sum"], [1.0, 2.0, 3.0])
    assert files(folder) == []


class Odd(tuple):
    """A static value whose `repr` no process can read."""

    __repr__ = object.__repr__


def make_odd(static, numbers: jax.Array, pair: Pair):
    return Pair(numbers, None, Odd())


def test_results_that_json_cannot_describe_are_not_stored(folder):
    assert call(function=make_odd).name == Odd()
    assert files(folder) == []


def test_nothing_is_stored_without_a_folder(folder, monkeypatch, tmp_path):
    tmp_path.joinpath("traced").write_text("a file in the place of the folder")
    np.testing.assert_array_equal(call()["sum"], [1.0, 2.0, 3.0])
    tmp_path.joinpath("traced").unlink()
    monkeypatch.setenv(SWITCH, "off")
    call()
    assert files(folder) == []


def test_errors_of_the_function_are_raised_as_usual(folder):
    with pytest.raises(TypeError, match="incompatible shapes"):
        call(numbers=jnp.ones(2))
    assert files(folder) == []


def test_the_programs_used_least_recently_are_deleted(folder, monkeypatch):
    monkeypatch.setattr(traced, "MOST", 2)
    for static in (1, 2):
        call(static)
    for age, file in enumerate(files(folder)):
        os.utime(file, (age, age))
    oldest = files(folder)[0].name
    call(3)
    assert len(files(folder)) == 2 and oldest not in [file.name for file in files(folder)]
    assert all(json.loads(file.read_bytes().split(b"\n")[0]) for file in files(folder))
