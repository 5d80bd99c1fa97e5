"""List the files of the library that are imported to draw, plan and judge one hit.

    python -m tests.closure

The program prints each file with its number of lines.
"""

import sys
from pathlib import Path

import planner_jax as pj

LIBRARY = Path(pj.__file__).parent


def plan_one_hit() -> None:
    cases = pj.hit.draw(1)
    pj.hit.judge(cases, pj.plan(pj.hit.planner(), cases))


def list_imported() -> dict[str, int]:
    """Return the number of lines of each imported file of the library, by its relative path."""
    modules = [module for name, module in sys.modules.items() if name.split(".")[0] == LIBRARY.name]
    paths = sorted({Path(file) for module in modules if (file := module.__file__)})
    return {str(p.relative_to(LIBRARY)): len(p.read_text().splitlines()) for p in paths}


if __name__ == "__main__":
    plan_one_hit()
    files = list_imported()
    for name, lines in files.items():
        print(f"{lines:5} {name}")
    print(f"{len(files)} files, {sum(files.values())} lines")
