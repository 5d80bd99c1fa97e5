"""Published numbers on the pages and in reports, against the one tuple that holds them."""

import re

import numpy as np
import pytest

from planner_jax.baselines.protocols import BY_ROW, PUBLISHED
from planner_jax.benchmarks.hit_published import agreement, kappa, rates_by_scenario
from planner_jax.task.hit import court
from tests.citations import read_words
from tests.tracked import ROOT, tracked_files

RESULTS = ROOT / "docs" / "results.md"
PAGES = [ROOT / name for name in tracked_files("README.md", "docs/*.md", "docs/lab/*.md")]
SOURCE = re.compile(r"\[[A-Z][a-z]+\d{4}[a-z]*, [^\[\]]+\]")
NOTHING = {"-", "", "figure only"}


def is_of_court(number):
    return number.row.split(" ")[-1] in court.SCENARIOS


def tables_of(text):
    """Yield each table of a page: its header cells, and the cells of its rows."""
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        head, _, *rows = ([cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
                          for line in block.splitlines())  # fmt: skip
        yield head, rows


def published_cells(page):
    """Yield the cells of a page's columns of published numbers, each with its source.

    A source such as [Yu2023bat, Table I] stands in the cell, elsewhere in the row, or in the head
    of the table's first column.
    """
    for head, rows in tables_of(page.read_text()):
        for index, name in enumerate(head):
            if name == "published" or name.endswith(", published"):
                for row in rows:
                    cell = row[index]
                    sources = SOURCE.findall(cell) or SOURCE.findall(" ".join([*row, head[0]]))
                    if cell not in NOTHING:
                        yield f"{SOURCE.sub('', cell).strip()} {' '.join(sources)}".strip()


def row_of(number):
    """Return the row of a number in the list of published numbers of the page of results."""
    source = f"[{number.paper}, {number.table}]"
    num = f"{number.num:,}" if number.num else "-"
    cells = (source, number.row, number, number.what_counts, num, number.machine)
    return [*map(str, cells), number.unknown or "-"]


def test_the_page_of_results_lists_every_published_number_and_no_other():
    text = RESULTS.read_text().split("\n## Published numbers\n")[1]
    (_, rows), *others = tables_of(text)
    assert not others
    assert rows == [row_of(number) for number in PUBLISHED if not is_of_court(number)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_published_number_of_a_page_is_in_the_tuple_with_its_source(page):
    known = {f"{each} [{each.paper}, {each.table}]" for each in PUBLISHED}
    assert not set(published_cells(page)) - known


def test_the_pages_show_published_numbers_of_every_task():
    shown = " ".join(cell for page in PAGES for cell in published_cells(page))
    assert {"Yu2023bat", "Yu2023catch", "Qu2022", "Natarajan2024"} <= {*re.findall(r"\w+", shown)}


def test_every_number_has_one_row_a_known_table_and_a_protocol():
    assert len(BY_ROW) == len(PUBLISHED) == sum(map(is_of_court, PUBLISHED)) + 87
    _, words = read_words()
    for number in PUBLISHED:
        assert number.what_counts and number.value >= 0.0
        if number.table.startswith("Table"):
            assert (number.paper, number.table) in words


def test_numbers_are_printed_with_their_sign_spread_and_unit():
    printed = {
        ("Yu2023bat", "Section VI-C", "module"): "< 20 ms",
        ("Yu2023catch", "Table I", "OTR throws"): "0.092",
        ("Natarajan2024", "Table I", "query theirs"): "0.109 ± 0.033 ms",
        ("Natarajan2024", "Table II", "RRT-Connect joint 2"): "130.2 ± 49 N m",
    }
    assert {key: str(BY_ROW[key]) for key in printed} == printed


def test_outcomes_are_compared_by_scenario():
    scenario = np.array([0, 0, 3, 3])
    ours, theirs = np.array([[1, 1, 1, 0], [1, 0, 0, 0]], bool)
    rates = rates_by_scenario(ours, scenario)
    assert rates.shape == (36,) and rates[0] == 1.0 and rates[3] == 0.5 and np.isnan(rates[1])
    found = agreement(ours, theirs, scenario)
    assert found["same"] == 0.5 and found["correlation"] == pytest.approx(1.0)
    assert np.isnan(agreement(ours, theirs, np.zeros(4, int))["correlation"])
    nobody = np.zeros(4, bool)
    assert agreement(nobody, nobody, scenario)["kappa"] == 0.0


def test_kappa_is_one_for_equal_outcomes_and_zero_for_independent_ones():
    one, other = np.array([True, True, False, False]), np.array([True, False, True, False])
    assert kappa(one, one) == 1.0 and kappa(one, other) == 0.0 and kappa(one, ~one) == -1.0
    # Both succeed on 2 of 5 cases, and on 1 case together: 3 of 5 agree, 13 of 25 by chance.
    few = np.array([[1, 1, 0, 0, 0], [1, 0, 1, 0, 0]], bool)
    assert kappa(*few) == pytest.approx((3 / 5 - 13 / 25) / (1 - 13 / 25))
