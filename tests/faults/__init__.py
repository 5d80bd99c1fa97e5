"""Tests that inject faults into runs: kills, two writers, damaged files, full disks and signals.
`make test-faults` injects each many times; the modules test_*.py have short default tests."""

import os
from pathlib import Path

# These variables, as in tests/conftest.py, are for `python -m tests.faults` and its commands.
CACHE = Path(__file__).resolve().parents[2] / ".cache" / "jax"
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("MPLBACKEND", "agg")
