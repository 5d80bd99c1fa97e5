"""Tests that inject faults into runs: kills, two writers, damaged files, full disks and signals.
`make test-faults` injects each many times; the modules test_*.py have short default tests."""

import os
from pathlib import Path

# The variables apply to `python -m tests.faults` and its commands, and equal tests/conftest.py.
CACHE = Path(__file__).resolve().parents[2] / ".cache" / "jax"
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("MPLBACKEND", "agg")
