"""A C++ rewrite of the planner of [Yu2023catch] finds the optima stored in `tests/data`."""

from pathlib import Path

import pytest

from planner_jax.benchmarks.catch_peer.peer import NO_COMPILER, SEARCHES, build, measure

DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    found = build(tmp_path_factory.mktemp("peer"))
    if found is None:
        pytest.skip(NO_COMPILER)
    return found


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("name", ["paper", "hard"])
def test_guess_and_optimum_are_the_published_ones(program, name, search):
    found = measure(program, DATA / f"catch_{name}.csv", SEARCHES[search], repeats=1)
    assert found.guess_error <= 1e-8
    assert found.share_within >= 0.95
    assert abs(found.median_gap) <= 1e-4
    # Penalties permit small violations of limits, so that the net misses the ball in some cases.
    assert found.success_rate >= 0.97


def test_without_a_compiler_there_is_no_program(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert build(tmp_path) is None and not list(tmp_path.iterdir())
