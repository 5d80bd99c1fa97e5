"""Compiled programs on the disk, so that only the first process waits for the compiler."""

import contextlib
import functools
import math
import os
import sys
import time
import warnings
from pathlib import Path

from planner_jax.host.files import open_plain

SWITCH = "PLANNER_JAX_CACHE"  # the environment variable that disables the cache with the value off
# [bytes] Size above which the oldest programs are deleted. JAX's own limit is not used: for every
# program that it writes, it lists the whole folder, which takes 0.3 s for 10,000 programs.
LIMIT = 2 * 10**9
# [s] Least age of a program that is checked, since another process may be writing a newer one, and
# time before the last check from which on programs are checked again.
_SETTLED, _AGAIN = 2.0, 60.0


def cache_folder() -> Path:
    """Return the default folder of compiled programs, within the platform's cache folder."""
    usual = "~/Library/Caches" if sys.platform == "darwin" else "~/.cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser(usual), "planner-jax", "jax")


def is_on() -> bool:
    """Return whether neither PLANNER_JAX_CACHE=off nor an option of JAX disables the cache."""
    import jax

    enabled = jax.config.jax_enable_compilation_cache  # type: ignore[attr-defined]
    return os.environ.get(SWITCH) != "off" and enabled


@functools.cache
def keep_compiled_programs() -> Path | None:
    """Let JAX write compiled programs to a folder on the disk and read them from there.

    The first `pj.plan` of a process and all commands call this function. Call it yourself to store
    programs that are compiled before the first plan. The folder is
    JAX_COMPILATION_CACHE_DIR or JAX's option `jax_compilation_cache_dir` where one of them is set,
    else planner-jax/jax in the user's cache folder, which is limited to 2 GB. With the environment
    variable PLANNER_JAX_CACHE=off, JAX's options are unchanged. Programs that were not written
    completely, for example on a full disk, are deleted, because JAX would never write them again.
    Whoever can write to the folder can make this process run any code.

    Returns:
        The folder, or None if there is none or it cannot be created.
    """
    import jax

    chosen = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if is_on():
        # If JAX cannot read or write a file of the cache, it compiles the program: not an error. A
        # file that is not whole is deleted by the next process.
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
        if chosen is None:
            chosen = cache_folder()
            try:
                chosen.mkdir(parents=True, exist_ok=True)
            except OSError:
                return None
            _tidy(chosen, LIMIT)
            jax.config.update("jax_compilation_cache_dir", str(chosen))
        elif chosen and "://" not in str(chosen):
            _tidy(Path(chosen))
        if jax.config.jax_persistent_cache_min_compile_time_secs == 1.0:  # type: ignore[attr-defined]
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # 1 is the default
    return Path(chosen) if chosen else None


def _tidy(folder: Path, limit: float = math.inf) -> None:
    """Delete incomplete programs, and the oldest programs until all have at most `limit` bytes."""
    checked = folder / "checked"  # its time of change is the time of the last check
    with contextlib.suppress(OSError):  # the folder is read-only, or another process deletes files
        last = checked.stat().st_mtime if checked.exists() else 0.0
        files = {entry.path: entry.stat() for entry in os.scandir(folder) if entry.is_file()}
        checked.touch()
        for path, found in list(files.items()):
            is_due = last - _AGAIN < found.st_mtime < time.time() - _SETTLED
            if is_due and path.endswith("-cache") and not _is_whole(path, found.st_size):
                os.unlink(path)
                del files[path]
        excess = sum(found.st_size for found in files.values()) - limit
        for path in sorted(files, key=lambda path: max(files[path].st_atime, files[path].st_mtime)):
            if excess <= 0:
                return
            os.unlink(path)
            excess -= files[path].st_size


def _is_whole(path: str, size: int) -> bool:
    """Return whether the blocks of a file of Zstandard (RFC 8878) end where the file ends.

    Other files, which JAX compresses by zlib without the package zstandard, need only be not empty.
    """
    with open_plain(path, max(size, LIMIT)) as file:
        if file.read(4) != b"\x28\xb5\x2f\xfd":
            return size > 4
        kind = file.read(1)[0] if size > 4 else 0
        is_single = bool(kind & 32)
        size_of_content = (1 if is_single else 0, 2, 4, 8)[kind >> 6]
        place = 5 + (not is_single) + (0, 1, 2, 4)[kind & 3] + size_of_content
        is_last = False
        while not is_last and place < size:
            file.seek(place)
            block = int.from_bytes(file.read(3), "little")
            is_last, is_run = bool(block & 1), (block >> 1) & 3 == 1
            place += 3 + (1 if is_run else block >> 3)
        return is_last and place + (4 if kind & 4 else 0) == size
