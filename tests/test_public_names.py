"""The names a user imports from the top of the package."""

import subprocess
import sys

import pytest

import planner_jax


@pytest.mark.parametrize("name", planner_jax.__all__)
def test_public_name_can_be_imported_and_has_a_docstring(name):
    assert getattr(planner_jax, name).__doc__


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'plans'"):
        planner_jax.plans  # noqa: B018


def test_importing_the_package_does_not_import_jax():
    code = "import sys, planner_jax; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
