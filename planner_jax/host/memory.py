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


def free_disk(folder: str | os.PathLike) -> int | None:
    """Return the free bytes on the disk of a folder, which may not exist yet; None if unknown."""
    path = Path(folder).absolute()
    # A name that is too long for the disk does not exist; the disk of a parent is measured.
    existing = next((each for each in [path, *path.parents] if os.path.exists(each)), Path.cwd())
    disk = shutil.disk_usage(existing)
    return disk.free if disk.total else None  # some of the system's own folders have no disk


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
