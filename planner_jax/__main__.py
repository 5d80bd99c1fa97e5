"""The process of the command `planner-jax`: hears signals before anything large is imported."""

import os
import sys

from planner_jax import stopping


def run() -> None:
    """Carry out the command of the process's arguments, and end the process."""
    stopping.listen()
    if sys.argv[1:2] == ["sweep"]:
        # Chunks keep the cores busy. Rows would depend on the number of cores, which is that of
        # the threads of each computation if nothing else is said.
        os.environ.setdefault("PJRT_NPROC", os.environ.get("NPROC", "1"))
    try:
        from planner_jax.cli import main

        code = main()
    except Exception:
        if stopping.is_told():  # whatever a stop may break is no news
            stopping.leave()
        raise
    if stopping.is_told():
        stopping.leave()
    sys.exit(code)


if __name__ == "__main__":
    run()
