"""Compiled programs on the disk, so that only the first process waits for the compiler."""

import contextlib
import functools
import os
import sys
import time
import warnings
from pathlib import Path

SWITCH = "PLANNER_JAX_CACHE"  # the environment variable that disables the cache with the value off
# [bytes] Size above which the oldest programs are deleted. JAX's own limit is not used: for every
# program that it writes, it lists the whole folder, which takes 0.3 s for 10,000 programs.
LIMIT = 2 * 10**9
_SETTLED = 5.0  # [s] least age of a program that is checked; a newer one may be half-written


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

    The first `pj.plan` or `pj.solve` of a process and all commands call this function. Call it
    yourself to store programs that are compiled before the first plan. The folder is
    JAX_COMPILATION_CACHE_DIR or JAX's option `jax_compilation_cache_dir` where one of them is set,
    else planner-jax/jax in the user's cache folder, which is limited to 2 GB. With the environment
    variable PLANNER_JAX_CACHE=off, JAX's options are unchanged.

    Returns:
        The folder, or None if there is none or it cannot be created.
    """
    import jax

    chosen = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if is_on() and chosen != "":
        # If JAX cannot read or write a file of the cache, it compiles the program: not an error.
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
        if chosen is None:
            chosen = cache_folder()
            try:
                chosen.mkdir(parents=True, exist_ok=True)
            except OSError:
                return None
            jax.config.update("jax_compilation_cache_dir", str(chosen))
        _tidy(Path(chosen))
        if jax.config.jax_persistent_cache_min_compile_time_secs == 1.0:  # type: ignore[attr-defined]
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # 1 is the default
    return Path(chosen) if chosen else None


def _tidy(folder: Path) -> None:
    checked = folder / "checked"  # its time of change is the time of the last check
    with contextlib.suppress(OSError):  # the folder is read-only, or another process deletes files
        last = checked.stat().st_mtime if checked.exists() else 0.0
        files = [(str(each), each.stat()) for each in folder.glob("*-cache")]
        checked.touch()
        excess = sum(stat.st_size for _, stat in files) - LIMIT if folder == cache_folder() else 0
        for path, stat in sorted(files, key=lambda file: max(file[1].st_atime, file[1].st_mtime)):
            is_due = last - _SETTLED < stat.st_mtime < time.time() - _SETTLED
            if excess > 0 or is_due and not _is_whole(Path(path).read_bytes()):
                os.unlink(path)
                excess -= stat.st_size


def _is_whole(data: bytes) -> bool:
    try:  # as JAX does, which compresses programs by the package zstandard or without it by zlib
        return bool(__import__("zstandard" if data[:2] == b"(\xb5" else "zlib").decompress(data))
    except Exception as error:  # such as `zlib.error`
        return isinstance(error, ImportError)
