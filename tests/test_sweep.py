"""Runs that plan and judge many hits: folder, resuming, tables, figures, clocks and rates."""

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pytest
from referees import flight
from sweeps import RunTests, columns, quick_hit, stop_after

import planner_jax as pj
from planner_jax.baselines.protocols import BY_ROW
from planner_jax.referee.hit import referee_hits
from planner_jax.robot import quadrotor
from planner_jax.runs.dataset import ROW_GROUP, Dataset, encode
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.runs.timing import CompileClock
from planner_jax.sweep import run
from planner_jax.sweep.hit.settings import HitSettings
from planner_jax.sweep.hit.sweep import HitSweep
from planner_jax.sweep.quadrotor import body_rate, net_thrust, sample_motion
from planner_jax.sweep.run import SweepInterrupted, resume_sweep, start_sweep
from planner_jax.task.hit import court
from planner_jax.task.hit.spec import REAL_SCENARIOS

TASK = pj.task_named("hit")
open_source = HitSweep(TASK).open_source
NUM, BATCH = 84, 13  # chunks and single cases are planned by one program, for up to 16
SETTINGS = HitSettings(num=NUM, batch=BATCH, delay=0.8, seed=3)
FAILED = "failed,failed,failed"


@pytest.fixture(autouse=True, scope="module")
def quick_planners():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HitSweep, "planner", lambda _, s: quick_hit(**s.planner_options()))
        patch.setattr(HitSweep, "other_planners", lambda *_: {"bat": quick_hit()})
        yield


@pytest.fixture
def no_report(monkeypatch):
    monkeypatch.setattr(run, "write_report", lambda folder: None)
    monkeypatch.setattr(HitSweep, "other_planners", lambda *_: {})


class TestRun(RunTests):
    sweep = HitSweep(TASK)
    figures = ("court.png", "motion.png", "outcomes.png")
    other = "bat"
    not_finite = ("contact_time", "cost", "failed_time")
    lists = ("coeffs", "durations")


def test_the_manifest_says_what_was_run_where_and_how_long(finished):
    _, manifest = finished
    assert manifest["seed"] == 3
    assert {"python", "jax", "numpy", "planner-jax"} <= manifest["versions"].keys()
    assert manifest["device"]["platform"] == jax.default_backend()
    assert manifest["device"]["cpu_count"] >= 1
    assert manifest["setting"]["speed"] == 5.0
    times = manifest["times"]
    for name in ("first_seconds", "warm_seconds", "referee_seconds"):
        assert 0.0 < times[name] and name in times["measured"]
    # Another module of the same process may have compiled the program already.
    assert 0.0 <= times["compile_seconds"] < times["wall_seconds"]
    assert "compile_seconds" in times["measured"]


def test_the_summary_has_interval_and_rates_of_scenarios(finished):
    rows, summary = columns(finished[0]), finished[1]["summary"]
    assert summary["wilson_95"] == list(wilson_interval(summary["successes"], NUM))
    for name, count in summary["per_scenario"].items():
        own = rows["success"][rows["scenario"] == name]
        assert (count["num"], count["success_rate"]) == (len(own), pytest.approx(own.mean()))


def test_the_rows_alone_lead_the_referee_to_the_same_verdict(finished):
    out, manifest = finished
    rows, setting = columns(out), manifest["setting"]
    head = np.zeros((NUM, 4, 3))
    head[:, 0] = rows["start"]
    leaves = {"head_state": head, "target": rows["target"], "durations": rows["durations"]}
    leaves |= {"ball.pos": rows["ball_pos"], "ball.vel": rows["ball_vel"]}
    leaves["coeffs"] = rows["coeffs"].reshape(*rows["durations"].shape, -1, 3)
    leaves["stroke.time"] = rows["contact_time"]
    for part, names in (
        ("", ("drag", "gravity", "restitution", "racket_height")),
        ("limits.", ("speed", "acceleration", "body_rate", "min_height")),
        ("hit_limits.", ("hitting_speed", "min_apex", "max_apex")),
    ):
        leaves |= {part + name: np.tile(setting[name], (NUM, 1)).squeeze() for name in names}
    found = flight(leaves, racket_radius=None, lift=None)
    verdict = referee_hits(found, found)
    np.testing.assert_array_equal(verdict.success, rows["success"])
    np.testing.assert_array_equal(verdict.failed_limit, rows["failed_limit"])
    np.testing.assert_allclose(verdict.max_speed, rows["max_speed"], rtol=1e-5)


def test_rows_are_picked_across_the_row_groups_of_parts(tmp_path):
    plans, num = Dataset(tmp_path), 2 * ROW_GROUP + 10
    for part in range(2):
        indices = np.arange(part * num, (part + 1) * num)
        plans.write(part, encode(pa.table({"index": indices}), {}))
    rows = [0, ROW_GROUP - 1, ROW_GROUP, num - 1, num, num + 2 * ROW_GROUP, 2 * num - 1]
    assert [row["index"] for row in plans.pick(rows)] == rows


@pytest.mark.parametrize("step", ["plan_baselines", "write_report"])
def test_a_sweep_interrupted_behind_its_rows_is_resumed_to_its_report(tmp_path, monkeypatch, step):
    monkeypatch.setattr(HitSweep, "figures", ())

    def interrupt(*_):
        raise KeyboardInterrupt

    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(run, step, interrupt)
        with pytest.raises(SweepInterrupted):
            start_sweep(TASK, SETTINGS, out, progress=False)
    assert RunFolder(out).read_manifest()["state"] == "interrupted"
    assert not (out / "index.html").exists()
    manifest = resume_sweep(TASK, out, progress=False)
    assert manifest["state"] == "complete" and (out / "index.html").exists()


def test_resuming_with_another_setting_names_it(finished):
    with pytest.raises(pj.ArgumentError, match=r"delay must be 0.8 as in the run .*, got 0.5"):
        resume_sweep(TASK, finished[0], delay=0.5)


def test_a_serve_drawn_late_that_breaks_a_rule_leaves_nothing_behind(tmp_path):
    # The first 4 balls all fly for longer than `delay` [s], but some later balls land before.
    settings = HitSettings(num=40, batch=4, delay=1.56, seed=0)
    open_source(settings.of(TASK), batch=4).check()
    with pytest.raises(pj.ArgumentError, match="delay must be shorter than each serve's flight"):
        start_sweep(TASK, settings, tmp_path / "runs" / "run", progress=False)
    assert not list(tmp_path.iterdir())


def trial_files(folder, num_rows=3):
    folder.mkdir(exist_ok=True)
    serve = "2.5 -0.3 2,-4.3 0.02 7.{},-2.9 -0.3 0,1.75 0 0"
    for letter in "pb":
        rows = [
            f"{n},{serve.format(n)},"
            + ("1 0 1,0 0 1,0 0 0 1" if letter == "p" and n % 2 else FAILED)
            for n in range(1, num_rows + 1)
        ]
        (folder / f"1_1_1_{letter}.csv").write_text("\n".join(rows) + "\n")
    return str(folder)


def test_published_outcomes_stand_beside_the_plans_of_the_same_serves(tmp_path, no_report):
    serves, out = trial_files(tmp_path / "serves"), tmp_path / "run"
    manifest = start_sweep(TASK, HitSettings(serves=serves), out, progress=False)
    rows = columns(out)
    assert rows["published_bat"].tolist() == [True, False, True]
    assert rows["published_juggle"].tolist() == [False] * 3
    assert rows["published_bat_lite"].tolist() == [None] * 3
    assert rows["file"].tolist() == ["1_1_1_b.csv"] * 3 and rows["line"].tolist() == [1, 2, 3]
    published = manifest["summary"]["per_scenario"]["NNN"]["published_on_these_serves"]
    assert published == pytest.approx({"bat": 2 / 3, "juggle": 0.0})
    table = HitSweep(TASK).table(manifest)
    assert table.header[-1] == "bat, same serves %"
    assert any('"Same serves"' in line for line in HitSweep(TASK).remarks(manifest))
    assert table.rows[0][-1] == "66.7" and table.rows[1][-1] == "" and table.rows[-1][-1] == "66.67"


def test_a_single_chunk_is_timed_warm_too(tmp_path, no_report, monkeypatch):
    monkeypatch.setattr(HitSweep, "planner", lambda *_: pj.hit.planner("juggle", nodes=5))
    serves = trial_files(tmp_path / "serves")
    manifest = start_sweep(TASK, HitSettings(serves=serves), tmp_path / "run", progress=False)
    times = manifest["times"]
    assert times["warm_plans"] == 3 and times["warm_seconds"] < times["first_seconds"]


def test_a_planner_that_compiles_in_every_call_is_timed_too(tmp_path, monkeypatch, no_report):
    def compiling(_, planner, cases):
        jax.jit(lambda x: x + 1.0)(0.0)
        return pj.plan(planner, cases)

    monkeypatch.setattr(HitSweep, "plan", compiling)
    manifest = start_sweep(TASK, HitSettings(num=2), tmp_path / "run", progress=False)
    assert manifest["times"]["warm_plans"] == 2 and manifest["times"]["warm_seconds"] > 0.0


def test_resuming_needs_the_serves_that_the_run_began_with(tmp_path, monkeypatch):
    serves, out = trial_files(tmp_path / "serves"), tmp_path / "run"
    stop_after(monkeypatch, HitSweep, 0)
    with pytest.raises(SweepInterrupted):
        start_sweep(TASK, HitSettings(serves=serves, num=2), out, progress=False)
    trial_files(tmp_path / "serves", num_rows=2)
    with pytest.raises(SweepInterrupted):
        resume_sweep(TASK, out, progress=False)
    for path in (tmp_path / "serves").iterdir():
        path.write_text(path.read_text().replace("7.2", "7.0"))
    with pytest.raises(pj.ArgumentError, match="serves must be the same as when the run started"):
        resume_sweep(TASK, out, progress=False)


def test_the_table_has_all_scenarios_beside_both_published_rates(finished):
    _, manifest = finished
    table = HitSweep(TASK).table(manifest)
    assert [row[0] for row in table.rows] == [*court.SCENARIOS, "all"]
    assert table.header[-2:] == ["bat, paper %", "bat, trial files %"]
    for row in table.rows[:-1]:
        rates = (
            BY_ROW["Yu2023bat", of, f"bat {row[0]}"].value for of in ("Table I", "trial files")
        )
        assert row[-2:] == [f"{rate:.1f}" for rate in rates]
    summary = manifest["summary"]
    assert table.rows[-1][2] == percent(summary["successes"], summary["num"])


def test_a_percentage_is_100_or_0_only_where_it_is_exact():
    assert percent(10**6, 10**6) == "100.00" and percent(0, 10**6) == "0.00"
    assert percent(10**6 - 1, 10**6) == "99.99" and percent(1, 10**6) == "0.01"
    assert percent(1, 3) == "33.33"
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_overlapping_compilations_are_counted_once():
    with CompileClock() as clock:
        record = jax.monitoring.record_event_time_span
        for start, end in ((10.0, 14.0), (11.0, 12.0)):
            record("/jax/core/compile/jaxpr_trace_duration", start, end)
        for start, end in ((13.0, 16.0), (20.0, 21.0)):
            record("/jax/core/compile/backend_compile_duration", start, end)
        record("/jax/elsewhere", 0.0, 100.0)
    record("/jax/core/compile/later", 30.0, 40.0)
    assert clock.seconds == pytest.approx(7.0) and clock.compiled


def test_the_clock_sees_a_compilation_but_no_second_call():
    program = jax.jit(lambda x: jnp.sin(x) + 3.25)
    with CompileClock() as first:
        program(1.0)
    with CompileClock() as second:
        program(2.0)
    assert first.compiled and first.seconds > 0.0
    assert not second.compiled and second.seconds == 0.0


def test_sampled_motion_agrees_with_the_trajectory(float64):
    random = np.random.default_rng(0)
    coeffs, durations = random.normal(size=(3, 8, 3)), np.array([0.5, 0.2, 0.9])
    motion = sample_motion(coeffs.ravel(), durations, 23)
    trajectory = pj.PiecewisePolynomial(jnp.asarray(coeffs), jnp.asarray(durations))
    for order, samples in enumerate((motion.pos, motion.vel, motion.acc, motion.jerk)):
        expected = jax.vmap(lambda t, order=order: pj.evaluate(trajectory, t, order))(motion.time)
        np.testing.assert_allclose(samples[:-1], expected[:-1], rtol=1e-9)
    acc, jerk = jnp.asarray(motion.acc), jnp.asarray(motion.jerk)
    squared = quadrotor.body_rate_squared(acc, jerk, jnp.asarray(9.8))
    np.testing.assert_allclose(body_rate(motion, 9.8) ** 2, squared, rtol=1e-8)
    np.testing.assert_allclose(net_thrust(motion, 9.8), quadrotor.net_thrust(acc, 9.8))


def test_the_truer_model_is_for_the_exact_planner_alone():
    assert HitSettings(drag_after_impact=True).planner_options() == {"drag_after_impact": True}
    with pytest.raises(pj.ArgumentError, match="drag_after_impact must be left out"):
        HitSettings(planner="bat", drag_after_impact=True)


def test_chunks_join_to_the_whole_without_a_seam():
    whole = open_source(HitSettings(num=50, batch=50).of(TASK), batch=1).chunk(0)
    source = open_source(HitSettings(num=50, batch=20).of(TASK), batch=1)
    assert source.num_chunks == 3
    parts = [source.chunk(number) for number in range(3)]
    velocity = np.concatenate([part.origin.velocity for part in parts])
    np.testing.assert_array_equal(velocity, whole.origin.velocity)
    np.testing.assert_array_equal(np.concatenate([p.index for p in parts]), np.arange(50))


@pytest.mark.parametrize("suite", ["S.1", "S.6"])
def test_a_real_scenario_is_served_by_its_own_two(suite):
    source = open_source(HitSettings(suite=suite, num=6).of(TASK), batch=6)
    served = {court.SCENARIOS[place] for place in source.chunk(0).origin.scenario}
    assert served == set(REAL_SCENARIOS[suite])
