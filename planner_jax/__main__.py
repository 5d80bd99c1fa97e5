"""The process of the command `planner-jax`: hears signals before anything large is imported."""

import importlib.util
import os
import sys

from planner_jax.host import signals as stopping


def run() -> None:
    """Carry out the command of the process's arguments, and end the process."""
    stopping.listen()
    if sys.argv[1:2] == ["sweep"] and _is_on_cpu():
        # Chunks keep the cores busy. Rows would depend on the number of cores, which is that of
        # the threads of each computation if nothing else is said.
        os.environ.setdefault("PJRT_NPROC", os.environ.get("NPROC", "1"))
    try:
        from planner_jax.cli.main import main

        code = main()
    except Exception:
        if stopping.is_told():  # whatever a stop may break is no news
            stopping.leave()
        raise
    if stopping.is_told():
        stopping.leave()
    sys.exit(code)


def _is_on_cpu() -> bool:
    """Whether JAX will compute on a CPU; False where it depends on the machine's devices.

    With one thread, programs of a GPU would be compiled one after another.
    """
    plugins = importlib.util.find_spec("jax_plugins")  # where JAX, too, looks for other devices
    return plugins is None or os.environ.get("JAX_PLATFORMS") == "cpu"


if __name__ == "__main__":
    run()
