"""The files that git tracks, for the tests of the project's texts."""

import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]


def tracked_files(*patterns: str) -> list[str]:
    """Return the files that git tracks and that match a pattern, as paths from the root."""
    return subprocess.run(
        ["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
