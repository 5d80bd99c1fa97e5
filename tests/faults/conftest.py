"""Fixtures of the tests that inject faults into small runs."""

from pathlib import Path

import pytest
import typecheck
from hypothesis.configuration import set_hypothesis_home_dir

from tests.faults.quick import quick_sweeps
from tests.faults.runs import make_runs

set_hypothesis_home_dir(Path(__file__).resolve().parents[2] / ".cache" / "hypothesis")


@pytest.fixture(scope="package")
def runs(tmp_path_factory):
    place = tmp_path_factory.mktemp("faults")
    with quick_sweeps():
        make_runs(place)
        yield place


@pytest.fixture
def own_checks(monkeypatch):
    """Disable the tests' type checks (`typecheck`), so that the library's own checks are tested."""
    monkeypatch.setattr(typecheck, "is_on", False)
