"""The nonlinear program of interceptions that IPOPT solves, beside the planner's own terms."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.benchmarks import intercept_nlp
from planner_jax.core.missing_extra import install_line
from planner_jax.referee.clearance import edges, separation
from planner_jax.task.intercept.plan import make_plan

PIECES = 6
needs_casadi = pytest.mark.skipif(
    importlib.util.find_spec("casadi") is None, reason=f"no casadi: {install_line('oracle')}"
)


def make_lane(*walls):
    target = pj.TurningPath(jnp.array([4.0, 1.0]), jnp.zeros(2), jnp.zeros(()))
    case = pj.intercept.case(target, 6.0, start=(0.5, 1.0, 0.2), walls=walls, curvature=3.0)
    return jax.tree.map(np.asarray, case)


@pytest.fixture(scope="module")
def program():
    return intercept_nlp.Program(PIECES, 2)


def make_motion(lane, seed=0):
    random = np.random.default_rng(seed)
    speed, curvature = random.uniform(0.2, 1.0, PIECES + 1), random.uniform(-1, 1, PIECES + 1)
    speed[0], curvature[0] = 0.5, 0.0
    with jax.enable_x64(True):
        double = jax.tree.map(lambda x: jnp.asarray(x, float), lane)
        motion = jnp.asarray(speed), jnp.asarray(curvature)
        settings = {"samples": 3, "points": 4, "steps": jnp.zeros((), jnp.int32)}
        plan = make_plan(double, jnp.asarray(6.0), *motion, **settings)
        return jax.tree.map(np.asarray, plan)


def test_without_casadi_it_ends_with_the_line_that_installs_it(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    monkeypatch.setattr("sys.argv", ["intercept_nlp"])
    with pytest.raises(SystemExit) as ended:
        intercept_nlp.main()
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said == f"benchmarks.intercept_nlp needs casadi: {install_line('oracle')}\n"


@needs_casadi
@pytest.mark.parametrize("seed", range(3))
def test_the_cost_is_the_discomfort_of_the_plan(program, seed):
    lane = make_lane()
    plan = make_motion(lane, seed)
    assert program.cost(lane, plan) == pytest.approx(float(plan.cost), rel=1e-9)


@needs_casadi
def test_the_poses_are_those_of_the_plan(program):
    lane = make_lane()
    plan = make_motion(lane)
    knots = program.knots(lane, plan)
    sampled = pj.intercept.InterceptPlan(**vars(plan)).sample(PIECES / 6.0)
    assert knots[:2].T == pytest.approx(np.asarray(sampled.pos, float), abs=1e-5)


@needs_casadi
@pytest.mark.parametrize("seed", range(20))
def test_the_gap_is_at_most_the_distance_and_the_error_of_the_soft_maximum(program, seed):
    random = np.random.default_rng(seed)
    angles = random.uniform(0.0, 0.8, 5) + 1.25 * np.arange(5)
    corners = 0.4 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    lane = make_lane(corners + (2.0, 1.0))
    pose = np.append((2.0, 1.0) + random.uniform(-0.8, 0.8, 2), random.uniform(-3, 3))
    entries = intercept_nlp.read_obstacles(lane, 2)
    numbers = intercept_nlp.read_numbers(lane)
    found = float(program.gap(pose, 0.0, entries[:, 0], numbers))
    vertices = np.asarray(lane.walls.vertices(0.0), float)[:1]
    ahead = np.array([np.cos(pose[2]), np.sin(pose[2])])
    middle = np.append(pose[:2] + float(lane.body.middle) * ahead, pose[2])[None]
    half = 0.5 * np.array([[lane.body.length, lane.body.width]], float)
    exact = separation(vertices, edges(vertices)[0], middle, half)[0]
    error = np.log(10) / intercept_nlp.SHARPNESS
    assert found <= exact + error
    if exact < 0.0:  # the depth of an overlap is the greatest gap
        assert found == pytest.approx(exact, abs=error + 1e-3)
    assert float(program.gap(pose, 0.0, entries[:, 1], numbers)) > 100.0  # absent


@needs_casadi
def test_ipopt_drives_round_a_wall_at_less_cost_than_any_worse_plan(program):
    lane = make_lane(np.array([(2.0, 0.9), (2.4, 0.9), (2.4, 1.6), (2.0, 1.6)]))
    plan, _ = program.solve(lane, make_motion(lane))
    again, _ = program.solve(lane, plan)
    assert program.cost(lane, again) == pytest.approx(program.cost(lane, plan), rel=1e-2)
    verdict = pj.intercept.judge(lane, plan)
    assert float(verdict.wall_clearance) > -0.02 and float(verdict.miss) <= 0.0501
