"""Entry point of the command `planner-jax`: handles signals before anything large is imported."""

import importlib.util
import os
import sys

from planner_jax.host import signals as stopping


def run() -> None:
    """Run the command in the process's arguments, and end the process."""
    stopping.listen()
    if sys.argv[1:2] == ["sweep"] and _is_on_cpu():
        # Chunks keep the cores busy. By default a computation has one thread for each core, so
        # that rows would depend on the number of cores.
        os.environ.setdefault("PJRT_NPROC", os.environ.get("NPROC", "1"))
    try:
        from planner_jax.cli.main import main

        code = main()
    except Exception:
        if stopping.is_stopped():  # errors that a stop causes are not reported
            stopping.leave()
        raise
    if stopping.is_stopped():
        stopping.leave()
    sys.exit(code)


def _is_on_cpu() -> bool:
    """Return whether JAX will certainly compute on a CPU.

    On a GPU one thread would compile programs one after another.
    """
    plugins = importlib.util.find_spec("jax_plugins")  # JAX finds other devices in this package
    return plugins is None or os.environ.get("JAX_PLATFORMS") == "cpu"


if __name__ == "__main__":
    run()
