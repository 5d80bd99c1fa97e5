"""Functions that measure memory, disk, processor and threads; they do not need JAX."""

import functools
import os
import platform
import shutil
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")  # control group of a container, version 2


def available_memory() -> int | None:
    """Return the number of bytes that a process can still allocate; None if unknown."""
    return min([each for each in (_of_system(), _of_container()) if each is not None], default=None)


def _of_system() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        try:
            return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        except (OSError, ValueError, AttributeError):
            return None
    kilobytes = dict(line.split(":", 1) for line in lines if ":" in line)
    return int(kilobytes["MemAvailable"].split()[0]) * 1024


def _of_container() -> int | None:
    try:
        most = (_CGROUP / "memory.max").read_text(encoding="ascii").strip()
        taken = int((_CGROUP / "memory.current").read_text(encoding="ascii"))
        lines = (_CGROUP / "memory.stat").read_text(encoding="ascii").splitlines()
        cached = dict(line.split() for line in lines)
    except (OSError, ValueError):
        return None
    if most == "max":
        return None
    return max(int(most) - taken + int(cached.get("inactive_file", 0)), 0)


def free_disk(folder: str | os.PathLike) -> int | None:
    """Return the free bytes on the disk of a folder, which need not exist; None if unknown."""
    path = Path(folder).absolute()
    # A name that is too long for the disk does not exist; the disk of its parent is measured.
    existing = next((each for each in [path, *path.parents] if os.path.exists(each)), Path.cwd())
    disk = shutil.disk_usage(existing)
    return disk.free if disk.total else None  # some folders of the system have no disk


def format_size(size: float) -> str:
    """Format a number of bytes with three digits and a decimal unit, such as "1.54 GB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1e3:
            return f"{size:.3g} {unit}"
        size /= 1e3
    return f"{size:.3g} TB"


def resident_memory() -> int | None:
    """Return the bytes that this process holds in memory; None if unknown."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return None
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


_VECTORS = ("avx512f", "avx2", "avx", "sve2", "sve", "asimd")  # instruction sets, widest first


def usable_cores() -> int:
    """Return the number of cores that this process may use; the machine may have more."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # only Linux has this function
        return os.cpu_count() or 1


@functools.cache  # JAX reads the environment once
def threads_of_a_computation() -> int:
    """Return the number of threads that XLA uses for one computation on a CPU.

    The environment variable PJRT_NPROC or NPROC sets this number, by default the number of usable
    cores. On some CPUs the number of threads affects the last digits of results.
    """
    number = os.environ.get("PJRT_NPROC") or os.environ.get("NPROC", "")
    return max(int(number), 1) if number.isdecimal() else usable_cores()


@functools.cache
def processor() -> str:
    """Return the processor's name and widest vector instructions, such as "... (avx2)"."""
    entries: dict[str, str] = {}
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        for line in text.splitlines():
            name, _, value = line.partition(":")
            entries.setdefault(name.strip().lower(), value.strip())
    except OSError:  # only Linux has this file
        pass
    name = entries.get("model name") or platform.processor() or platform.machine()
    known = (entries.get("flags") or entries.get("features") or "").split()
    widest = next((vectors for vectors in _VECTORS if vectors in known), None)
    return f"{name} ({widest})" if widest else name
