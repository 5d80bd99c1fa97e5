"""The names a user imports from the top of the package."""

import subprocess
import sys

import pytest

import planner_jax
from planner_jax.task.catch.planners import PLANNERS as CATCH_PLANNERS
from planner_jax.task.hit.planners import PLANNERS as HIT_PLANNERS


@pytest.mark.parametrize("name", planner_jax.__all__)
def test_public_name_can_be_imported_and_has_a_docstring(name):
    assert getattr(planner_jax, name).__doc__


@pytest.mark.parametrize(
    ("function", "planners"),
    [(planner_jax.planner, HIT_PLANNERS), (planner_jax.catch_planner, CATCH_PLANNERS)],
)
def test_a_planner_by_name_says_which_names_there_are(function, planners):
    for name in planners:
        assert f"* `{name}`: " in function.__doc__
        assert type(function(name)).__name__ in function.__doc__
    with pytest.raises(ValueError, match="planner must be one of exact"):
        function("nobody")
    with pytest.raises(TypeError, match="no_field"):
        function("exact", no_field=1)


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'plans'"):
        planner_jax.plans  # noqa: B018


def test_importing_the_package_does_not_import_jax():
    code = "import sys, planner_jax; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
