"""What this machine computes with beside its GPUs: kind of processor, cores, threads of XLA."""

import functools
import os
import platform
from pathlib import Path

_VECTORS = ("avx512f", "avx2", "avx", "sve2", "sve", "asimd")  # the widest first


def usable_cores() -> int:
    """Cores that this process may use, which can be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache  # what the environment says later, JAX does not hear
def threads_of_a_computation() -> int:
    """Threads that XLA has for one computation on a CPU; on some CPUs their number decides digits.

    As PJRT_NPROC or NPROC says when JAX begins, or else one for each usable core. To be asked for
    once JAX has begun, or when it is about to.
    """
    told = os.environ.get("PJRT_NPROC") or os.environ.get("NPROC", "")
    return max(int(told), 1) if told.isdecimal() else usable_cores()


@functools.cache
def processor() -> str:
    """The processor's name, with the widest vectors that it computes in, as the system tells them.

    By both NumPy and XLA choose how they compute, and with it the last digits.
    """
    entries: dict[str, str] = {}
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        for line in text.splitlines():
            name, _, value = line.partition(":")
            entries.setdefault(name.strip().lower(), value.strip())
    except OSError:  # another system than Linux
        pass
    name = entries.get("model name") or platform.processor() or platform.machine()
    known = (entries.get("flags") or entries.get("features") or "").split()
    widest = next((vectors for vectors in _VECTORS if vectors in known), None)
    return f"{name} ({widest})" if widest else name
