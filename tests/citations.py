"""Make docs/equations.md, which lists the equations of four papers and the files with each.

    python -m tests.citations            # fails if the page differs from the code
    python -m tests.citations --write    # writes the page

A citation is `[KEY, eq. N]`. In a file that cites a single paper, `eq. N` alone is a citation of
this paper, and so is `Algorithm N`. `tests/data/equations.toml` lists all equations of the papers.
It states what each equation computes, how the code differs from the printed equation and, if
several files cite the equation, which file implements it.
"""

import ast
import functools
import itertools
import re
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

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
PARTS = re.compile(r"\b(Algorithm \d|Fig\. \d|Tables? [IVX]+(?: and [IVX]+)?)")
STATUSES = ("as printed", "corrected", "different", "not used", "text not available")
IN_CODE = STATUSES[:3]  # statuses of equations that the code computes
HEAD = """# Where each equation is

This page lists all equations of four papers of [references](references.md). The column "computes"
says in a few words what an equation computes. The column "implemented in" has the file that
computes it, and the functions or classes there whose docstrings cite it. "Tested in" has the two
modules of `tests/` that name these functions most often, or the reason why there is none. The files
in the last column use, check or discuss the equation. The column "as printed?" has one of these
words:

- as printed: the code computes the printed equation, perhaps in other variables.
- corrected: the printed equation has a misprint, which the code does not have.
- different: the code computes something else for the same purpose.
- not used: the code does not need the equation, or lacks it.
- text not available: the text of the paper that this project has lacks the equation, for example
  Section III of Yu2023catch.

JAX computes gradients by automatic differentiation. The last table has algorithms, tables and
figures. `python -m benchmarks.paper_figures` draws some figures from runs of this library;
[the page of results](results.md#published-numbers) lists the numbers of the tables.

`python -m tests.citations --write` generates this page from the citations in the code and the words
in `tests/data/equations.toml`.
"""
AUTODIFF = "automatic differentiation"


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


def parts_of(text: str) -> Iterator[tuple[int, str, str]]:
    """Yield, for each algorithm, table or figure that a text cites, its position, paper and name.

    A table is cited as `[KEY, Table N]`, `Table N of [KEY]` or, in code, `"KEY", "Table N"`, and a
    figure in the same manner.
    """
    keyed = list(KEYED.finditer(text))
    papers = {match[1] for match in keyed}
    for match in PARTS.finditer(text):
        found = [key[1] for key in keyed if key.start() < match.start() < key.end()]
        found += re.findall(rf"^ of \[({'|'.join(PAPERS)})", text[match.end() :])
        found += re.findall(rf'"({"|".join(PAPERS)})",\s+"$', text[: match.start()][-40:])
        if match[1].startswith("Algorithm") and len(papers) == 1:
            found += papers
        kind, *names = match[1].replace(" and", "").split(" ")
        for paper, name in itertools.product(found[:1], names):
            yield match.start(), paper, f"{kind.removesuffix('s')} {name}"


def find_places() -> dict[tuple[str, str], dict[str, set[str]]]:
    """Return, by (paper, equation), the files that cite it, with their functions and classes."""
    places: dict[tuple[str, str], dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for file in tracked_files("planner_jax/*.py", "sims/*.py", "policies/*.py", "benchmarks/*.py"):
        path = ROOT / file
        if path.is_file() and not path.is_symlink():
            text = path.read_text()
            tree = ast.parse(text)
            cited = [] if file.startswith("benchmarks") else equations_of(text)
            for position, paper, number in (*cited, *parts_of(text)):
                name = name_at(tree, text.count("\n", 0, position) + 1)
                places[paper, number][file].add(name)
    return places


def read_words() -> tuple[dict[str, list[str]], dict[tuple[str, str], dict[str, str]]]:
    """Return the numbers of all equations by paper, and the entries of equations and parts."""
    words = tomllib.loads(WORDS.read_text())
    numbers = {paper: expand(text) for paper, text in words.pop("all").items()}
    parts = {tuple(name.split(", ")): row for name, row in words.pop("parts").items()}
    rows = {(paper, number): row for paper in words for number, row in words[paper].items()}
    return numbers, rows | parts


def make_page(numbers: dict[str, list[str]], words: dict[tuple[str, str], dict[str, str]]) -> str:
    """Return the text of docs/equations.md, with a table for each paper and one for other parts.

    Args:
        numbers: the numbers of all equations of each paper.
        words: the entry of each equation, algorithm, table and figure, by (paper, number or name).

    Raises:
        LookupError: an entry is missing, or contradicts the citations in the code.
    """
    listed = {(paper, number) for paper in numbers for number in numbers[paper]}
    parts = {key for key in words if " " in key[1]}
    if wrong := listed ^ (words.keys() - parts):
        raise LookupError(f"{WORDS.name} must have one entry for each equation: {sorted(wrong)}")
    places: dict[tuple[str, str], dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for (paper, number), files in find_places().items():
        keys = [key for key in words if key[0] == paper and key[1].rstrip("abcdefg") == number]
        keys = [(paper, number)] if (paper, number) in words else keys
        if not keys:
            raise LookupError(f"{paper} has no equation {number}, cited in {sorted(files)}")
        for key, (file, names) in itertools.product(keys, files.items()):
            places[key][file] |= names
    lines = [HEAD]
    head = "computes | as printed? | implemented in | tested in | also cited in |\n"
    head += "|---|---|---|---|---|---|"
    for paper, title in PAPERS.items():
        lines.append(f"## {title}, {paper}\n")
        lines.append(f"| equation | {head}")
        keys = ((paper, number) for number in numbers[paper])
        lines += [f"| {key[1]} {_write_row(key, words[key], places[key])}" for key in keys]
        lines.append("")
    lines += ["## Algorithms, tables and figures\n", f"| paper and part | {head}"]
    for key in words:
        if key in parts:
            lines.append(f"| {', '.join(key)} {_write_row(key, words[key], places[key])}")
    return "\n".join([*lines, ""])


def _write_row(key: tuple[str, str], row: dict[str, str], files: dict[str, set[str]]) -> str:
    status, place = row.get("status", STATUSES[0]), row.get("place")
    if status not in STATUSES or (status in ("corrected", "different")) > ("note" in row):
        raise LookupError(f"{WORDS.name} needs the `status` of {key}, and a `note` on changes")
    if "by" in row and row["by"] != "autodiff":
        raise LookupError(f"{key} has by = {row['by']!r}, known is 'autodiff'")
    is_table = key[1].startswith(("Table", "Fig."))
    is_code = status in IN_CODE and "by" not in row and not is_table
    if place is None and len(files) == 1 and is_code:
        place = next(iter(files))
    if is_code != (place in files) and not (status == STATUSES[-1] and place in files):
        raise LookupError(f"{key} is {status}; it needs a `place` of {sorted(files)}, has {place}")
    cited = {file: _write_place(file, files[file]) for file in sorted(files)}
    others = "; ".join(cited[file] for file in cited if file != place)
    first = AUTODIFF if "by" in row else cited[place] if place else ""
    printed = f"{status}: {row['note']}" if "note" in row else status
    printed = row.get("note", "") if is_table else printed
    tests = find_tests(place, files[place]) if is_code and place else []
    if is_code and bool(tests) == ("untested" in row):
        raise LookupError(f"{key} needs `untested`, a reason, if and only if no test names it")
    tested = row.get("untested", ", ".join(f"`{name}`" for name in tests))
    return f"| {row['computes']} | {printed} | {first} | {tested} | {others} |"


@functools.cache
def _count_names() -> dict[str, Counter[str]]:
    """Return how often each test module names words and, with dots, modules."""
    texts = {
        Path(file).stem: (ROOT / file).read_text() for file in tracked_files("tests/test_*.py")
    }
    return {
        stem: Counter(re.findall(r"\w+", text)) + Counter(re.findall(r"\w+(?:\.\w+)+", text))
        for stem, text in texts.items()
    }


def find_tests(file: str, names: set[str]) -> list[str]:
    """Return the two test modules that name functions or classes of a file most often.

    Test modules that import the file are preferred, and suffice if no test has the names.
    """
    module = ".".join(Path(file).with_suffix("").parts)
    module = module if module.startswith("planner_jax") else f"planner_jax.{module}"
    package, _, stem = module.rpartition(".")
    words = {word for name in names for word in name.split(".") if word and word[0] != "_"}
    # All tasks have a function of this name.
    words = {f"pj.{module.split('.')[2]}.case" if word == "case" else word for word in words}
    tests = _count_names()
    importing = {name for name, each in tests.items() if each[module] or each[package] * each[stem]}
    counts = {name: sum(each[word] for word in words) for name, each in tests.items()}
    naming = {name for name, count in counts.items() if count}
    found = (importing & naming) or naming or importing
    return sorted(found, key=lambda name: (-counts[name], name))[:2]


def _write_place(file: str, names: set[str]) -> str:
    listed = ", ".join(f"`{name}`" for name in sorted(names) if name)
    return f"[{file}](../{file})" + (f": {listed}" if listed else "")


def main() -> int:
    if "--write" in sys.argv:
        PAGE.write_text(make_page(*read_words()))
    stale = not PAGE.exists() or PAGE.read_text() != make_page(*read_words())
    if stale:
        print("docs/equations.md is stale: run python -m tests.citations --write")
    return int(stale)


if __name__ == "__main__":
    sys.exit(main())
