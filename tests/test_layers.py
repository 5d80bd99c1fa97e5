"""Imports go downwards: no room of the library knows a room that is built on it."""

import ast
import graphlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "planner_jax."
# Folders beside the library, which a link and the wheel put into its package.
OUTSIDE = {"sims", "policies", "benchmarks"}
# What each room imports of planner_jax, besides itself: no more, and no less.
ALLOWED = {
    "__init__": {
        "ball",
        "core",
        "cost",
        "export",
        "host",
        "live",
        "optimise",
        "plane",
        "planning",
        "recovery",
        "referee",
        "robot",
        "task",
        "trajectory",
    },
    "__main__": {"cli", "host"},
    "ball": {"core", "lanes"},
    "baselines": {
        "ball",
        "core",
        "cost",
        "host",
        "optimise",
        "plane",
        "planning",
        "referee",
        "robot",
        "task",
        "trajectory",
    },
    "cli": {
        "baselines",
        "core",
        "export",
        "host",
        "lanes",
        "live",
        "planning",
        "robot",
        "runs",
        "sweep",
        "task",
    },
    "core": {"host"},
    "cost": {"core", "lanes", "robot", "trajectory"},
    "export": {"core", "host", "recovery", "robot", "trajectory"},
    "host": set(),
    "lanes": set(),
    "live": {
        "ball",
        "core",
        "host",
        "optimise",
        "planning",
        "recovery",
        "robot",
        "runs",
        "sweep",
        "task",
        "trajectory",
    },
    "optimise": {"core", "lanes"},
    "perception": {"ball"},
    "plane": {"core"},
    "planning": {"core", "host", "optimise"},
    "recovery": {"core", "cost", "optimise", "planning", "referee", "robot", "trajectory"},
    "referee": set(),
    "robot": {"core", "host", "trajectory"},
    "runs": {"core", "host", "lanes", "planning"},
    "space": set(),
    "studies": {
        "ball",
        "baselines",
        "core",
        "cost",
        "optimise",
        "perception",
        "plane",
        "planning",
        "referee",
        "robot",
        "task",
        "trajectory",
    },
    "sweep": {
        "ball",
        "baselines",
        "core",
        "host",
        "perception",
        "plane",
        "planning",
        "referee",
        "robot",
        "runs",
        "studies",
        "task",
        "trajectory",
    },
    "task": {
        "ball",
        "core",
        "cost",
        "host",
        "lanes",
        "optimise",
        "plane",
        "planning",
        "recovery",
        "referee",
        "robot",
        "space",
        "trajectory",
    },
    "trajectory": {"core"},
}
LIBRARY = ROOT / "planner_jax"
# Stubs too: they say what a package attaches lazily.
MODULES = sorted(
    path
    for path in LIBRARY.rglob("*.py*")
    if path.suffix in (".py", ".pyi") and path.relative_to(LIBRARY).parts[0] not in OUTSIDE
)


def room_of(path):
    """The folder or module under planner_jax that a file belongs to."""
    return path.relative_to(ROOT / "planner_jax").parts[0].split(".")[0]


def dotted_names(statement, package):
    """Full names that one import statement asks for; relative ones start from `package`."""
    if isinstance(statement, ast.Import):
        return [alias.name for alias in statement.names]
    if isinstance(statement, ast.ImportFrom):
        base = package[: len(package) - statement.level + 1] if statement.level else ()
        prefix = ".".join((*base, *filter(None, [statement.module])))
        return [f"{prefix}.{alias.name}" for alias in statement.names]
    return []


def imports(tree, package=()):
    """(dotted name, whether it stands inside a function) of every import in a syntax tree."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    found = []

    def visit(node, lazy):
        found.extend((name, lazy) for name in dotted_names(node, package))
        for child in ast.iter_child_nodes(node):
            visit(child, lazy or isinstance(node, functions))

    visit(tree, False)
    return found


def imports_of(path):
    return imports(ast.parse(path.read_text()), path.relative_to(ROOT).parent.parts)


def rooms_of_imports(path):
    """The other rooms of the library that a module imports from."""
    inside = [name.split(".")[1:] for name, _ in imports_of(path) if f"{name}.".startswith(PACKAGE)]
    assert all(inside), f"{path} imports planner_jax itself"
    return {parts[0] for parts in inside} - OUTSIDE - {room_of(path)}


def name_of(path):
    return path.relative_to(ROOT).as_posix()


def test_imports_are_found_wherever_and_however_they_are_written():
    source = """
import jax.numpy as jnp
from planner_jax import ball
from planner_jax.task.hit.plan import HitPlan
def f():
    from planner_jax.sims.scene import load
    if True:
        import planner_jax.policies.env
from . import lbfgs
from ..cost import quadrotor
"""
    assert imports(ast.parse(source), ("planner_jax", "optimise")) == [
        ("jax.numpy", False),
        ("planner_jax.ball", False),
        ("planner_jax.task.hit.plan.HitPlan", False),
        ("planner_jax.sims.scene.load", True),
        ("planner_jax.policies.env", True),
        ("planner_jax.optimise.lbfgs", False),
        ("planner_jax.cost.quadrotor", False),
    ]


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_module_imports_only_the_rooms_below_its_own(path):
    room = room_of(path)
    assert room in ALLOWED, f"{room} is a new room: give it its place in ALLOWED"
    unknown = rooms_of_imports(path) - ALLOWED[room]
    assert not unknown, f"imports {unknown}"


def test_every_import_that_the_table_allows_is_made_somewhere():
    made = {room: set() for room in ALLOWED}
    for path in MODULES:
        made[room_of(path)] |= rooms_of_imports(path)
    assert made == ALLOWED


def test_rooms_can_be_put_in_an_order_in_which_each_knows_only_earlier_ones():
    assert set(graphlib.TopologicalSorter(ALLOWED).static_order()) == ALLOWED.keys()


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_only_the_command_line_reaches_outside_the_library_and_only_when_called(path):
    for name, lazy in imports_of(path):
        assert name.split(".")[0] not in OUTSIDE, f"imports {name}, which an installed wheel lacks"
        if name.split(".")[:1] == ["planner_jax"] and name.split(".")[1] in OUTSIDE:
            assert room_of(path) == "cli" and lazy, f"imports {name}"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_pallas_has_one_door(path):
    """JAX is taking away the backend that kernels are written for: one module has to change."""
    if path != LIBRARY / "lanes" / "pallas.py":
        for name, _ in imports_of(path):
            assert "pallas" not in name or name.startswith("planner_jax.lanes."), f"imports {name}"


@pytest.mark.parametrize("path", [m for m in MODULES if room_of(m) == "referee"], ids=name_of)
def test_the_referee_shares_no_arithmetic_with_the_planners(path):
    for name, _ in imports_of(path):
        assert name.split(".")[0] not in {"jax", "jaxlib", "flax", "optax", "chex"}
