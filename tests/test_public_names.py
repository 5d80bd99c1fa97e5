"""The names a user imports from the top of the package, and from a task."""

import dataclasses
import inspect
import re

import numpy as np
import pytest
from jax import Array

import planner_jax as pj
from planner_jax.core.tasks import all_tasks

TASKS = [getattr(pj, name) for name in all_tasks()]


def test_every_public_name_can_be_imported_and_has_a_docstring():
    names = [(module, name) for module in (pj, *TASKS) for name in module.__all__]
    assert len(names) > 60
    assert [name for module, name in names if not getattr(module, name).__doc__] == []


@pytest.mark.parametrize("task", all_tasks())
def test_a_task_has_its_four_functions_at_the_top(task):
    for word in ("case", "draw", "planner", "judge"):
        assert getattr(pj.task_named(task), word) is getattr(getattr(pj, task), word)


@pytest.mark.parametrize("task", all_tasks())
def test_a_planner_by_name_says_which_names_there_are(task):
    make = getattr(pj, task).planner
    of_files = all_tasks()[task].from_file
    assert all(f"`{name}:FILE`" in make.__doc__ for name in of_files)
    for name in all_tasks()[task].planners.keys() - of_files.keys():
        made = make(name)
        made = made.inner  # behind a decision
        assert f"`{name}`" in make.__doc__
        assert made.title in make.__doc__
    default = next(iter(all_tasks()[task].planners))
    with pytest.raises(ValueError, match=f"planner must be one of {default}"):
        make("nobody")
    with pytest.raises(TypeError, match="no_field"):
        make(default, no_field=1)


@pytest.mark.parametrize("task", all_tasks())
def test_a_draw_says_which_suites_there_are(task):
    suites = all_tasks()[task].suites
    assert all(text[0].isupper() and text.endswith(".") for text in suites.values())
    with pytest.raises(ValueError, match=f"suite must be one of {next(iter(suites))}, .*'nowhere'"):
        getattr(pj, task).draw(1, "nowhere")


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="attribute plans"):
        pj.plans  # noqa: B018


def _described(kind: type) -> dict[str, str]:
    """Return the texts of the fields in the section "Attributes" of a class's docstring."""
    section = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")[2]
    return dict(re.findall(r"^ {4}(\w+): (.+)$", section, re.MULTILINE))


def _public_dataclasses() -> list[type]:
    packages = (pj, pj.ball, pj.live, pj.perception, *TASKS)
    values = [getattr(package, name) for package in packages for name in package.__all__]
    return [
        value for value in values if isinstance(value, type) and dataclasses.is_dataclass(value)
    ]


@pytest.mark.parametrize("kind", _public_dataclasses(), ids=lambda kind: kind.__qualname__)
def test_every_public_field_is_described_with_the_shape_of_an_array(kind):
    texts = {}
    for base in reversed(kind.__mro__):
        own = _described(base) if "__doc__" in vars(base) else {}
        assert own.keys() <= vars(base).get("__annotations__", {}).keys(), base
        texts |= own
    fields = {field.name: field for field in dataclasses.fields(kind) if field.name[0] != "_"}
    assert fields.keys() <= texts.keys()
    arrays = [name for name, field in fields.items() if field.type in (Array, np.ndarray)]
    assert [
        name for name in arrays if not re.match(r"\([^)]*\)|\[|bool|probability", texts[name])
    ] == []
