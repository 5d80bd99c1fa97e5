"""Entry point of the command `planner-jax`; it installs signal handlers before it imports JAX."""

import importlib.util
import os
import sys

from planner_jax.host import signals as stopping
from planner_jax.host.terminal import prepare_streams


def run() -> None:
    """Run the subcommand that `sys.argv` names, and end the process with its exit code."""
    prepare_streams()
    stopping.listen()
    if sys.argv[1:2] == ["sweep"] and _is_on_cpu():
        # Give every computation one thread: a sweep runs several computations at once. With JAX's
        # default, one thread per core, results would depend on the number of cores.
        os.environ.setdefault("PJRT_NPROC", os.environ.get("NPROC", "1"))
    try:
        from planner_jax.cli.main import main

        code = main()
    except Exception:
        if stopping.is_stopped():  # the user's interrupt caused the error: do not report it
            stopping.leave()
        raise
    if stopping.is_stopped():
        stopping.leave()
    sys.exit(code)


def _is_on_cpu() -> bool:
    plugins = importlib.util.find_spec("jax_plugins")  # exists if JAX can use a GPU or a TPU
    return plugins is None or os.environ.get("JAX_PLATFORMS") == "cpu"


if __name__ == "__main__":
    run()
