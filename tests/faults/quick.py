"""The command `planner-jax` whose sweeps compile one small program a task.

python -m tests.faults.quick sweep hit ...
"""

from planner_jax import __main__ as command
from planner_jax.host import signals


def run() -> None:
    """Carry out the command of the process's arguments by quick planners."""
    signals.listen()  # as the command itself does, before anything large is imported
    from planner_jax.cli import main as cli

    real = cli.main

    def main() -> int:
        from tests.faults.runs import quick_sweeps

        with quick_sweeps(is_reported=True):
            return real()

    cli.main = main
    command.run()


if __name__ == "__main__":
    run()
