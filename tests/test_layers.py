"""No module imports a package that comes later in the list of layers, `LAYERS`."""

import functools
import sys

import layers
import pytest
from layers import BY_NAME, LAYERS, OUTSIDE, ROOT, package_of

PALLAS = ROOT / "planner_jax" / "lanes" / "pallas.py"


@functools.cache
def list_imports():
    return [found for path in layers.list_modules() for found in layers.read_imports(path)]


def top_of(found):
    return found.name.split(".")[0]


def is_missing(found):
    module = ROOT.joinpath(*found.name.split("."))
    paths = module, module.parent
    return found.is_string and not any(p.is_dir() or p.with_suffix(".py").exists() for p in paths)


def is_of_pallas(found):
    is_own = found.name.startswith("planner_jax.lanes.") or found.path == PALLAS
    return "pallas" in found.name and not is_own


def is_foreign_to_the_referee(found):
    known = {"numpy", "mujoco", *sys.stdlib_module_names}
    is_own = found.package == "referee" or top_of(found) in known
    return package_of(found.path) == "referee" and not is_own


OFFENDERS = {
    "a module imports only its own package and those before it": lambda f: not layers.is_allowed(f),
    "a module named in a string exists": is_missing,
    "the library names the folders beside it through its links": lambda f: top_of(f) in OUTSIDE,
    "one module imports Pallas, whose backend JAX deprecates": is_of_pallas,
    "the referee imports NumPy, MuJoCo and the standard library alone": is_foreign_to_the_referee,
}


@pytest.mark.parametrize("rule", OFFENDERS)
def test_no_import_breaks_a_rule(rule):
    assert [str(found) for found in list_imports() if OFFENDERS[rule](found)] == []


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
from ..planning import plan
PLANNERS = {"mine": "planner_jax.live.loop:Live", "text": "See planner_jax.live.loop:Live."}
"""
    found = layers.read_imports(ROOT / "planner_jax" / "optimise" / "x.py", source)
    assert [(f.name, f.is_lazy, f.is_string, layers.is_allowed(f)) for f in found] == [
        ("jax.numpy", False, False, True),
        ("planner_jax.ball", False, False, True),
        ("planner_jax.task.hit.plan.HitPlan", False, False, False),
        ("planner_jax.sims.scene.load", True, False, False),
        ("planner_jax.policies.env", True, False, False),
        ("planner_jax.optimise.lbfgs", False, False, True),
        ("planner_jax.planning.plan", False, False, False),
        ("planner_jax.live.loop.Live", False, True, False),
    ]


def test_only_declared_packages_are_named_in_strings():
    named = {}
    for found in list_imports():
        if found.is_string and found.package != package_of(found.path):
            if LAYERS.index(found.package) > LAYERS.index(package_of(found.path)):
                named.setdefault(package_of(found.path), set()).add(found.package)
    assert named == BY_NAME


def test_every_package_has_its_layer_and_its_row_in_contributing():
    assert {package_of(path) for path in layers.list_modules()} == set(LAYERS)
    if layers.split_page()[1] != layers.make_table():
        pytest.fail(f"the table of packages is stale: {layers.REGENERATE}")
