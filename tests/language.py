"""Check the project's language: first words of docstrings, forbidden phrases, function names.

    python -m tests.language [PATH ...]

The program prints, by default for the library, simulations, policies and benchmarks:

* the share of function docstrings that begin with an imperative verb, and the others;
* the phrases of `PHRASES` in code, pages and notebooks;
* the functions that are named by a bare participle.

Properties and tests are left out: a property's docstring says what it holds, a test's what is true.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.tracked import ROOT, tracked_files

CODE = ("planner_jax", "sims", "policies", "benchmarks")
PAGES = (*CODE, "docs", "notebooks", "tests", "README.md", "CONTRIBUTING.md")
# First words of descriptions that are no imperatives: articles, prepositions, "Returns", "Found".
NO_VERB = re.compile(
    r"(An?|The|This|That|Each|Every|All|Both|One|Two|By|For|From|If|In|Of|On|To|What|Whether|With)$"
    r"|.*[^s]s$|.*([^e]ed|[^r]ing|ion|ness|ity)$"
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
    """Return the share of docstrings that begin with a verb, and the places of the others."""
    num, others = 0, []
    for place, node in _functions(paths):
        text = ast.get_docstring(node)
        if text:
            num += 1
            if NO_VERB.match(text.split()[0]):
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
    given = tuple(sys.argv[1:])
    share, others = share_of_imperatives(given or CODE)
    phrases, participles = find_phrases(given or PAGES), find_participles(given or CODE)
    print(*others, *phrases, *participles, sep="\n")
    print(f"function docstrings that begin with an imperative verb: {share:.1%}")
    print(f"phrases without a noun: {len(phrases)}")
    print(f"functions named by a bare participle: {len(participles)}")


if __name__ == "__main__":
    main()
