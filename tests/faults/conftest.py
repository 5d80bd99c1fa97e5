"""Small runs for all modules of the folder."""

from pathlib import Path

import pytest
import typecheck
from hypothesis.configuration import set_hypothesis_home_dir

from tests.faults.quick import quick_sweeps
from tests.faults.runs import make_runs

set_hypothesis_home_dir(Path(__file__).resolve().parents[2] / ".cache" / "hypothesis")


@pytest.fixture(scope="package")
def runs(tmp_path_factory):
    """Provide the runs of `make_runs`, with quick sweeps as long as they are used."""
    place = tmp_path_factory.mktemp("faults")
    with quick_sweeps():
        make_runs(place)
        yield place


@pytest.fixture
def own_checks(monkeypatch):
    """Turn off the type checks of the tests, so that the library checks arguments itself."""
    monkeypatch.setattr(typecheck, "is_on", False)
