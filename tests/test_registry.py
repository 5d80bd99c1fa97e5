"""Names of tasks, planners and suites, of the library and of other packages."""

import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core import errors, missing_extra
from planner_jax.core.errors import UnknownName
from planner_jax.core.tasks import all_tasks, task_named
from planner_jax.runs.settings import WorkersFailed
from planner_jax.task.catch.suites import draw as draw_catches

METADATA = "Metadata-Version: 2.1\nName: planner-jax-others\nVersion: 1.0\n"
MODULE = '''
from planner_jax.core.registry import Task
from planner_jax.baselines.hit.juggle import JuggleHit
from planner_jax.task.catch.suites import draw

TASK = Task(
    name="meet",
    summary="two quadrotors meet",
    home="planner_jax_others",
    planners={"first": "planner_jax.baselines.hit.juggle:JuggleHit"},
    suites={"still": "Nobody moves."},
)
THEIRS = Task("hit", "another hit", "planner_jax_others", {}, {})
MISNAMED = Task("other", "of another name", "planner_jax_others", {}, {})
NOT_A_TASK = 3


def case():
    """A case."""


def gusts(num, seed, first):
    return draw(num, "hard", seed, first=first)


def low(height=0.8):
    return JuggleHit(height=height)
'''


@pytest.fixture
def others(tmp_path, monkeypatch):
    (tmp_path / "planner_jax_others.py").write_text(MODULE)
    folder = tmp_path / "planner_jax_others-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(METADATA)
    monkeypatch.syspath_prepend(tmp_path)

    def install(**groups):
        text = ""
        for group, entries in groups.items():
            text += f"[planner_jax.{group}]\n"
            text += "".join(f"{name} = {place}\n" for name, place in entries.items())
        (folder / "entry_points.txt").write_text(text)
        all_tasks.cache_clear()

    yield install
    all_tasks.cache_clear()
    sys.modules.pop("planner_jax_others", None)


def assert_one_line(call, rule, kind=UnknownName):
    with pytest.raises(kind, match=rule) as caught:
        call()
    assert "\n" not in str(caught.value)


TASKS = ["hit", "rally", "catch", "team", "intercept", "group", "block", "reach"]


@pytest.mark.parametrize("name", TASKS)
def test_every_planner_of_a_task_can_be_made_and_the_first_is_the_default(name):
    task = task_named(name)
    for planner in task.all_planners().keys() - task.from_file.keys():
        assert task.make_planner(planner, {}).attempts
    first = next(iter(task.planners))
    assert task.planner() == task.planner(first)
    assert task.planner().inner == task.make_planner(first, {})


def test_a_task_of_another_package_comes_after_the_librarys_own(others):
    others(tasks={"meet": "planner_jax_others:TASK"})
    assert list(all_tasks()) == [*TASKS, "meet"]
    task = pj.task_named("meet")
    assert task.summary == "two quadrotors meet"
    assert task.case.__doc__ == "A case."
    assert type(task.make_planner("first", {"nodes": 8})).__name__ == "JuggleHit"


@pytest.mark.parametrize(
    ("place", "problem"),
    [
        ("planner_jax_others:NOTHING", "left out: AttributeError: .*NOTHING"),
        ("planner_jax_nowhere:TASK", "left out: ModuleNotFoundError: .*planner_jax_nowhere"),
        ("planner_jax_others:NOT_A_TASK", "left out: it is not a Task of that name, got 3"),
        ("planner_jax_others:MISNAMED", "left out: it is not a Task of that name, got Task"),
    ],
)
def test_a_broken_task_is_left_out_with_a_warning(others, place, problem):
    others(tasks={"broken": place, "meet": "planner_jax_others:TASK"})
    with pytest.warns(UserWarning, match=f"^task 'broken' of {place} is {problem}") as warned:
        assert list(all_tasks()) == [*TASKS, "meet"]
    assert len(warned) == 1 and "\n" not in str(warned[0].message)
    assert pj.task_named("hit").draw(1).batch_shape == (1,)


def test_a_task_and_a_planner_with_a_used_name_are_left_out(others):
    theirs, low = (f"planner_jax_others:{name}" for name in ("THEIRS", "low"))
    others(tasks={"hit": theirs}, planners={"hit.exact": low})
    problem = "^task 'hit' .* left out: the name is taken by planner_jax.task.hit$"
    with pytest.warns(UserWarning, match=problem):
        assert all_tasks()["hit"].home == "planner_jax.task.hit"
    with pytest.warns(UserWarning, match="planners 'hit.exact' .* left out, as the name is taken"):
        assert pj.hit.planner("exact").title == "HitProblem"


def test_a_planner_of_another_package_is_made_by_its_name(others):
    others(planners={"hit.mine": "planner_jax_others:low", "catch.mine": "planner_jax_others:low"})
    assert list(pj.task_named("hit").all_planners())[-1] == "mine"
    assert pj.hit.planner("mine").height == 0.8
    assert pj.hit.planner("mine", height=1.1) == pj.hit.planner("juggle", height=1.1)
    assert pj.catch.planner("mine", decide="greedy").planner.height == 0.8
    assert_one_line(lambda: pj.hit.planner("yours"), "one of exact, .*, juggle, mine, got 'yours'$")
    plans = pj.plan(pj.hit.planner("mine"), pj.hit.draw(2))
    assert pj.hit.judge(pj.hit.draw(2), plans).success.shape == (2,)


def test_a_planner_that_cannot_be_loaded_raises_only_when_it_is_requested(others):
    others(planners={"hit.mine": "planner_jax_nowhere:low"})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert pj.hit.planner("exact").title == "HitProblem"
    rule = "^hit.mine of planner_jax_nowhere:low must be one that can be loaded, got Module"
    assert_one_line(lambda: pj.hit.planner("mine"), rule)


def test_a_suite_of_another_package_is_drawn_by_its_name(others):
    others(suites={"catch.gusts": "planner_jax_others:gusts"})
    assert list(pj.task_named("catch").all_suites())[-1] == "gusts"
    found, expected = pj.catch.draw(3, "gusts", 5, first=2), draw_catches(3, "hard", 5, first=2)
    np.testing.assert_array_equal(found.targets.ball.vel, expected.targets.ball.vel)
    assert_one_line(lambda: pj.hit.draw(3, "gusts"), "suite must be one of court")


def test_names_are_listed_without_jax():
    code = (
        "import sys; from planner_jax.core.tasks import task_named; task = task_named('hit'); "
        "assert 'exact' in task.all_planners() and 'court' in task.all_suites(); "
        "sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_missing_extra_is_installed_from_the_checkout_or_the_index(monkeypatch, tmp_path):
    assert missing_extra.install_line("view") == "pip install -c constraints.txt -e '.[view]'"
    monkeypatch.setattr(
        missing_extra, "__file__", str(tmp_path / "planner_jax" / "core" / "missing_extra.py")
    )
    assert missing_extra.install_line("view") == "pip install 'planner-jax[view]'"


ERRORS = [
    errors.PlannerJaxError("one line"),
    errors.ArgumentError("limits.speed", "> 0", np.array([1.0, -1.0]), 1, other="0", more=2),
    errors.ArgumentError("out", "a new folder", verb="name", shown="'x' (exists)"),
    errors.ArgumentTypeError("num", "a whole number", "x"),
    errors.CaseError("speed", "finite", np.float32(np.nan), (2, 0)),
    errors.UnknownName("task", "one of hit, catch", "hot"),
    missing_extra.MissingExtra("paper", "numba", "baselines"),
    errors.NoRecovery("no recovery trajectory keeps the limits"),
    errors.NotOffered("DirectBlock cannot plan again"),
    WorkersFailed("workers must be able to start the run"),
]


def test_errors_of_every_class_are_listed():
    modules = *vars(errors).values(), *vars(missing_extra).values()
    classes = {value for value in modules if isinstance(value, type)}
    defined = {each for each in classes if issubclass(each, errors.PlannerJaxError)}
    assert defined <= {type(error) for error in ERRORS}


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_is_the_same_in_another_process(error):
    """A worker process sends its exception to the process that started it."""
    copied = pickle.loads(pickle.dumps(error))
    assert type(copied) is type(error) and str(copied) == str(error)
    assert vars(copied).keys() == vars(error).keys()
    if isinstance(error, (errors.ArgumentError, missing_extra.MissingExtra)):
        name = {getattr(error, "feature", error.name): "--other"}
        assert str(copied.with_names(name)) == str(error.with_names(name))
