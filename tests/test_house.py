"""Modules, classes and folders of tasks are no larger than CONTRIBUTING.md allows."""

import ast
from pathlib import Path

from layers import ROOT, list_modules

MOST_MODULES, MOST_LINES, MOST_OF_CLASS = 12, 450, 250  # in a task folder, module and class


def modules():
    """Return the modules of the library, simulations and policies, and their texts."""
    paths = (path.relative_to(ROOT) for path in list_modules() if path.suffix == ".py")
    return {path: (ROOT / path).read_text() for path in paths if path.parts[0] != "benchmarks"}


def lines_of(node):
    first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
    return node.end_lineno - first + 1


def offenders(sizes, most):
    return [f"{name}: {size}, at most {most}" for name, size in sizes.items() if size > most]


def test_a_folder_of_a_task_has_few_modules():
    task, sizes = Path("planner_jax", "task"), {}
    for path in modules():
        if path.is_relative_to(task) and path.name != "__init__.py":
            sizes[path.parent] = sizes.get(path.parent, 0) + 1
    assert len(sizes) > 8 and offenders(sizes, MOST_MODULES) == []


def test_a_module_is_short():
    sizes = {path: len(text.splitlines()) for path, text in modules().items()}
    assert len(sizes) > 300 and offenders(sizes, MOST_LINES) == []


def test_a_class_is_short():
    sizes = {
        f"{path}: {node.name}": lines_of(node)
        for path, text in modules().items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ClassDef)
    }
    assert len(sizes) > 300 and offenders(sizes, MOST_OF_CLASS) == []


def test_offenders_are_named_with_their_sizes():
    found = ast.parse("@wraps\n@other\nclass Long:\n    first = 1\n\n    second = 2\n").body[0]
    assert lines_of(found) == 6
    assert offenders({"a.py: Long": 6, "a.py: Short": 5}, 5) == ["a.py: Long: 6, at most 5"]


def test_the_numbers_are_those_of_the_guide():
    text = " ".join((ROOT / "CONTRIBUTING.md").read_text().split())
    rule = f"at most {MOST_MODULES} modules, a module at most {MOST_LINES} lines, and a class at "
    assert rule + f"most {MOST_OF_CLASS} lines" in text
