"""Make docs/equations.md, which lists the files that implement or cite equations of four papers.

    python -m tests.citations            # fails if the page differs from the code
    python -m tests.citations --write    # writes the page

A citation is `[KEY, eq. N]`. In a file that cites a single paper, `eq. N` alone is a citation of
this paper. `tests/data/equations.toml` states what each equation computes and, if several files
cite the equation, which file implements it.
"""

import ast
import re
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator

from tests.tracked import ROOT, tracked_files

PAGE = ROOT / "docs" / "equations.md"
WORDS = ROOT / "tests" / "data" / "equations.toml"
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

This page lists the equations of four papers of [references](references.md) that the code cites. The
column "computes" says in a few words what an equation computes. The column "implemented in" has the
file that computes it, and the functions or classes there whose docstrings cite it. The files in the
last column use, check or discuss the equation.

`python -m tests.citations --write` generates this page from the citations in the code and the words
in `tests/data/equations.toml`.
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
    """Yield, for each equation that a text cites, its position, paper and equation number."""
    keyed = list(KEYED.finditer(text))
    papers = {match[1] for match in keyed}
    for match in EQUATIONS.finditer(text):
        inside = [key[1] for key in keyed if key.start() < match.start() < key.end()]
        paper = inside[0] if inside else next(iter(papers)) if len(papers) == 1 else None
        if paper is not None:
            for number in expand(match[1]):
                yield match.start(), paper, number


def name_at(tree: ast.Module, line: int) -> str:
    """Return the dotted name of the function or class that contains a line, or ""."""
    names = ""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            if node.lineno <= line <= (node.end_lineno or 0):
                names = f"{names}.{node.name}" if names else node.name
    return names


def find_places() -> dict[tuple[str, str], dict[str, set[str]]]:
    """Return, by (paper, equation), the files that cite it, with their functions and classes."""
    places: dict[tuple[str, str], dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for file in tracked_files("planner_jax/*.py", "sims/*.py", "policies/*.py"):
        path = ROOT / file
        if path.is_file() and not path.is_symlink():
            text = path.read_text()
            tree = ast.parse(text)
            for position, paper, number in equations_of(text):
                name = name_at(tree, text.count("\n", 0, position) + 1)
                places[paper, number][file].add(name)
    return places


def make_page() -> str:
    """Return the text of docs/equations.md, with one table for each paper.

    Raises:
        LookupError: `equations.toml` lacks a cited equation or its implementing file, or has an
            equation that the code does not cite.
    """
    places = find_places()
    words = {
        (paper, number): row
        for paper, rows in tomllib.loads(WORDS.read_text()).items()
        for number, row in rows.items()
    }
    if wrong := words.keys() ^ places.keys():
        raise LookupError(
            f"{WORDS.name} and the citations in the code differ: add or remove {sorted(wrong)}"
        )
    lines = [HEAD]
    for paper, title in PAPERS.items():
        lines.append(f"## {title}, {paper}\n")
        lines.append("| equation | computes | implemented in | also cited in |\n|---|---|---|---|")
        rows = sorted(
            (key for key in places if key[0] == paper),
            key=lambda key: (int(re.sub(r"\D", "", key[1])), key[1]),
        )
        for key in rows:
            files = sorted(places[key])
            first = words[key].get("place", files[0])
            if first not in files or len(files) > 1 and "place" not in words[key]:
                raise LookupError(f"{WORDS.name} needs the `place` of {key}, one of {files}")
            cited = {file: _write_place(file, places[key][file]) for file in files}
            others = "; ".join(cited[file] for file in files if file != first)
            lines.append(f"| {key[1]} | {words[key]['computes']} | {cited[first]} | {others} |")
        lines.append("")
    return "\n".join(lines)


def _write_place(file: str, names: set[str]) -> str:
    listed = ", ".join(f"`{name}`" for name in sorted(names) if name)
    return f"[{file}](../{file})" + (f": {listed}" if listed else "")


def main() -> int:
    if "--write" in sys.argv:
        PAGE.write_text(make_page())
    stale = not PAGE.exists() or PAGE.read_text() != make_page()
    if stale:
        print("docs/equations.md is stale: run python -m tests.citations --write")
    return int(stale)


if __name__ == "__main__":
    sys.exit(main())
