"""Imports go downwards: no module imports a package of a later layer."""

import layers
import pytest
from layers import BY_NAME, LAYERS, OUTSIDE, ROOT, package_of

IMPORTS = [found for path in layers.list_modules() for found in layers.read_imports(path)]


def offenders(is_wrong):
    return [str(found) for found in IMPORTS if is_wrong(found)]


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


def test_modules_import_only_their_own_package_and_those_before_it_in_layers():
    assert offenders(lambda found: not layers.is_allowed(found)) == []


def test_only_declared_packages_are_named_in_strings_and_each_module_named_exists():
    named = {}
    for found in IMPORTS:
        if found.is_string and found.package != package_of(found.path):
            if LAYERS.index(found.package) > LAYERS.index(package_of(found.path)):
                named.setdefault(package_of(found.path), set()).add(found.package)
    assert named == BY_NAME

    def is_missing(found):
        module = ROOT.joinpath(*found.name.split("."))
        return found.is_string and not any(
            path.is_dir() or path.with_suffix(".py").exists() for path in (module, module.parent)
        )

    assert offenders(is_missing) == []


def test_every_package_has_its_layer_and_its_row_in_contributing():
    assert {package_of(path) for path in layers.list_modules()} == set(LAYERS)
    if layers.split_page()[1] != layers.make_table():
        pytest.fail(f"the table of packages is stale: {layers.REGENERATE}")


def test_the_library_names_the_folders_beside_it_through_its_links():
    assert offenders(lambda found: found.name.split(".")[0] in OUTSIDE) == []


def test_one_module_imports_pallas():
    """JAX deprecates the backend of the kernels: only one module will have to change."""
    allowed = ROOT / "planner_jax" / "lanes" / "pallas.py"

    def is_wrong(found):
        is_own = found.name.startswith("planner_jax.lanes.")
        return "pallas" in found.name and found.path != allowed and not is_own

    assert offenders(is_wrong) == []


def test_the_referee_shares_no_arithmetic_with_the_planners():
    others = {"jax", "jaxlib", "flax", "optax", "chex", "planner_jax"}

    def is_wrong(found):
        is_other = found.name.split(".")[0] in others and found.package != "referee"
        return package_of(found.path) == "referee" and is_other

    assert offenders(is_wrong) == []
