"""Check the project's language: first words of docstrings, forbidden phrases, function names.

    python -m tests.language [PATH ...]

The program prints, by default for the library, simulations, policies and benchmarks:

* the share of function docstrings that begin with an imperative verb of `VERBS`, and the others;
* lines of code, pages and notebooks with a phrase of `PHRASES`;
* functions whose name is a single participle, such as `found`; properties are not checked.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.tracked import ROOT, tracked_files

CODE = ("planner_jax", "sims", "policies", "benchmarks")
PAGES = (*CODE, "docs", "notebooks", "tests", "README.md", "CONTRIBUTING.md")
VERBS = set(
    """
    Accelerate Accept Add Advance Allocate Answer Append Apply Attach Bind Bring Build Carry
    Centre Check Choose Collect Combine Compare Compile Compose Compute Construct Continue Convert
    Copy Count Cover Create Cut Decide Define Describe Differentiate Discard Divide Do Draw Drive
    Drop End Estimate Evaluate Examine Execute Expand Expect Explain Extend Extract Filter Find
    Finish Fit Flush Fly Follow Forget Format Gather Generate Give Group Halve Hold Import Index
    Initialise Install Integrate Interpolate Intersect Invert Join Judge Keep Label Learn Let
    Limit List Load Lock Look Make Map Mark Measure Merge Minimise Mirror Move Multiply Name
    Normalise Note Observe Open Optimise Order Pack Pad Parse Pick Place Plan Play Poison Predict
    Prepare Print Project Propose Provide Raise Rank Read Record Reduce Refine Refuse Register
    Release Remove Render Reorder Repeat Replace Replay Report Reset Reshape Resolve Resume Return
    Reward Rotate Run Sample Save Scale Search Select Send Serve Set Shift Show Simulate Smooth
    Solve Sort Split Stack Start Step Stop Store Subtract Sum Switch Tabulate Take Test Time Trace
    Track Train Transform Translate Try Turn Unpack Update Use Verify View Wait Warm Weight Wrap
    Write Yield
    """.split()
)
PHRASES = re.compile(r"\b(that of|those of|of which|likewise)\b", re.IGNORECASE)
IRREGULAR = set(
    """
    begun bent bound brought built chosen drawn driven felt flown found given gone got held kept
    known left lent made meant met seen sent shown spent taken told thrown worn written
    """.split()
)
VERBS_IN_ED = {"embed", "exceed", "feed", "need", "proceed", "seed", "shed", "speed"}


def _files(paths: tuple[str, ...], endings: tuple[str, ...]) -> Iterator[Path]:
    """Yield the files that git tracks below `paths` and whose names end with one of `endings`."""
    yield from (ROOT / name for name in tracked_files(*paths) if name.endswith(endings))


def _functions(paths: tuple[str, ...]) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield every function except properties and fixtures, as ("file:line", syntax tree)."""
    for path in _files(paths, (".py",)):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                decorators = " ".join(map(ast.unparse, node.decorator_list))
                if not re.search(r"property|setter|fixture", decorators):
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", node


def share_of_imperatives(paths: tuple[str, ...] = CODE) -> tuple[float, list[str]]:
    """Return the share of function docstrings that begin with a verb of VERBS, and the others."""
    num, others = 0, []
    for place, node in _functions(paths):
        text = ast.get_docstring(node)
        if text:
            num += 1
            if text.split()[0] not in VERBS:
                others.append(f"{place} {node.name}: {text.splitlines()[0]}")
    return 1.0 - len(others) / max(num, 1), others


def find_phrases(paths: tuple[str, ...] = PAGES) -> list[str]:
    """Return the lines of code, pages and notebooks that use one of `PHRASES`."""
    return [
        f"{path.relative_to(ROOT)}:{number} {line.strip()[:100]}"
        for path in _files(paths, (".py", ".md", ".ipynb"))
        if path.name != Path(__file__).name
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if PHRASES.search(line)
    ]


def find_participles(paths: tuple[str, ...] = CODE) -> list[str]:
    """Return file, line and name of the functions whose name is a single participle (`found`)."""
    return [
        f"{place} {node.name}"
        for place, node in _functions(paths)
        if (word := node.name.strip("_")) in IRREGULAR
        or (re.fullmatch(r"[a-z]+ed", word) and word not in VERBS_IN_ED)
    ]


def main() -> None:
    """Print each finding in a line, and then the numbers of findings."""
    given = tuple(sys.argv[1:])
    share, others = share_of_imperatives(given or CODE)
    phrases, participles = find_phrases(given or PAGES), find_participles(given or CODE)
    print(*others, *phrases, *participles, sep="\n")
    print(f"function docstrings that begin with an imperative verb: {share:.1%}")
    print(f"phrases without a noun: {len(phrases)}")
    print(f"functions named by a bare participle: {len(participles)}")


if __name__ == "__main__":
    main()
