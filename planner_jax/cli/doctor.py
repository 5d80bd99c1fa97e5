"""The command `planner-jax doctor`: it checks devices, precision and caches, and times plans."""

import dataclasses
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path

from planner_jax.core.missing_extra import install_line
from planner_jax.host.compile_cache import LIMIT, SWITCH, cache_folder, keep_compiled_programs
from planner_jax.host.machine import usable_cores
from planner_jax.runs.environment import environment, require_backend

_BATCH = 1024  # number of planned and refereed hits
# Greatest relative error of a matrix product in full float32 precision. The error of float32 is
# about 1e-7, and the error of a GPU's TF32 format, with its ten bits of mantissa, about 1e-3.
_FULL_PRECISION = 1e-5


@dataclasses.dataclass(frozen=True)
class Finding:
    """One line of the report of `planner-jax doctor`."""

    name: str
    text: str
    good: bool = True  # False if the user should change something


def examine() -> Iterator[Finding]:
    """Examine versions, system, devices, GPU kernels, precision, cache and plans, line by line."""
    require_backend()
    folder = keep_compiled_programs()
    found = environment()
    versions = {name: version or "not installed" for name, version in found["versions"].items()}
    yield Finding("versions", ", ".join(f"{name} {version}" for name, version in versions.items()))
    system = f"{found['device']['system']} {found['device']['machine']}, {usable_cores()} cores"
    yield Finding("system", f"{system}, load average {os.getloadavg()[0]:.1f}")
    yield _devices()
    yield _kernels()
    yield _precision()
    yield _cache(folder)
    yield from _plans()


def _devices() -> Finding:
    import jax

    devices = jax.local_devices()
    memory = (devices[0].memory_stats() or {}).get("bytes_limit")
    text = f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})"
    if memory:
        text += f", {memory / 2**30:.0f} GiB for JAX each"
    if devices[0].platform == "cpu" and os.path.exists("/dev/nvidia0"):
        hint = f"; there is an NVIDIA GPU that JAX does not use: {install_line('gpu')}"
        return Finding("devices", text + hint, good=False)
    return Finding("devices", text)


def _kernels() -> Finding:
    from planner_jax.lanes import kernels

    state = kernels.kernels()
    if not kernels.has_gpu():
        return Finding("kernels", f"{state.value}; JAX has no GPU to use them on")
    return Finding("kernels", state.value, good=state is not kernels.Kernels.MISSING)


def _precision() -> Finding:
    import jax.numpy as jnp
    import numpy as np
    from jax import lax

    left, right = np.random.default_rng(0).standard_normal((2, 256, 256)).astype(np.float32)
    exact = left.astype(float) @ right.astype(float)

    def error(precision: lax.Precision) -> float:
        product = np.asarray(jnp.matmul(left, right, precision=precision))
        return float(np.max(np.abs(product - exact)) / np.max(np.abs(exact)))

    ours, default = error(lax.Precision.HIGHEST), error(lax.Precision.DEFAULT)
    text = f"float32 products have errors of {ours:.0e}, by the default of JAX {default:.0e}"
    return Finding("precision", text, good=ours < _FULL_PRECISION)


def _cache(folder: Path | None) -> Finding:
    if folder is None or not folder.is_dir():
        is_off = os.environ.get(SWITCH) == "off"
        text = f"off, by {SWITCH}" if is_off else "no folder for compiled programs can be made"
        return Finding("cache", text, good=is_off)
    sizes = [entry.stat().st_size for entry in folder.rglob("*") if entry.is_file()]
    limit = f" of at most {LIMIT / 1e6:,.0f} MB" if folder == cache_folder() else ""
    programs = f"{len(sizes):,} files, {sum(sizes) / 1e6:,.0f} MB{limit} of compiled programs"
    return Finding("cache", f"{programs} in {folder}")


def _plans() -> Iterator[Finding]:
    import jax
    import numpy as np

    from planner_jax.core.protocol import take
    from planner_jax.core.tasks import task_named
    from planner_jax.planning.plan import plan

    hit = task_named("hit")
    planner, batch = hit.planner(), jax.tree.map(np.asarray, hit.draw(_BATCH))
    for name, cases in (("one plan", take(batch, 0)), (f"{_BATCH} plans", batch)):
        seconds, plans = [], None
        for _ in range(6):
            start = time.perf_counter()
            plans = plan(planner, cases)
            seconds.append(time.perf_counter() - start)
        success = float(np.mean(hit.judge(cases, plans).success))
        text = (
            f"{1e3 * min(seconds[1:]):.2f} ms (the first call, with what had to be compiled, "
            f"{seconds[0]:.1f} s); the referee accepts {100.0 * success:.1f} %"
        )
        yield Finding(name, text, good=success > 0.99)


def report() -> bool:
    """Print all findings about the installation, and return whether all of them are good."""
    print(f"planner-jax doctor, Python {platform.python_version()}")
    good = True
    for finding in examine():
        mark = "ok " if finding.good else "BAD"
        print(f"{mark}  {finding.name:<12} {finding.text}", flush=True)
        good &= finding.good
    return good
