"""Commands run, or are refused in one line, with every task, suite, planner and option."""

import dataclasses
import itertools

import numpy as np
import pytest

from planner_jax.core.registry import Task
from planner_jax.core.tasks import all_tasks
from planner_jax.runs.columns import RefereedBatch, leaf_columns, rows_of
from planner_jax.runs.source import Chunk
from tests.combinations import REFUSED, RUNS, all_combinations, cross, run_all
from tests.faults.commands import start, wait_for

TABLE = all_combinations()


def faults_of(combinations):
    return [fault for *_, fault in run_all(combinations) if fault]


@pytest.mark.slow
@pytest.mark.parametrize("group", TABLE)
def test_a_combination_runs_or_is_refused_in_one_line(group, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert faults_of(TABLE[group]) == []


def test_an_option_that_a_task_lacks_is_refused_by_the_same_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused = [each for each in itertools.chain(*TABLE.values()) if each.must == REFUSED]
    assert len(refused) > 100
    crossed = (each for each in refused if each.words[0] in ("sweep", "fly"))
    few = {(*each.words[:2], each.line.split()[2]): each for each in crossed}  # one an option
    assert faults_of(few.values()) == []


def test_a_plan_without_a_search_is_made_and_judged(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (row,) = [each for each in TABLE["plan hit"] if each.words[-1] == "juggle"]
    quick = row._replace(words=(*row.words, "--recovery", "none"), must=RUNS)
    assert faults_of([quick]) == []


def test_a_new_task_or_suite_is_in_the_table(monkeypatch):
    planners = {"first": "planner_jax.baselines.hit.juggle:JuggleHit"}
    new = Task("meet", "robots meet", "no_module", planners, {"still": "S.", "fast": "F."})
    monkeypatch.setattr("tests.combinations.all_tasks", lambda: {**all_tasks(), "meet": new})
    table = all_combinations.__wrapped__()
    assert set(table) - set(TABLE) == {"runs of sweep meet"} | {
        f"{command} meet" for command in ("sweep", "fly", "plan", "bench")
    }
    must = {str(each): each.must for each in cross("sweep", new)}
    assert must["sweep meet --num 1 --suite fast"] == RUNS
    assert must["sweep meet --num 1 --decide greedy"] == REFUSED


@pytest.mark.slow
@pytest.mark.parametrize("words", ["sweep group --suite forty --num 1", "sweep rally --wind 1 0 0"])
def test_a_process_ends_as_the_command_in_this_process(tmp_path, words):
    ended = wait_for(start(*words.split(), cwd=tmp_path))
    assert ended.code == (2 if "--wind" in words else 0), ended


def test_every_array_of_a_case_has_a_column_and_missing_parts_have_none():
    @dataclasses.dataclass
    class Outcome:
        status = iterations = np.zeros(2, np.int32)
        cost = violation = failed_time = failed_excess = np.zeros(2)
        success, failed_limit = np.ones(2, bool), np.array(["", ""])
        end: np.ndarray

    cases = {"robots": (np.arange(2.0), np.arange(6.0).reshape(2, 3)), "wind": None, "extras": ()}
    batch = RefereedBatch(Chunk(np.arange(2), cases), Outcome(np.ones(2)), Outcome(np.ones(2)))
    rows = rows_of(leaf_columns(batch), batch, "")
    own = [name for name in rows.column_names if "." in name]
    assert own == ["case.robots.0", "case.robots.1", "plan.end", "verdict.end"]
    assert rows["case.robots.1"].to_pylist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    assert rows["case.robots.0"].to_pylist() == [0.0, 1.0]
