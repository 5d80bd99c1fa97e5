"""A task from outside the library, tests/own_task, works without an edit of the library."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.core.tasks import all_tasks
from tests.sweeps import rows_of

OWN_TASK = Path(__file__).parent / "own_task"
BROKEN = {
    "METADATA": "Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n",
    "entry_points.txt": "[planner_jax.tasks]\nbroken = nowhere_at_all:TASK\n",
}


@pytest.fixture(scope="module")
def meet():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(OWN_TASK)
        all_tasks.cache_clear()
        yield pj.task_named("meet")
    all_tasks.cache_clear()
    sys.modules.pop("meet", None)


def process(folder, *arguments, path=()):
    others = [str(OWN_TASK), *map(str, path), os.environ.get("PYTHONPATH", "")]
    return subprocess.Popen(
        [sys.executable, "-m", "planner_jax", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(others)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def command(folder, *arguments, path=()):
    running = process(folder, *arguments, path=path)
    out, err = running.communicate()
    return SimpleNamespace(code=running.returncode, out=out, err=err)


def manifest_of(folder):
    return json.loads((folder / "manifest.json").read_text())


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    done = command(folder, "sweep", "meet", "--num", "24", "--batch", "16", "--out", "run")
    assert done.code == 0, done.err
    return folder / "run", done.out


def test_the_task_is_one_short_file():
    assert len((OWN_TASK / "meet.py").read_text().splitlines()) <= 150


def test_a_sweep_writes_the_whole_run_folder(swept):
    out, said = swept
    manifest = manifest_of(out)
    assert (manifest["kind"], manifest["state"]) == ("sweep meet", "complete")
    assert manifest["summary"]["num"] == 24
    assert manifest["summary"]["success_rate"] == 1.0
    assert "100.00 % success, 24 of 24 plans pass the referee" in said
    page = (out / "index.html").read_text()
    assert "Meet sweep, suite square, planner smooth" in page
    assert 'src="figures/outcomes.png"' in page
    assert (out / "figures" / "outcomes.png").read_bytes().startswith(b"\x89PNG")
    assert "| square | 24 | 100.00 |" in (out / "table.md").read_text()
    assert pq.read_table(out / "baselines")["planner"].to_pylist() == ["scipy"]


def test_the_rows_are_the_leaves_of_case_plan_and_verdict(swept, meet):
    rows = pq.read_table(swept[0] / "plans")
    assert rows["index"].to_pylist() == list(range(24))
    assert set(rows["status"].to_pylist()) <= {"CONVERGED", "FEASIBLE"}
    cases, columns = meet.draw(24), {"case.most": "most", "case.target_pos": "target_pos"}
    for name, leaf in columns.items():
        np.testing.assert_array_equal(rows[name].to_pylist(), getattr(cases, leaf).tolist())
    # The command `sweep` compiled a program for 16 cases at once, which is used again here.
    plans = pj.plan(meet.planner(), jax.tree.map(np.asarray, cases), chunk=16)
    np.testing.assert_allclose(rows["plan.time"].to_numpy(), plans.time, rtol=1e-4)
    assert max(rows["verdict.miss"].to_pylist()) < 1e-3


def test_a_report_is_made_anew_from_the_folder(swept, meet, capsys):
    out, said = swept
    page = (out / "index.html").read_text()
    (out / "index.html").unlink()
    assert main(["report", str(out)]) == 0
    assert capsys.readouterr().out.replace(str(out), "run") == said
    assert (out / "index.html").read_text() == page


@pytest.mark.slow
def test_a_sweep_that_ctrl_c_stops_is_resumed_to_the_same_rows(swept, tmp_path):
    settings = ["--planner", "scipy", "--num", "6", "--batch", "1", "--out", "run"]
    whole = command(tmp_path, "sweep", "meet", *settings[:-1], "whole")
    assert whole.code == 0, whole.err
    manifest = manifest_of(tmp_path / "whole")
    assert (manifest["summary"]["num"], manifest["summary"]["success_rate"]) == (6, 1.0)
    assert manifest["parameters"]["planner"] == "scipy"  # on the host
    with process(tmp_path, "sweep", "meet", *settings) as running:
        while not list(tmp_path.glob("run/plans/part-*.parquet")):
            assert running.poll() is None
        running.send_signal(signal.SIGINT)
        _, err = running.communicate()
    assert running.returncode == 130
    assert err.splitlines()[-1].endswith("planner-jax sweep meet --resume --out run")
    assert manifest_of(tmp_path / "run")["state"] == "interrupted"
    done = command(tmp_path, "sweep", "meet", "--resume", "--out", "run")
    assert done.code == 0, done.err
    rows = [rows_of(tmp_path / name) for name in ("run", "whole")]
    assert rows[0] == rows[1]


@pytest.mark.slow
@pytest.mark.parametrize(("planner", "num"), [("smooth", 16), ("scipy", 2)])
def test_throughput_is_measured_with_success_and_cost_beside(meet, tmp_path, planner, num):
    settings = ["--task", "meet", "--planner", planner, "--batch", str(num), "--repeat", "1"]
    assert main(["bench", "throughput", *settings, "--out", str(tmp_path / "run")]) == 0
    manifest = manifest_of(tmp_path / "run")
    summary = manifest["summary"]
    assert (manifest["kind"], manifest["state"]) == ("bench throughput", "complete")
    assert (summary["num"], summary["success_rate"]) == (num, 1.0)
    gaps = [summary[f"cost_gap_{name}"] for name in ("median", "p90", "p99")]
    assert gaps == [None] * 3 if planner == "scipy" else -1e-3 < gaps[0] <= gaps[1] < 0.05


def test_a_broken_package_beside_it_is_named_in_one_line_and_the_rest_works(tmp_path):
    folder = tmp_path / "site" / "broken-1.0.dist-info"
    folder.mkdir(parents=True)
    for name, text in BROKEN.items():
        (folder / name).write_text(text)
    done = command(tmp_path, "sweep", "--help", path=[folder.parent])
    assert done.code == 0 and done.err.count("\n") == 1
    problem = "task 'broken' of nowhere_at_all:TASK is left out: ModuleNotFoundError"
    assert done.err.startswith(f"planner-jax: warning: {problem}")
    listed = " ".join(done.out.split())  # argparse's columns differ between versions of Python
    for words in ("hit ", "catch ", "meet a point mass in the plane meets a moving point"):
        assert words in listed


@pytest.mark.slow
def test_the_gradient_is_that_of_plans_made_anew(meet, float64):
    search = pj.LbfgsConfig(400, tolerance=1e-12, patience=20)
    cases = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), meet.draw(6, seed=1))
    planner = meet.planner("smooth", attempts=(pj.Attempt(1, search),))
    found = pj.gradient(planner, cases, of="time", by="most", steps=3)
    apart = 1e-4 * cases.most
    later, sooner = (pj.plan(planner, cases.replace(most=cases.most + d)) for d in (apart, -apart))
    slope = (later.time - sooner.time) / (2.0 * apart)
    np.testing.assert_allclose(found.by["most"], slope, rtol=1e-4)
    assert (slope < 0.0).all()  # more acceleration means an earlier meeting


def test_a_planner_on_the_host_has_no_gradient_and_says_so(meet):
    with pytest.raises(TypeError, match="ScipyMeet minimises nothing"):
        pj.gradient(meet.planner("scipy"), meet.draw(2), of="time", by="most")
