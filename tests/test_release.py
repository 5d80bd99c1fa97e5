"""The version of a release, and the files that describe the project to others."""

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]


def test_package_citation_and_changelog_name_one_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    changes = (ROOT / "CHANGELOG.md").read_text()
    latest = re.search(r"^## \[(\d[^\]]*)\] - ([\d-]+)$", changes, re.MULTILINE)
    assert latest is not None
    assert (version, version) == (citation["version"], latest[1])
    assert str(citation["date-released"]) == latest[2]


def test_every_workflow_template_and_hook_file_is_yaml() -> None:
    files = [ROOT / ".pre-commit-config.yaml", *(ROOT / ".github").rglob("*.yml")]
    assert len(files) == 5
    assert all(yaml.safe_load(file.read_text()) for file in files)


def test_readme_shows_an_example_early_and_one_number_a_cell() -> None:
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 80
    assert lines.index("```python") < 30 and lines.index("```text") < 30
    rows = [line.split("|")[2:4] for line in lines if line.startswith("| ") and "%" in line]
    assert 0 < len(rows) <= 5
    assert all(len(re.findall(r"\d[\d.,]*", cell)) <= 1 for row in rows for cell in row)
