"""Runs that plan and judge many catches: tables, figures, resuming, and rejected settings."""

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest
from referees import flight
from sweeps import RunTests, columns, quick_catch

import planner_jax as pj
from planner_jax.referee.catch import referee_catches
from planner_jax.runs.columns import RefereedBatch
from planner_jax.runs.columns import rows_of as columns_of
from planner_jax.runs.run_folder import RunFolder
from planner_jax.sweep.catch.columns import COLUMNS, FRAME
from planner_jax.sweep.catch.figures import target_positions
from planner_jax.sweep.catch.settings import CatchSettings
from planner_jax.sweep.catch.sweep import CatchSweep, CatchTally
from planner_jax.sweep.run import resume_sweep
from planner_jax.task.catch.spec import SUITES

TASK = pj.task_named("catch")
NUM, BATCH = 8, 4
SETTINGS = CatchSettings(suite="parabola2", decide="greedy", num=NUM, batch=BATCH, seed=2)


def open_source(settings, batch):
    return CatchSweep(TASK).open_source(settings.of(TASK), batch)


@pytest.fixture(autouse=True, scope="module")
def quick_planners():
    quick = lambda settings: quick_catch(**settings.planner_options())  # noqa: E731
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CatchSweep, "planner", lambda _, settings: quick(settings))
        patch.setattr(CatchSweep, "other_planners", lambda _, settings: {"mpp": quick(settings)})
        yield


class TestRun(RunTests):
    sweep = CatchSweep(TASK)
    figures = ("flight.png", "motion.png", "outcomes.png")
    other = "mpp"
    not_finite = ()
    lists = ("coeffs", "durations", "catch_times", "net_distance")


def test_the_summary_counts_targets_and_times(finished):
    rows, summary = columns(finished[0]), finished[1]["summary"]
    assert summary["caught"] == pytest.approx(rows["num_caught"].mean() / 2)
    times, decided, caught = rows["catch_times"], rows["decided_times"], rows["caught"]
    assert summary["mean_catch_time"] == pytest.approx(times[caught].mean())
    solved = np.isin(rows["status"], ["CONVERGED", "FEASIBLE"])
    ratio = np.mean(np.abs(times - decided) / times, axis=1)
    assert summary["optimal_time_ratio"] == pytest.approx(ratio[solved].mean(), rel=1e-5)


def test_a_planner_that_decides_itself_has_no_optimal_time_ratio(finished):
    tally = CatchTally(decides=False)
    tally.add(pq.read_table(finished[0] / "plans"))
    assert tally.summary()["optimal_time_ratio"] is None
    assert CatchSweep(TASK).tally(CatchSettings(planner="mpp"))._decides is False


def test_the_rows_alone_lead_the_referee_to_the_same_verdict(finished):
    out, manifest = finished
    rows, setting = columns(out), manifest["setting"]
    head = np.zeros((NUM, 4, 3))
    head[:, 0] = rows["start"]
    leaves = {name: rows[name] for name in ("present", "horizon", "durations", "order")}
    leaves |= {"head_state": head, "times": rows["catch_times"]}
    leaves["coeffs"] = rows["coeffs"].reshape(*rows["durations"].shape, -1, 3)
    leaves["targets.gravity"] = rows["ball_gravity"]
    for path, name in (("ball.pos", "ball_pos"), ("ball.vel", "ball_vel"), ("drag", "drag")):
        leaves[f"targets.{path}"] = rows[name].reshape(NUM, 2, 3)
    limits = ("speed", "min_thrust", "max_thrust", "body_rate", "min_height")
    constants = {f"limits.{name}": setting[name] for name in limits}
    constants |= {f"net.{name}": setting[f"net_{name}"] for name in ("height", "radius")}
    constants |= {"net.max_angle": setting["net_max_angle"], "gravity": setting["gravity"]}
    leaves |= {name: np.full(NUM, value) for name, value in constants.items()}
    found = flight(leaves, optional=None)
    verdict = referee_catches(found, found)
    np.testing.assert_array_equal(verdict.success, rows["success"])
    np.testing.assert_array_equal(verdict.failed_limit, rows["failed_limit"])
    np.testing.assert_allclose(verdict.net_distance, rows["net_distance"], atol=1e-5)


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("catch", {"suite": "hard"}, "suite must be parabola2 as in the run .*, got hard"),
        ("hit", {}, "out must be the folder of a sweep hit, got one of a sweep catch"),
    ],
)
def test_a_run_is_resumed_as_what_it_is(finished, name, given, message):
    with pytest.raises(pj.ArgumentError, match=message):
        resume_sweep(pj.task_named(name), finished[0], **given)


def test_cases_that_are_drawn_otherwise_are_not_mixed_into_a_run(finished, tmp_path, monkeypatch):
    out = tmp_path / "run"
    with RunFolder(out).lock():
        RunFolder(out).write_manifest({**finished[1], "state": "interrupted"})
    real = pj.catch.draw
    other = lambda num, suite, seed, **options: real(num, suite, seed + 1, **options)  # noqa: E731
    monkeypatch.setattr("planner_jax.task.catch.draw", other)
    with pytest.raises(pj.ArgumentError, match="suite must be the same as when the run started"):
        resume_sweep(TASK, out)


def test_the_table_has_the_papers_rates_beside_its_own_suite(finished):
    table = CatchSweep(TASK).table(finished[1])
    assert [row[0] for row in table.rows] == list(SUITES)
    rows = {row[0]: row for row in table.rows}
    assert rows["throws"] == ["throws", "", "", "", "", "96", "0.092", "14"]
    assert rows["hexagon6"][-3:] == ["76.3", "0.458", ""]
    assert rows["parabola2"][1] == str(NUM) and rows["parabola2"][-3:] == ["98.2", "0.119", ""]
    assert table.rows[table.strong][0] == "parabola2"


@pytest.mark.parametrize("suite", ["parabola2", "harmonic2"])
def test_the_columns_of_the_targets_bring_their_paths_back(suite):
    source = open_source(CatchSettings(suite=suite, num=3), batch=2)
    chunk = source.chunk(1)
    case_columns = [c for c in COLUMNS if c.name.startswith(("index", "ball", "drag", "swing"))]
    batch = RefereedBatch(chunk, None, None)
    row = columns_of(case_columns, batch, FRAME).to_pylist()[0]
    assert row["index"] == 2
    times = np.array([0.0, 0.7, 1.3], np.float32)
    targets = jax.tree.map(lambda leaf: leaf[0], chunk.cases.targets)
    expected = jax.vmap(lambda path: jax.vmap(path.at)(times))(targets).pos
    np.testing.assert_allclose(target_positions(row, times), expected, atol=1e-5)


def test_chunks_join_to_the_whole_and_a_seed_is_a_set_of_cases():
    whole = open_source(CatchSettings(num=5, batch=5), batch=1)
    parts = open_source(CatchSettings(num=5), batch=2)
    assert parts.num_chunks == 3
    joined = [parts.chunk(number).cases.targets.ball.vel for number in range(3)]
    np.testing.assert_array_equal(np.concatenate(joined), whole.chunk(0).cases.targets.ball.vel)
    assert parts.description() == open_source(CatchSettings(num=6), batch=2).description()
    assert parts.description() != open_source(CatchSettings(num=5, seed=1), batch=2).description()


def test_limits_are_scaled_and_thrust_about_hover():
    def limits(**settings):
        return open_source(CatchSettings(num=2, **settings), batch=2).chunk(0).cases.limits

    full, half, wide = limits(), limits(limit_scale=0.5), limits(limit_scale=2.0)
    np.testing.assert_allclose(half.speed, 0.5 * full.speed)
    np.testing.assert_allclose(half.body_rate, 0.5 * full.body_rate)
    np.testing.assert_allclose(half.min_height, full.min_height)
    np.testing.assert_allclose(half.min_thrust, 0.65 * 9.81, rtol=1e-6)
    np.testing.assert_allclose(half.max_thrust, 1.75 * 9.81, rtol=1e-6)
    np.testing.assert_allclose(wide.min_thrust, 0.0)
    assert {leaf.dtype for leaf in jax.tree.leaves(half)} == {np.dtype("float32")}


def test_the_published_protocol_reaches_the_referee_when_it_is_asked_for(monkeypatch):
    asked = {}
    monkeypatch.setattr("planner_jax.task.catch.judge", lambda *_, **given: asked.update(given))
    settings = CatchSettings(planner="catch", tolerance=0.05, net_test="ball")
    CatchSweep(TASK).judge(None, None, settings)
    assert asked == {"tolerance": 0.05, "net_test": "ball"}
