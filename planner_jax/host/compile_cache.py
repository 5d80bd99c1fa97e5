"""Compiled programs kept from run to run, so that only the first run waits for the compiler."""

import os
import warnings
from pathlib import Path


def cache_folder() -> Path:
    """Where compiled programs are kept: JAX_COMPILATION_CACHE_DIR, or the user's cache."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join("~", ".cache")
    default = os.path.join(os.path.expanduser(home), "planner-jax", "jax")
    return Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or default)


def keep_compiled_programs() -> Path | None:
    """Let JAX keep what it compiles in `cache_folder`, and find it there again.

    The command line and the benchmarks do so. In a program of your own call it once, before
    the first plan.

    Returns:
        The folder, or None where it cannot be made.
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
