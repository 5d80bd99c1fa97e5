import subprocess
import sys

from layers import ROOT


def test_few_files_are_imported_to_draw_plan_and_judge_one_hit():
    command = [sys.executable, "-m", "tests.closure"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    files, _, lines, _ = run.stdout.splitlines()[-1].split()
    assert int(files) <= 60 and int(lines) <= 10_000, run.stdout
