"""The table of docs/equations.md: which function cites which equation of the four papers.

    python -m tests.citations            # fails if the table is stale
    python -m tests.citations --write    # writes the table

A citation is `[KEY, eq. N]`. A bare `eq. N` counts for the one paper that its file cites.
"""

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator

from tests.tracked import ROOT, tracked_files

PAGE = ROOT / "docs" / "equations.md"
PAPERS = {
    "Yu2023catch": "Catch Planner",
    "Yu2023bat": "Bat Planner",
    "Qu2022": "Moving Target Interception",
    "Natarajan2024": "Intercepting Projectiles",
}
KEYED = re.compile(rf"\[[^\[\]]*?({'|'.join(PAPERS)})([^\[\]]*)\]")
NUMBER = r"\d+[a-z]?"
EQUATIONS = re.compile(rf"\b[Ee]qs?\.?\s+({NUMBER}(?:\s*(?:,|-|and|to)\s*{NUMBER})*)")
HEAD = """# Where each equation is

The functions and classes that cite an equation of the four papers of [references](references.md).
This page is generated from the citations in the code by `python -m tests.citations --write`.
"""


def expand(text: str) -> list[str]:
    """Return the numbers of a list of equations such as "5 to 7" or "18f and 18g"."""
    numbers: list[str] = []
    joined = ""
    for word in re.findall(rf"{NUMBER}|-|to|and|,", text):
        if not word[0].isdigit():
            joined = word
            continue
        if joined in ("-", "to") and numbers[-1].isdigit() and word.isdigit():
            numbers += map(str, range(int(numbers[-1]) + 1, int(word)))
        numbers.append(word)
    return numbers


def equations_of(text: str) -> Iterator[tuple[int, str, str]]:
    """Yield position, paper and number of each equation that a text cites."""
    keyed = list(KEYED.finditer(text))
    papers = {match[1] for match in keyed}
    for match in EQUATIONS.finditer(text):
        inside = [key[1] for key in keyed if key.start() < match.start() < key.end()]
        paper = inside[0] if inside else next(iter(papers)) if len(papers) == 1 else None
        if paper is not None:
            for number in expand(match[1]):
                yield match.start(), paper, number


def name_at(tree: ast.Module, line: int) -> str:
    """Return the name of the function or class around a line, or "" at the module's level."""
    names = ""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            if node.lineno <= line <= (node.end_lineno or 0):
                names = f"{names}.{node.name}" if names else node.name
    return names


def table() -> str:
    """Return the page with a table for each paper."""
    places: dict[tuple[str, str], dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for file in tracked_files("planner_jax/*.py", "sims/*.py", "policies/*.py"):
        path = ROOT / file
        if path.is_file() and not path.is_symlink():
            text = path.read_text()
            tree = ast.parse(text)
            for position, paper, number in equations_of(text):
                name = name_at(tree, text.count("\n", 0, position) + 1)
                places[paper, number][file].add(name)
    lines = [HEAD]
    for paper, title in PAPERS.items():
        lines.append(f"## {title}, {paper}\n\n| equation | where |\n|---|---|")
        rows = sorted(
            (key for key in places if key[0] == paper),
            key=lambda key: (int(re.sub(r"\D", "", key[1])), key[1]),
        )
        for key in rows:
            where = []
            for file, names in sorted(places[key].items()):
                listed = ", ".join(f"`{name}`" for name in sorted(names) if name)
                where.append(f"[{file}](../{file})" + (f": {listed}" if listed else ""))
            lines.append(f"| {key[1]} | {'; '.join(where)} |")
        lines.append("")
    return "\n".join(lines)


def main() -> int:
    """Write the page, or compare it with the code."""
    if "--write" in sys.argv:
        PAGE.write_text(table())
    stale = not PAGE.exists() or PAGE.read_text() != table()
    if stale:
        print("docs/equations.md is stale: run python -m tests.citations --write")
    return int(stale)


if __name__ == "__main__":
    sys.exit(main())
