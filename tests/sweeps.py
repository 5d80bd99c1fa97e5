"""Planners that compile quickly, readers of run folders, and tests of runs of several tasks."""

import io
import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import planner_jax as pj
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.runs.run_folder import LOCK, RunFolder
from planner_jax.sweep.report import write_report
from planner_jax.sweep.run import SweepInterrupted, resume_sweep, start_sweep
from planner_jax.sweep.sweep import Sweep
from planner_jax.task.hit.default_planner import HitProblem


def quick_hit(**options):
    return HitProblem.planner(attempts=HitProblem.planner().attempts[:1], **options)


def quick_catch(**options):
    attempts = (Attempt(1, LbfgsConfig(max_steps=20)),)
    return pj.catch.planner(attempts=attempts, **{"decide": "greedy", **options})


def columns(out):
    """Return the columns of a run's table of plans by name, as NumPy arrays (rows, ...)."""
    table = pq.read_table(out / "plans")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def rows_of(out):
    """Return a run's table of plans as bytes, without the measured times in its metadata."""
    table = pq.read_table(out / "plans").replace_schema_metadata(None)
    file = io.BytesIO()
    with pa.ipc.new_file(file, table.schema) as writer:
        writer.write_table(table)
    return file.getvalue()


def stop_after(monkeypatch, sweep, num_chunks):
    calls = iter(range(num_chunks))

    def plan(*arguments):
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return real(*arguments)

    real = sweep.plan
    monkeypatch.setattr(sweep, "plan", plan)


def write_rows(folder, rows, *, kind="sweep hit", is_finished=True, parameters=()):
    """Write and return the folder of a run whose table of plans is `rows`, one row per plan."""
    manifest = {"kind": kind, "state": "running", "parameters": dict(parameters), "sessions": []}
    manifest |= {"run": "", "settings": "", "setting": {"gravity": 9.81}}
    manifest |= {"versions": {}, "device": {}}
    run = RunFolder(folder, name="RUN")
    with run.create(manifest):
        if is_finished:
            num, successes = len(rows), sum(rows["success"].to_pylist())
            summary = {"num": num, "successes": successes, "success_rate": successes / num}
            summary |= {"wilson_95": [0.0, 1.0], "plans_per_second_warm": 500.0}
            summary |= {"status_counts": {}, "failed_limits": {}}
            seconds = {f"{name}_seconds": 2.0 for name in ("compile", "referee", "wall")}
            run.plans.write_rows(rows)
            manifest |= {"state": "complete", "summary": summary, "times": seconds}
            run.write_manifest(manifest)
    return run


class RunTests:
    sweep: Sweep
    figures: tuple[str, ...]
    other: str  # name of the other planner
    not_finite: tuple[str, ...]  # columns of a row whose plan is not finite
    lists: tuple[str, ...]  # columns of lists of such a row

    def test_a_finished_run_holds_manifest_rows_table_figures_and_page(self, finished, request):
        out, manifest = finished
        settings = request.module.SETTINGS
        assert manifest == json.loads((out / "manifest.json").read_text())
        assert (manifest["kind"], manifest["state"]) == (self.sweep.kind, "complete")
        assert type(settings)(**manifest["parameters"]) == settings.of(self.sweep.task)
        page = (out / "index.html").read_text()
        for name in self.figures:
            assert (out / "figures" / name).read_bytes().startswith(b"\x89PNG")
            assert f'src="figures/{name}"' in page
        assert (out / "table.md").stat().st_size > 0
        assert len(list((out / "plans").iterdir())) == -(-settings.num // settings.batch)
        assert pq.read_table(out / "baselines")["planner"].to_pylist() == [self.other]
        assert [path.name for path in out.rglob(".*")] == [LOCK]

    def test_the_summary_counts_successes_and_statuses(self, finished):
        rows, summary = columns(finished[0]), finished[1]["summary"]
        num, successes = len(rows["index"]), int(rows["success"].sum())
        assert 0 < successes < num == summary["num"]
        assert summary["successes"] == successes
        assert summary["success_rate"] == pytest.approx(successes / num)
        assert sum(summary["status_counts"].values()) == num
        assert sum(summary["failed_limits"].values()) == num - successes
        assert summary["plans_per_second_warm"] > 0.0
        assert summary["compile_seconds"] == finished[1]["times"]["compile_seconds"]

    def test_every_column_has_its_unit_and_meaning(self, finished):
        for field in pq.ParquetDataset(finished[0] / "plans").schema:
            assert field.metadata.keys() == {b"unit", b"meaning"} and field.metadata[b"meaning"]

    def test_a_report_is_drawn_again_from_the_folder_alone(self, finished, tmp_path):
        out, _ = finished
        shutil.copytree(out / "plans", tmp_path / "plans")
        shutil.copy(out / "manifest.json", tmp_path)
        write_report(RunFolder(tmp_path))
        for name in ("table.md", "index.html"):
            assert (tmp_path / name).read_text() == (out / name).read_text()
        assert {path.name for path in (tmp_path / "figures").iterdir()} == set(self.figures)

    def test_a_plan_that_is_not_finite_is_reported(self, finished, tmp_path):
        out, manifest = finished
        table = pq.read_table(out / "plans").slice(manifest["example"], 1)
        row = table.to_pylist()[0] | dict.fromkeys(self.not_finite, float("nan"))
        row |= {"index": 0, "success": False, "sentence": "not finite", "failed_limit": "finite"}
        row |= {name: [float("nan")] * len(row[name]) for name in self.lists}
        folder = RunFolder(tmp_path)
        folder.write_manifest({**manifest, "example": 0})
        folder.plans.write_rows(pa.Table.from_pylist([row], schema=table.schema))
        write_report(folder)
        assert "not finite" in (tmp_path / "index.html").read_text()

    @pytest.mark.parametrize("num_chunks", [0, 1])
    def test_an_interrupted_sweep_is_resumed_to_the_same_rows(
        self, finished, tmp_path, monkeypatch, request, num_chunks
    ):
        out, settings, task = tmp_path / "run", request.module.SETTINGS, self.sweep.task
        monkeypatch.setattr("planner_jax.sweep.run.write_report", lambda folder: None)
        monkeypatch.setattr(type(self.sweep), "other_planners", lambda *_: {})
        with monkeypatch.context() as patch:
            stop_after(patch, type(self.sweep), num_chunks)
            with pytest.raises(SweepInterrupted):
                start_sweep(task, settings, out, progress=False)
        folder = RunFolder(out)
        assert folder.read_manifest()["state"] == "interrupted"
        # `resume_sweep` must remove these temporary files, which a killed process would leave.
        (out / "plans").mkdir(exist_ok=True)
        (out / "plans" / ".4711.tmp.part-000002.parquet").write_bytes(b"half a part")
        (out / ".4711.tmp.table.md").write_bytes(b"half a table")
        manifest = resume_sweep(task, out, progress=False, num=settings.num)
        assert manifest["state"] == "complete" and len(manifest["sessions"]) == 2
        assert rows_of(out) == rows_of(finished[0])
        assert manifest["summary"]["successes"] == finished[1]["summary"]["successes"]
        assert [path.name for path in out.rglob(".*")] == [LOCK]
        assert resume_sweep(task, out, progress=False) == manifest
