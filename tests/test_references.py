"""Citations by key, in code and pages, against the list in docs/references.md."""

import re
import subprocess
import sys
from collections import defaultdict

import pytest

from tests import citations
from tests.citations import make_page, read_words
from tests.tracked import ROOT, tracked_files

REFERENCES = ROOT / "docs" / "references.md"
KEY = r"[A-Z][A-Za-z]+(?:19|20)\d\d[a-z]*"


def cited_keys() -> dict[str, str]:
    """Return each key that a tracked text cites in brackets, with one file that cites it."""
    return {
        key: name
        for name in tracked_files("*.py", "*.pyi", "*.md", "*.ipynb", "*.cff")
        for cited in re.findall(rf"\[{KEY}[^\[\]]*\]", (ROOT / name).read_text())
        for key in re.findall(KEY, cited)
    }


def test_every_cited_key_has_an_entry_in_the_list_of_references() -> None:
    entries = set(re.findall(rf"^({KEY})$", REFERENCES.read_text(), re.MULTILINE))
    cited = cited_keys()
    assert {"Yu2023catch", "Yu2023bat", "Qu2022", "Natarajan2024"} <= cited.keys()
    assert not {key: name for key, name in cited.items() if key not in entries}


def test_no_text_cites_a_paper_by_a_private_number() -> None:
    found = subprocess.run(
        ["git", "grep", "-nE", r"[Pp]aper 0[0-9]{2}\b", "--", ":!tests/test_references.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert not found.stdout


def test_the_page_of_equations_follows_the_citations_in_the_code() -> None:
    stale = subprocess.run([sys.executable, "-m", "tests.citations"], cwd=ROOT, check=False)
    assert not stale.returncode, "run python -m tests.citations --write"


def test_every_figure_and_table_of_the_four_papers_has_an_entry() -> None:
    _, words = read_words()
    counts = dict.fromkeys(("Yu2023catch", "Yu2023bat", "Qu2022", "Natarajan2024"), (0, 0))
    for paper, part in (key for key in words if " " in key[1]):
        figures, tables = counts[paper]
        counts[paper] = figures + part.startswith("Fig."), tables + part.startswith("Table")
    assert [*counts.values()] == [(8, 3), (9, 1), (4, 3), (5, 2)]


def test_an_equation_in_code_names_its_test_or_the_reason_why_it_has_none(monkeypatch) -> None:
    numbers, words = read_words()
    key = "Natarajan2024", "4a"
    with pytest.raises(LookupError, match="'4a'.*needs `untested`"):
        make_page(numbers, words | {key: words[key] | {"untested": "no time"}})
    monkeypatch.setattr(citations, "find_tests", lambda *args: [])
    with pytest.raises(LookupError, match="needs `untested`"):
        make_page(numbers, words)


@pytest.mark.parametrize(
    "paper, last", [("Yu2023catch", 29), ("Yu2023bat", 24), ("Qu2022", 24), ("Natarajan2024", 8)]
)
def test_every_equation_of_the_four_papers_has_an_entry(paper: str, last: int) -> None:
    numbers, words = read_words()
    letters: dict[int, str] = defaultdict(str)
    for number in numbers[paper]:
        letters[int(number.rstrip("abcdefg"))] += number.lstrip("0123456789") or "-"
    assert list(letters) == [*range(1, last + 1)]
    assert {each for each in letters.values() if not "abcdefg".startswith(each)} <= {"-"}
    for number in numbers[paper]:
        fewer = {key: row for key, row in words.items() if key != (paper, number)}
        with pytest.raises(LookupError, match="must have one entry for each equation"):
            make_page(numbers, fewer)
