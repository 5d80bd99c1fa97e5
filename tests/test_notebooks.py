"""Every notebook runs from top to bottom."""

import ast
from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    ).execute()
    printed = "".join(
        output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", [])
    )
    assert "confirmed" in printed


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_name_that_a_notebook_imports_exists(path):
    cells = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    for cell in cells:
        for statement in ast.walk(ast.parse(cell.source)):
            module = getattr(statement, "module", None) or ""
            if isinstance(statement, ast.ImportFrom) and module.startswith("planner_jax"):
                exec(ast.unparse(statement), {})


def test_from_a_measured_ball_to_setpoints_are_six_lines():
    path = next(path for path in NOTEBOOKS if path.stem == "08_your_robot")
    cells = nbformat.read(path, as_version=4).cells
    (way,) = [cell.source for cell in cells if "six-lines" in cell.metadata.get("tags", [])]
    assert "loadtxt" in way and 'to="csv"' in way
    assert len([line for line in way.splitlines() if line.strip()]) <= 6
