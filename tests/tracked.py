"""The tracked files of the repository, for the tests of texts."""

import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]


def tracked_files(*patterns: str) -> list[str]:
    """Return the paths of tracked files that match one of git's patterns, from the root."""
    return subprocess.run(
        ["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
