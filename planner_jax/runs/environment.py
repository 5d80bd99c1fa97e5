"""Versions, code digest, commit and device of a run, which are stored in its manifest."""

import functools
import hashlib
import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path

from planner_jax.core.errors import ArgumentError
from planner_jax.host.machine import processor, threads_of_a_computation, usable_cores
from planner_jax.runs.manifest import Entries

# Packages whose versions affect the stored plans and verdicts of a run.
_PACKAGES = ("planner-jax", "jax", "jaxlib", "numpy", "scipy")
_PACKAGE = Path(__file__).resolve().parents[1]


def find_version(name: str) -> str | None:
    """Return the version of an installed package; None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


@functools.cache
def code_digest() -> str:
    """Return the SHA-256 of the names and contents of this library's files except benchmarks."""
    digest = hashlib.sha256()
    for place, folders, files in os.walk(_PACKAGE, followlinks=True):
        folders[:] = sorted(set(folders) - {"__pycache__", "benchmarks"})
        for name in sorted(name for name in files if not name.startswith(".")):
            path = Path(place, name)
            digest.update(f"{path.relative_to(_PACKAGE)}\0".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def environment() -> Entries:
    """Return versions of packages, digest of the code, git commit and device, for the manifest."""
    import jax

    device = jax.devices()[0]
    return {
        "versions": {
            "python": platform.python_version(),
            **{name: find_version(name) for name in (*_PACKAGES, "pyarrow")},
        },
        "code": code_digest(),
        "git_commit": _git_commit(),
        "device": {
            "platform": device.platform,
            "kind": device.device_kind,
            "count": jax.device_count(),
            "cpu_count": usable_cores(),
            "processor": processor(),
            "threads": threads_of_a_computation() if device.platform == "cpu" else None,
            "machine": platform.machine(),
            "system": platform.system(),
        },
    }


def makers_of(found: Entries) -> Entries:
    """Return the entries of `environment()` that affect the plans and verdicts of a run."""
    device = found["device"]
    return {
        **{name: found["versions"][name] for name in _PACKAGES},
        **{f"devices of {name}": device[name] for name in ("platform", "kind", "count")},
        "processor": device["processor"],
        "threads of a computation (NPROC)": device["threads"],
        "files of planner-jax": found["code"][:12],
    }


def require_backend() -> str:
    """Return the platform on which JAX computes; raise `ArgumentError` if none works."""
    import jax

    from planner_jax.lanes.kernels import is_switched_on

    is_switched_on()
    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        # JAX 0.10 raises an AssertionError without text if the platform has no device here.
        reason = (str(error) or "JAX finds no device of it").splitlines()[0]
        shown = f"{os.environ.get('JAX_PLATFORMS', '')!r} ({reason})"
        rule = "a platform that works here"
        raise ArgumentError("JAX_PLATFORMS", rule, verb="name", shown=shown) from None


def _git_commit() -> str | None:
    """Return the checkout's commit hash, with "+" if tracked files differ; None without git."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(_PACKAGE), *arguments]
        found = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
        return found.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ".")
        return git("rev-parse", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return None
