"""The table of compiled programs of default planners."""

import subprocess
import sys

import jax
import numpy as np
import pytest

from planner_jax.benchmarks import compilation


def test_rows_show_slow_programs_and_sums_of_all():
    programs = {
        "finish": compilation.Program(1, 200, 0.12, 0.01, 0.5),
        "refine": compilation.Program(2, 10_000, 1.0, 0.25, 7.96),
        "tiny": compilation.Program(3, 6, 0.0, 0.0, 0.04),
    }
    assert compilation.format_rows("hit", "pj.plan", 64, 11.31, programs) == [
        "| hit | pj.plan | 64 | refine | 2 | 10,000 | 1.0 | 0.2 | 8.0 |  |",
        "| hit | pj.plan | 64 | finish | 1 | 200 | 0.1 | 0.0 | 0.5 |  |",
        "| hit | pj.plan | 64 | all | 6 | 10,206 | 1.1 | 0.3 | 8.5 | 11.3 |",
    ]
    assert compilation.format_rows("hit", "f", 1, 0.0, {})[0].startswith(
        "| hit | f | 1 | all | 0 | 0 |"
    )


def test_programs_are_recorded_with_their_equations():
    @jax.jit
    def inner(x):
        return x * 2.0

    def sum_of_products(x):
        return inner(x).sum()

    with compilation.record_programs() as programs:
        compiled = jax.jit(sum_of_products)
        compiled(np.ones(3, np.float32)), compiled(np.ones(4, np.float32))
    assert list(programs) == ["sum_of_products"]
    program = programs["sum_of_products"]
    assert program.versions == 2 and program.equations == 6
    assert min(program.tracing, program.lowering, program.compiling) > 0.0


@pytest.mark.slow
def test_the_programs_of_planners_are_listed_with_their_sums(tmp_path):
    # In a new process, because programs that are compiled already would not be listed.
    options = ("--tasks", "hit,catch throws", "--num", "2", "--out", str(tmp_path / "run"))
    command = [sys.executable, "-m", "planner_jax.benchmarks.compilation", *options]
    subprocess.run(command, check=True, capture_output=True)
    lines = (tmp_path / "run" / "table.md").read_text().splitlines()
    sums = [line for line in lines if "| all |" in line]
    calls = (
        ["pj.plan", "1"],
        ["pj.plan", "2"],
        ["jit(pj.solve)", "1"],
        ["jit(pj.solve), quick", "1"],
    )
    expected = [[f"| {name}", *call] for name in ("hit", "catch throws") for call in calls]
    assert [line.split(" | ")[:3] for line in sums] == expected
    assert all(int(line.split(" | ")[5].replace(",", "")) > 1000 for line in sums)
