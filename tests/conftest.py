"""Settings that every test shares; they must stand before the first import of JAX.

They are environment variables, so that the processes which tests start (the command line, the
notebooks' kernels) and the workers of a parallel run have them too.
"""

import os
from pathlib import Path

CACHE = Path(__file__).resolve().parents[1] / ".cache" / "jax"

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("MPLBACKEND", "agg")

import jax  # noqa: E402
import pytest  # noqa: E402


@pytest.fixture
def float64():
    """Double precision for the length of one test: the reference arithmetic of the suite."""
    with jax.enable_x64(True):
        yield


# Modules that take longest. Workers get whole modules in this order, so that none is left with a
# long one in the end.
LONGEST = ("test_sims_flights", "test_notebooks", "test_along", "test_catch_replan", "test_sweep")


def pytest_collection_modifyitems(items):
    """The longest modules first."""
    items.sort(key=lambda item: item.path.stem not in LONGEST)
