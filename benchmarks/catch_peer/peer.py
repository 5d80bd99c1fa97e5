"""Build the C++ program of this folder, run it on a table of throws, and compare with the table.

The program minimises the objective of `planner_jax.task.catch.paper.PaperCatch`, on one core and
in double precision: one throw after another, none of them with a heap allocation. It shares no code
with the library.
"""

import csv
import dataclasses
import shutil
import subprocess
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_name("catch.cpp")
COMPILERS = ("g++", "c++")
# Without -ffinite-math-only: a step that is too long may overflow, and has to be seen.
FLAGS = ("-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math")
FLAGS += ("-fno-signed-zeros", "-fassociative-math", "-freciprocal-math")
NO_COMPILER = f"C++: not measured, there is no compiler ({' or '.join(COMPILERS)})"
AS_GOOD = 1e-3  # relative cost above the published one that counts as none


@dataclasses.dataclass(frozen=True)
class Settings:
    """How the program searches; the fields are its arguments on the command line."""

    relative: bool = False  # whitened offsets and the net from the ball, not q and p(T)
    memory: int = 48  # pairs of L-BFGS, at most 64; 0 for BFGS with a dense matrix
    past: int = 10  # iterations over which the cost is compared
    delta: float = 1e-7  # relative change of the cost over them that ends the search
    decrease: float = 1e-4  # of the weak Wolfe conditions
    curvature: float = 0.9
    interpolate: bool = True  # cubic trials within a bracket, not halves
    scale_q: float = 1.0  # units of the variables: waypoints or offsets, log T, p, v, a
    scale_t: float = 1.0
    scale_p: float = 1.0
    scale_v: float = 1.0
    scale_a: float = 1.0

    def words(self) -> list[str]:
        """The arguments of the program."""
        given = dataclasses.asdict(self)
        return [f"{name}={float(value):g}" for name, value in given.items()]


# The quickest settings found that hold `AS_GOOD` on at least 97 % of both published sets.
SEARCHES = {
    "C++, own L-BFGS, one core, double": Settings(
        memory=32, past=5, delta=8e-7, decrease=0.01, curvature=0.5,
        scale_q=0.35, scale_t=0.115, scale_p=0.33, scale_v=2.1, scale_a=5.1,
    ),
    "C++, own L-BFGS, relative variables": Settings(
        relative=True, memory=12, past=2, delta=6.8e-6, decrease=0.01,
        scale_q=3.6, scale_t=0.174, scale_p=0.235, scale_v=2.6, scale_a=3.8,
    ),
    "C++, own BFGS, relative variables": Settings(
        relative=True, memory=0, past=3, delta=3.5e-6, decrease=0.01,
        scale_q=11.9, scale_t=0.38, scale_p=0.88, scale_v=8.2, scale_a=23.7,
    ),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Figures:
    """What the program did with a table."""

    plans_per_second: float  # of processor time, reading and printing left out
    share_within: float  # of cases whose cost is at most `AS_GOOD` above the published one
    median_gap: float  # relative cost above the published one
    mean_iterations: float
    success_rate: float  # by the published test: 200 samples, five per cent to spare
    guess_error: float  # the guess's cost against the published one, the largest, relative

    def __str__(self) -> str:
        """In a line."""
        return (
            f"{self.plans_per_second:.0f} plans/s, gap <= {AS_GOOD:.0e} on "
            f"{100 * self.share_within:.1f} %, median {self.median_gap:.1e}, "
            f"{self.mean_iterations:.0f} iterations, success {100 * self.success_rate:.1f} %, "
            f"cost of the guess off by {self.guess_error:.1e} at most"
        )


def build(folder: Path) -> Path | None:
    """Compile the program into a folder; None where there is no compiler (`NO_COMPILER`)."""
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        return None
    program = folder / "catch"
    subprocess.run([compiler, *FLAGS, str(SOURCE), "-o", str(program)], check=True)
    return program


def measure(program: Path, table: Path, settings: Settings, repeats: int = 5) -> Figures:
    """Run the program on a table, and compare.

    Args:
        program: from `build`.
        table: with the columns of tests/data/catch_paper.csv.
        settings: of the search.
        repeats: rounds over all cases, of which the quickest counts.
    """
    with table.open(newline="", encoding="utf-8") as file:
        published = list(csv.DictReader(file))
    words = [str(program), str(table), *settings.words(), f"repeats={repeats}"]
    done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True)
    first, *lines = done.stdout.splitlines()
    found = list(csv.DictReader(lines))

    def column(rows: list[dict[str, str]], name: str) -> np.ndarray:
        return np.array([float(row[name]) for row in rows])

    gap = column(found, "cost") / column(published, "cost_ref") - 1.0
    guess = column(found, "J0") / column(published, "J0_M4") - 1.0
    return Figures(
        plans_per_second=len(published) / float(first.removeprefix("seconds ")),
        share_within=float(np.mean(gap <= AS_GOOD)),
        median_gap=float(np.median(gap)),
        mean_iterations=float(column(found, "iterations").mean()),
        success_rate=float(column(found, "success").mean()),
        guess_error=float(np.abs(guess).max()),
    )
