"""The process of the command `planner-jax`: hears signals before anything large is imported."""

import sys

from planner_jax import stopping


def run() -> None:
    """Carry out the command of the process's arguments, and end the process."""
    stopping.listen()
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
