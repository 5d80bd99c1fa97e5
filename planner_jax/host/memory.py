"""What the machine has left, so that work which does not fit is refused before it begins."""

import os
import shutil
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")  # of a container, version 2


def available_memory() -> int | None:
    """Bytes that a process may still take, or None where the system does not tell."""
    found = [each for each in (_of_system(), _of_container()) if each is not None]
    return min(found, default=None)


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
        cached = dict(
            line.split() for line in (_CGROUP / "memory.stat").read_text("ascii").splitlines()
        )
    except (OSError, ValueError):
        return None
    if most == "max":
        return None
    return max(int(most) - taken + int(cached.get("inactive_file", 0)), 0)


def require_memory(name: str, num: int, bytes_each: int) -> None:
    """Raise `ValueError` if so many of something would not fit into memory.

    Args:
        name: of the argument that asks for them.
        num: how many.
        bytes_each: that one takes, as estimated.
    """
    free = available_memory()
    if free is not None and num * bytes_each > free:
        raise ValueError(
            f"{name} must be at most {max(free // bytes_each, 1):,}, for which this machine has "
            f"memory ({shown(bytes_each)} each, {shown(free)} free), got {num}"
        )


def require_disk(name: str, num: int, bytes_each: int, folder: str | os.PathLike) -> None:
    """Raise `ValueError` if so many rows would not fit on the disk of a folder that is to be.

    Args:
        name: of the argument that asks for them.
        num: how many.
        bytes_each: that one takes, as estimated.
        folder: which may not be there yet.
    """
    path = Path(folder).absolute()
    # A name that is too long for the disk is nowhere, and is told where the folder is made.
    there = next((each for each in [path, *path.parents] if os.path.exists(each)), Path.cwd())
    disk = shutil.disk_usage(there)
    free = disk.free
    if disk.total and num * bytes_each > free:  # some of the system's own folders have no disk
        raise ValueError(
            f"{name} must be at most {max(free // bytes_each, 1):,}, for which the disk has room "
            f"({shown(bytes_each)} each, {shown(free)} free), got {num}"
        )


def shown(size: float) -> str:
    """A number of bytes, to read."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1e3:
            return f"{size:.3g} {unit}"
        size /= 1e3
    return f"{size:.3g} TB"


def resident_memory() -> int | None:
    """Bytes that this process holds in memory now, or None where the system does not tell."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return None
    return int(pages) * os.sysconf("SC_PAGE_SIZE")
