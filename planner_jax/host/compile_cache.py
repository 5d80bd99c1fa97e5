"""Keep compiled programs on the disk, so that only the first run waits for the compiler."""

import os
import warnings
from pathlib import Path


def cache_folder() -> Path:
    """Return the folder of compiled programs: JAX_COMPILATION_CACHE_DIR, or the user's cache."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join("~", ".cache")
    default = os.path.join(os.path.expanduser(home), "planner-jax", "jax")
    return Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or default)


def keep_compiled_programs() -> Path | None:
    """Let JAX write compiled programs to `cache_folder` and read them from there.

    The command line and the benchmarks call this function. In a program of your own call it once,
    before the first plan.

    Returns:
        The folder, or None if it cannot be created.
    """
    import jax

    # An entry that cannot be read or written costs a compilation, not the run.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    return folder
