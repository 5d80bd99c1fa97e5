"""Where a run took place: versions, code, commit, device."""

import functools
import hashlib
import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

from planner_jax.host.processors import processor, threads_of_a_computation, usable_cores
from planner_jax.runs.settings import SettingError

_PACKAGE = Path(__file__).resolve().parents[1]


def installed_version(name: str) -> str | None:
    """Version of a package; None where it is used without being installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


@functools.cache
def code_digest() -> str:
    """SHA-256 of the names and contents of all that is installed of the package.

    Without benchmarks, which decide no row of a run.
    """
    digest = hashlib.sha256()
    for place, folders, files in os.walk(_PACKAGE, followlinks=True):
        folders[:] = sorted(set(folders) - {"__pycache__", "benchmarks"})
        for name in sorted(name for name in files if not name.startswith(".")):
            path = Path(place, name)
            digest.update(f"{path.relative_to(_PACKAGE)}\0".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def environment() -> dict[str, Any]:
    """Versions, code, git commit and device, for the manifest."""
    import jax

    device = jax.devices()[0]
    packages = ("planner-jax", "jax", "jaxlib", "numpy", "scipy", "pyarrow")
    return {
        "versions": {
            "python": platform.python_version(),
            **{name: installed_version(name) for name in packages},
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


def require_backend() -> str:
    """The platform that JAX computes on.

    Raises:
        SettingError: JAX has none that works, or the switch for kernels has a wrong value.
    """
    import jax

    from planner_jax.lanes.kernels import is_switched_on

    try:
        is_switched_on()
    except ValueError as error:
        raise SettingError(str(error)) from None
    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        # JAX 0.10 only asserts, without a word, where it knows a platform but has no device of it.
        reason = (str(error) or "JAX finds no device of it").splitlines()[0]
        asked = os.environ.get("JAX_PLATFORMS", "")
        raise SettingError(
            f"JAX_PLATFORMS must name a platform that works here, got {asked!r} ({reason})"
        ) from None


def _git_commit() -> str | None:
    """Commit of the checkout that holds this package, "+" behind it where files differ.

    None outside a checkout, and where git is missing.
    """

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
