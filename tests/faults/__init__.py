"""Faults on purpose: kills, twins, damaged files, full disks and signals. `make test-faults` tries
them in numbers; the modules test_*.py hold a short form of each for the default suite."""

import os
from pathlib import Path

# As in tests/conftest.py, for `python -m tests.faults` and the commands that it starts.
CACHE = Path(__file__).resolve().parents[2] / ".cache" / "jax"
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("MPLBACKEND", "agg")
