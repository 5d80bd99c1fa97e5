"""Sweeps of interceptions: rows that hold a case and its drive, figures, counts."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest
from flax import struct
from jax import Array
from jax.typing import ArrayLike
from sweeps import RunTests, columns

import planner_jax as pj
from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.reach import Lattice
from planner_jax.plane.target import PointState, PolynomialPath
from planner_jax.referee.intercept import referee_intercepts
from planner_jax.robot.car import CarBody, CarLimits
from planner_jax.runs.columns import RefereedBatch
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.source import Chunk
from planner_jax.sweep.intercept.columns import COLUMNS, WAY_POINTS
from planner_jax.sweep.intercept.figures import instants, sample_drive
from planner_jax.sweep.intercept.settings import InterceptSettings
from planner_jax.sweep.intercept.sweep import InterceptSweep
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.searches import Search

TASK = pj.task_named("intercept")
NUM, BATCH = 12, 6
SETTINGS = InterceptSettings(suite="hard", num=NUM, batch=BATCH, seed=0)  # some of these fail


def one_search():
    """Return the planner with one search: one program, shared with test_intercept."""
    return pj.intercept.planner(searches=(Search(12, lattice=Lattice(layers=22)),))


BODY = [field.name for field in dataclasses.fields(CarBody)]
LIMITS = [field.name for field in dataclasses.fields(CarLimits)]


@struct.dataclass
class SampledTarget:
    places: Array  # (M, 2) [m], the first at time 0
    end: Array  # () [s], the time of the last

    def at(self, time: Array) -> PointState:
        num = self.places.shape[0] - 1
        share = jnp.clip(time / self.end * num, 0.0, num)
        k = jnp.clip(share.astype(jnp.int32), 0, num - 1)
        step = self.places[k + 1] - self.places[k]
        share = share - k.astype(share.dtype)
        return PointState(pos=self.places[k] + share * step, vel=step * (num / self.end))


def case_of(row: Row, setting: Entries) -> InterceptCase:
    """Return the case of a row with the manifest's `setting` and a `SampledTarget`."""

    def leaf(value: ArrayLike, *shape: int) -> Array:
        return jnp.asarray(np.reshape(value, shape), jnp.float32)

    due = leaf(row["due_time"])
    still = 0.0 * np.array(row["wall_present"], float)
    return InterceptCase(
        start=leaf(row["start"], 3),
        speed=leaf(row["initial_speed"]),
        curvature=leaf(row["initial_curvature"]),
        target=SampledTarget(places=leaf(row["target_way"], -1, 2), end=due),
        time=due,
        walls=_obstacles(row, "wall", np.repeat(still, 2)),
        movers=_obstacles(row, "mover", row["mover_velocity"]),
        lower=leaf(setting["lower"], 2),
        upper=leaf(setting["upper"], 2),
        body=CarBody(**{name: leaf(setting[f"body_{name}"]) for name in BODY}),
        limits=CarLimits(**{name: leaf(setting[name]) for name in LIMITS}),
        **{n: leaf(row[n]) for n in ("tolerance", "end_heading", "heading_tolerance")},
    )


def _obstacles(row: Row, kind: str, velocity: ArrayLike) -> Obstacles:
    present = np.array(row[f"{kind}_present"], bool)
    corners = np.reshape(row[f"{kind}_corners"], (len(present), -1, 2))
    centre = corners.mean(axis=1, keepdims=True)
    return Obstacles(
        centre=jnp.asarray(centre[:, 0], jnp.float32),
        corners=jnp.asarray(corners - centre, jnp.float32),
        velocity=jnp.asarray(np.reshape(velocity, (-1, 2)), jnp.float32),
        present=jnp.asarray(present),
    )


@pytest.fixture(autouse=True, scope="module")
def quick_planners():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(InterceptSweep, "planner", lambda *_: one_search())
        patch.setattr(InterceptSweep, "other_planners", lambda *_: {"lattice": one_search()})
        yield


@pytest.fixture
def rows(finished):
    return pq.read_table(finished[0] / "plans").to_pylist()


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


def test_the_rows_alone_lead_the_referee_to_the_same_verdict(finished, rows):
    out, manifest = finished
    found = columns(out)
    cases = [case_of(row, manifest["setting"]) for row in rows]
    cases = jax.tree.map(lambda *leaves: np.stack(leaves), *cases)
    plans = SimpleNamespace(**{name: found[name] for name in ("start", "speed", "curvature")})
    plans.time = found["meeting_time"]
    end = cases.target.places[:, -1]
    verdict = referee_intercepts(cases, plans, target_positions=lambda *_: end)
    np.testing.assert_array_equal(verdict.success, found["success"])
    np.testing.assert_array_equal(verdict.failed_limit, found["failed_limit"])
    np.testing.assert_allclose(verdict.miss, found["miss"], atol=1e-5)
    np.testing.assert_allclose(verdict.mover_clearance, found["mover_clearance"], atol=1e-5)


def test_a_row_s_drive_ends_where_the_referee_sees_it(finished, rows):
    setting = finished[1]["setting"]
    for row in rows:
        drive = sample_drive(row, setting, 41)
        away = np.linalg.norm(drive.middle[-1] - drive.target[-1])
        assert away == pytest.approx(row["miss"], abs=1e-4)
        assert drive.time[-1] == pytest.approx(row["meeting_time"])
        sides = np.diff(drive.footprint(drive.pose[-1]), axis=0)
        lengths = np.linalg.norm(sides, axis=1)
        np.testing.assert_allclose(lengths, [0.4, 0.25, 0.4], rtol=1e-5)
        # The body's middle is the mean of its corners.
        np.testing.assert_allclose(
            drive.footprint(drive.pose[20]).mean(axis=0), drive.middle[20], atol=1e-6
        )


def test_a_case_comes_back_from_its_row(finished, rows):
    drawn = pj.take(pj.intercept.draw(1, "hard", 0, first=7), 0)
    back = case_of(rows[7], finished[1]["setting"])
    for name in ("walls", "movers"):
        own, other = getattr(drawn, name), getattr(back, name)
        there = np.asarray(own.present)
        np.testing.assert_array_equal(there, other.present)
        for time in (0.0, 10.0):
            np.testing.assert_allclose(
                own.vertices(time)[there], other.vertices(time)[there], atol=1e-5
            )
    own, other = (jax.jit(case.target.at)(jnp.float32(4.3)) for case in (drawn, back))
    np.testing.assert_allclose(own.pos, other.pos, atol=1e-3)
    np.testing.assert_allclose(own.vel, other.vel, atol=1e-2)


def test_a_target_of_another_class_has_a_way_and_no_leaves():
    coeffs = jnp.array([[[1.0, 2.0], [0.5, 0.0], [0.0, 0.1]]])
    case = pj.intercept.case(PolynomialPath(coeffs, jnp.zeros(1)), np.full(1, 4.0))
    batch = RefereedBatch(Chunk(np.arange(1), case), None, None)
    of_target = {c.name: c.values(batch) for c in COLUMNS if c.name.startswith("target_")}
    assert of_target.pop("target_way").shape == (1, WAY_POINTS, 2)
    assert list(of_target.values()) == [None, None, None]


@pytest.mark.parametrize(
    ("end", "expected"),
    [(10.0, [0, 2, 4, 6, 8, 10]), (3.7, [0, 1, 2, 3]), (0.0, [0]), (0.3, [0, 0.1, 0.2, 0.3])],
)
def test_instants_are_few_and_round(end, expected):
    np.testing.assert_allclose(instants(end, 6), expected, atol=1e-9)
