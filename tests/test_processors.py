"""Number of cores and threads that commands use, on which a run's results must not depend."""

import os
import sys

import pytest

from planner_jax import __main__ as process
from planner_jax.cli import main as cli
from planner_jax.host import machine
from planner_jax.host import signals as stopping
from tests.faults.commands import start, wait_for
from tests.sweeps import rows_of


def test_usable_cores_are_those_that_the_process_is_bound_to(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda who: {3, 5, 6}, raising=False)
    assert machine.usable_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert machine.usable_cores() == 1


@pytest.mark.parametrize(
    ("environment", "num"),
    [({}, 4), ({"NPROC": "2"}, 2), ({"NPROC": "2", "PJRT_NPROC": "7"}, 7), ({"NPROC": "all"}, 4)],
)
def test_threads_of_a_computation_are_as_the_environment_says(monkeypatch, environment, num):
    monkeypatch.setattr(machine, "usable_cores", lambda: 4)
    for name in ("NPROC", "PJRT_NPROC"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert machine.threads_of_a_computation.__wrapped__() == num


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("model name : Quick 9\nflags : fma avx avx2\n\nmodel name : Slow 1\n", "Quick 9 (avx2)"),
        ("Processor : a\nFeatures : fp asimd\n", "machine (asimd)"),
        ("", "machine"),
    ],
)
def test_the_processor_is_known_by_its_name_and_widest_vectors(monkeypatch, text, told):
    monkeypatch.setattr(machine.Path, "read_text", lambda *_, **__: text)
    monkeypatch.setattr(machine.platform, "processor", lambda: "")
    monkeypatch.setattr(machine.platform, "machine", lambda: "machine")
    assert machine.processor.__wrapped__() == told


@pytest.mark.parametrize(
    ("command", "before", "plugins", "told"),
    [
        ("sweep", None, None, "1"),
        ("sweep", "3", None, "3"),
        ("sweep", None, "cuda", None),
        ("fly", None, None, None),
    ],
)
def test_the_command_sweep_computes_with_one_thread_on_a_cpu(
    monkeypatch, command, before, plugins, told
):
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    monkeypatch.setattr(process.importlib.util, "find_spec", lambda name: plugins)
    for name in ("NPROC", "PJRT_NPROC"):
        monkeypatch.setenv(name, "1")  # to be put back
        monkeypatch.delenv(name)
    if before:
        monkeypatch.setenv("NPROC", before)
    monkeypatch.setattr(stopping, "listen", lambda: None)
    monkeypatch.setattr(sys, "argv", ["planner-jax", command])
    monkeypatch.setattr(cli, "main", lambda: 0)
    with pytest.raises(SystemExit):
        process.run()
    assert os.environ.get("PJRT_NPROC") == told


@pytest.mark.slow
@pytest.mark.skipif(machine.usable_cores() < 2, reason="needs two cores")
@pytest.mark.parametrize("task", ["hit", "catch"])
def test_rows_do_not_depend_on_the_number_of_cores(tmp_path, monkeypatch, task):
    for name in ("NPROC", "PJRT_NPROC"):
        monkeypatch.delenv(name, raising=False)
    rows = []
    for cores in (1, None):
        out = tmp_path / str(cores)
        command = ("sweep", task, "--num", "60", "--batch", "20", "--out", out)
        ended = wait_for(start(*command, cwd=tmp_path, cores=cores))
        assert ended.code == 0, ended.err
        rows.append(rows_of(out))
    assert rows[0] == rows[1]
