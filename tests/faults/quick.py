"""The command `planner-jax` for tests: planners make one search, to compile quickly.

python -m tests.faults.quick sweep hit ...
"""

import contextlib
from collections.abc import Iterator

from planner_jax import __main__ as command
from planner_jax.host import signals


@contextlib.contextmanager
def quick_sweeps(is_reported: bool = False) -> Iterator[None]:
    import pytest

    from planner_jax.sweep.catch.sweep import CatchSweep
    from planner_jax.sweep.hit.sweep import HitSweep
    from planner_jax.sweep.sweep import Sweep
    from tests.sweeps import quick_catch, quick_hit

    with pytest.MonkeyPatch.context() as patch:
        for kind, planner in ((HitSweep, quick_hit()), (CatchSweep, quick_catch())):
            others = {"other": planner} if is_reported else {}
            patch.setattr(kind, "planner", lambda *_, planner=planner: planner)
            patch.setattr(kind, "other_planners", lambda *_, others=others: others)
            patch.setattr(kind, "figures", Sweep.figures if is_reported else ())
        yield


def run() -> None:
    signals.listen()  # as the command itself does, before anything large is imported
    from planner_jax.cli import main as cli

    real = cli.main

    def main() -> int:
        with quick_sweeps(is_reported=True):
            return real()

    cli.main = main
    command.run()


if __name__ == "__main__":
    run()
