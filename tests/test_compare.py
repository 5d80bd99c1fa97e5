import csv

import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import binomtest

from planner_jax.cli.main import main
from planner_jax.runs.summary import wilson_interval
from planner_jax.sweep.compare import describe, difference_of, differing, other_cases, read_run
from tests.sweeps import write_rows

FAILED = {0: "", 1: "speed", 2: "landing"}
ONE = [0] * 40 + [0] * 9 + [1] * 3 + [1] * 8
OTHER = [0] * 40 + [2] * 9 + [0] * 3 + [1] * 8


def write_run(folder, outcomes, *, kind="sweep hit", **settings):
    outcomes, num = np.array(outcomes), len(outcomes)
    rows = pa.table(
        {
            "index": pa.array(np.arange(num)),
            "success": pa.array(outcomes == 0),
            "failed_limit": pa.array([FAILED[each] for each in outcomes]),
            "cost": pa.array(np.arange(num, dtype=np.float32)),
            "iterations": pa.array(np.full(num, 7, np.int32)),
        }
    )
    own = {"planner": "exact", "suite": "court", "seed": 3, "num": num, "serves": None}
    own |= {"start": [0.0, 0.0, 1.5], "delay": 0.0, "limit_scale": 1.0}
    write_rows(folder, rows, kind=kind, parameters={**own, **settings})
    return str(folder)


@pytest.fixture
def pair(tmp_path):
    return (write_run(tmp_path / "one", ONE), write_run(tmp_path / "other", OTHER, planner="bat"))


def test_of_the_same_cases_only_those_count_that_one_run_alone_solves(pair):
    first, other = map(read_run, pair)
    found = difference_of(first, other)
    assert (found.first_only, found.this_only) == (9, 3)
    assert found.mcnemar_p == pytest.approx(binomtest(3, 12).pvalue)
    assert found.difference == pytest.approx(-6.0 / 60.0)
    low, high = binomtest(3, 12).proportion_ci(0.95, "exact")
    np.testing.assert_allclose(found[1:3], [(2 * x - 1) * 12 / 60 for x in (low, high)])
    assert found.difference_low < found.difference < found.difference_high


def test_runs_that_end_alike_differ_by_nothing(pair):
    first = read_run(pair[0])
    found = difference_of(first, first)
    assert (found.first_only, found.this_only, found.mcnemar_p) == (0, 0, 1.0)
    low, high = found[1:3]
    assert low == -high and (1.0 - high) ** 60 == pytest.approx(0.025)
    assert "by all or none" in describe([first, first])[-1]


def test_other_limits_make_other_cases_which_are_compared_as_independent(tmp_path):
    first = read_run(write_run(tmp_path / "a", ONE))
    other = read_run(write_run(tmp_path / "b", OTHER[:50], limit_scale=0.5, num=50))
    assert other_cases(first, other) == ["num 60 and 50", "limit_scale 1.0 and 0.5"]
    found = difference_of(first, other)
    assert found.mcnemar_p is None and found.first_only is None
    (l1, u1), (l2, u2) = wilson_interval(49, 60), wilson_interval(41, 50)
    p1, p2 = 49 / 60, 41 / 50
    assert found.difference_low == pytest.approx(p2 - p1 - np.hypot(p2 - l2, u1 - p1))
    assert found.difference_high == pytest.approx(p2 - p1 + np.hypot(u2 - p2, p1 - l1))
    text = "\n".join(describe([first, other]))
    assert "the cases differ in num 60 and 50, limit_scale 1.0 and 0.5." in text
    assert "McNemar" not in text and "only some runs solve" not in text


def test_the_command_shows_rates_and_cases_and_writes_them(pair, tmp_path, capsys):
    out = tmp_path / "compared.csv"
    assert main(["compare", *pair, "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "of the same cases [1] alone solves 9 and [2] alone 3, p = 0.146" in text
    assert "settings that differ: planner exact and bat" in text
    assert "Cases that only some runs solve: 12." in text and "and 2 more; --all" in text
    rows = {row[0]: row[1:] for row in csv.reader(out.read_text().splitlines())}
    assert rows["planner"] == ["exact", "bat"] and rows["successes"] == ["49", "43"]
    assert rows["case 40"] == ["success", "landing"] and rows["case 51"] == ["speed", "success"]
    assert sum(name.startswith("case ") for name in rows) == 12
    assert main(["compare", *pair, "--all"]) == 0
    assert "--all" not in capsys.readouterr().out


def test_cases_of_three_runs_are_told_by_all_of_them(pair, tmp_path):
    third = write_run(tmp_path / "third", [0] * 60)
    runs = [read_run(path) for path in (*pair, third)]
    apart = differing(runs)
    assert len(apart) == 20
    assert apart[0] == (40, ["", "landing", ""]) and apart[-1] == (59, ["speed", "speed", ""])


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"suite": "S.1"}, "runs of one suite, got court in "),
        ({"seed": 4}, "runs of one seed, got 3 in "),
        ({"kind": "sweep catch"}, "runs of one task, got sweep hit in "),
    ],
)
def test_runs_of_other_cases_altogether_are_refused_by_name(tmp_path, capsys, changed, told):
    first = write_run(tmp_path / "first", ONE)
    other = write_run(tmp_path / "other", OTHER, **changed)
    assert main(["compare", first, other]) == 2
    line = capsys.readouterr().err
    assert told in line and first in line and other in line and line.count("\n") == 1


def test_one_run_alone_and_a_file_that_is_there_are_refused(pair, tmp_path, capsys):
    assert main(["compare", pair[0]]) == 2
    assert "RUN must be the folders of two runs or more, got 1" in capsys.readouterr().err
    taken = tmp_path / "taken.csv"
    taken.write_text("")
    for out, rule in ((taken, "a new file"), (tmp_path / "no.txt", "end in .csv")):
        assert main(["compare", *pair, "--out", str(out)]) == 2
        assert rule in capsys.readouterr().err
