"""One set of small runs for all modules of the folder."""

from pathlib import Path

import pytest
import typecheck
from hypothesis.configuration import set_hypothesis_home_dir

from tests.faults.quick import quick_sweeps
from tests.faults.runs import make_runs

set_hypothesis_home_dir(Path(__file__).resolve().parents[2] / ".cache" / "hypothesis")


@pytest.fixture(scope="package")
def runs(tmp_path_factory):
    """The runs of `make_runs`, and sweeps that are quick for as long as they are used."""
    place = tmp_path_factory.mktemp("faults")
    with quick_sweeps():
        make_runs(place)
        yield place


@pytest.fixture
def own_checks(monkeypatch):
    """Have the library check malformed arguments itself, without the types that tests check."""
    monkeypatch.setattr(typecheck, "is_on", False)
