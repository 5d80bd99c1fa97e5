"""Runs that plan and judge many interceptions: stored cases and plans, figures, counts."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest
from closed_forms import positions_on
from referees import tree
from sweeps import RunTests, columns

import planner_jax as pj
from planner_jax.planning.plan import plan
from planner_jax.referee.intercept import referee_intercepts
from planner_jax.robot.car import CarBody, CarLimits
from planner_jax.runs.columns import RefereedBatch
from planner_jax.runs.source import Chunk
from planner_jax.sweep.intercept.columns import COLUMNS, WAY_POINTS
from planner_jax.sweep.intercept.figures import sample_drive
from planner_jax.sweep.intercept.settings import InterceptSettings
from planner_jax.sweep.intercept.sweep import InterceptSweep
from planner_jax.task.intercept.drawing import instants
from tests.planners import ONE_SEARCH, with_room

TASK = pj.task_named("intercept")
NUM, BATCH = 12, 6
SETTINGS = InterceptSettings(suite="hard", num=NUM, batch=BATCH, seed=0)  # some of these fail


BODY = [field.name for field in dataclasses.fields(CarBody)]
LIMITS = [field.name for field in dataclasses.fields(CarLimits) if field.name != "jerk"]


def leaves_of(found, setting):
    due = found["due_time"]
    leaves = {"time": due, "speed": found["initial_speed"], "curvature": found["initial_curvature"]}
    names = ("start", "tolerance", "end_heading", "heading_tolerance", "earliest", "margin")
    leaves |= {name: found[name] for name in (*names, "map_heading", "origin")}
    leaves |= {"end_speed": found["end_speed_range"], "region": found["region"].reshape(NUM, -1, 2)}
    constants = {f"body.{name}": setting[f"body_{name}"] for name in BODY}
    constants |= {f"limits.{name}": setting[name] for name in LIMITS}
    constants |= {name: setting[name] for name in ("lower", "upper")} | {"limits.jerk": np.inf}
    leaves |= {name: np.broadcast_to(x, (NUM, *np.shape(x))) for name, x in constants.items()}
    for kind in ("wall", "mover"):
        present = found[f"{kind}_present"]
        corners = found[f"{kind}_corners"].reshape(*present.shape, -1, 2)
        centre = corners.mean(axis=2)
        group = {"centre": centre, "corners": corners - centre[:, :, None], "present": present}
        speeds = found["mover_velocity"].reshape(centre.shape) if kind == "mover" else 0.0 * centre
        group |= {"velocity": speeds, "radius": found[f"{kind}_radius"]}
        group |= {"growth": found[f"{kind}_growth"]}
        leaves |= {f"{kind}s.{name}": leaf for name, leaf in group.items()}
    plan = {name: found[name] for name in ("start", "speed", "curvature", "origin")}
    plan["time"] = found["meeting_time"]
    return leaves | {f"plan.{name}": leaf for name, leaf in plan.items()}


@pytest.fixture(autouse=True, scope="module")
def quick_planners():
    planner = pj.intercept.planner(searches=ONE_SEARCH)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(InterceptSweep, "planner", lambda *_: planner)
        patch.setattr(InterceptSweep, "other_planners", lambda *_: {"lattice": planner})
        patch.setattr(InterceptSweep, "plan", lambda _, *given: plan(given[0], with_room(given[1])))
        yield


class TestRun(RunTests):
    sweep = InterceptSweep(TASK)
    figures = ("plane.png", "motion.png", "outcomes.png")
    other = "lattice"
    not_finite = ("meeting_time", "failed_time", "miss", "mover_clearance")
    lists = ("speed", "curvature")


def test_the_summary_has_means_over_the_successes(finished):
    found, summary = columns(finished[0]), finished[1]["summary"]
    good = found["success"].astype(bool)
    for name in ("meeting_time", "miss", "rms_acceleration"):
        assert summary[f"mean_{name}"] == pytest.approx(found[name][good].mean(), rel=1e-5)


def test_the_example_is_a_success_near_a_mover_if_there_is_one(finished):
    out, manifest = finished
    found = columns(out)
    near = found["success"].astype(bool) & (found["mover_clearance"] < 0.1)
    assert near.any() and manifest["example"] == np.flatnonzero(near)[0]


def test_the_rows_alone_lead_the_referee_to_the_same_verdict(finished):
    out, manifest = finished
    found = columns(out)
    case = tree(leaves_of(found, manifest["setting"]), target=None)
    case.movers.track = None
    end = found["target_way"].reshape(NUM, -1, 2)[:, -1]
    verdict = referee_intercepts(case, case.plan, target_positions=lambda *_: end)
    np.testing.assert_array_equal(verdict.success, found["success"])
    np.testing.assert_array_equal(verdict.failed_limit, found["failed_limit"])
    np.testing.assert_allclose(verdict.miss, found["miss"], atol=1e-5)
    np.testing.assert_allclose(verdict.mover_clearance, found["mover_clearance"], atol=1e-5)


def test_a_row_s_drive_ends_where_the_referee_sees_it(finished):
    setting = finished[1]["setting"]
    for row in pq.read_table(finished[0] / "plans").to_pylist():
        drive = sample_drive(row, setting, 41)
        away = np.linalg.norm(drive.middle[-1] - drive.target_at(drive.time[-1]))
        assert away == pytest.approx(row["miss"], abs=1e-4)
        assert drive.time[-1] == pytest.approx(row["meeting_time"])
        sides = np.diff(drive.footprint(drive.pose[-1]), axis=0)
        lengths = np.linalg.norm(sides, axis=1)
        np.testing.assert_allclose(lengths, [0.4, 0.25, 0.4], rtol=1e-5)
        mean = drive.footprint(drive.pose[20]).mean(axis=0)
        np.testing.assert_allclose(mean, drive.middle[20], atol=1e-6)


def test_a_case_comes_back_from_its_row(finished):
    out, manifest = finished
    drawn, found = pj.intercept.draw(NUM, "hard", 0), columns(out)
    back = tree(leaves_of(found, manifest["setting"]))
    for own, other in ((drawn.walls, back.walls), (drawn.movers, back.movers)):
        there = np.asarray(own.present)
        np.testing.assert_array_equal(there, other.present)
        np.testing.assert_array_equal(own.velocity, other.velocity)
        ours, theirs = (each.centre[:, :, None] + each.corners for each in (own, other))
        np.testing.assert_allclose(ours[there], theirs[there], atol=1e-5)
    times = np.linspace(0.0, found["due_time"], WAY_POINTS, axis=1)
    way = found["target_way"].reshape(NUM, WAY_POINTS, 2)
    np.testing.assert_allclose(positions_on(drawn.target, times), way, atol=1e-4)


def test_a_target_of_another_class_has_a_way_and_no_leaves():
    coeffs = jnp.array([[[1.0, 2.0], [0.5, 0.0], [0.0, 0.1]]])
    case = pj.intercept.case(pj.PolynomialPath(coeffs, jnp.zeros(1)), np.full(1, 4.0))
    batch = RefereedBatch(Chunk(np.arange(1), case), None, None)
    of_target = {c.name: c.values(batch) for c in COLUMNS if c.name.startswith("target_")}
    assert np.asarray(of_target.pop("target_way")).shape == (1, WAY_POINTS, 2)
    assert list(of_target.values()) == [None, None, None]


@pytest.mark.parametrize(
    ("end", "expected"),
    [(10.0, [0, 2, 4, 6, 8, 10]), (3.7, [0, 1, 2, 3]), (0.0, [0]), (0.3, [0, 0.1, 0.2, 0.3])],
)
def test_instants_are_few_and_round(end, expected):
    np.testing.assert_allclose(instants(end, 6), expected, atol=1e-9)
