"""Interceptions: the car's way, the planner, what it says of cases that cannot be solved."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.plane.reach import Lattice
from planner_jax.robot.car import pose_at
from planner_jax.task.intercept.motion import motion
from planner_jax.task.intercept.spacetime import Search
from planner_jax.task.intercept.terms import Weights, limit_rows, meeting_rows, obstacle_terms

# One search is one program to compile.
PLANNER = pj.intercept.planner(searches=(Search(12),), lattice=Lattice(layers=22))
START = np.array([0.8, 4.0, 0.3])


@pytest.fixture
def way():
    rng = np.random.default_rng(0)
    return rng.uniform(0.2, 1.5, 9), rng.uniform(-2.0, 2.0, 9)


def test_the_way_is_that_of_the_car_and_its_slopes_are_those_of_tangents(way, float64):
    speed, curvature = map(jnp.asarray, way)
    num = len(speed) - 1

    def at(point):
        v, c = jnp.split(point, 2)
        return motion(
            jnp.asarray(START), 4.0, jnp.append(speed[:1], v), jnp.append(curvature[:1], c), 5
        )

    point = jnp.append(speed[1:], curvature[1:])
    found, (by_pos, by_heading) = jax.jit(
        lambda x: (at(x), jax.jacfwd(lambda x: (at(x).pos, at(x).heading))(x))
    )(point)
    times = jnp.linspace(0.0, 4.0, 5 * num + 1)[1:]
    poses = jax.vmap(lambda t: pose_at(jnp.asarray(START), 4.0, speed, curvature, t))(times)
    np.testing.assert_allclose(found.pos, poses[:, :2], atol=2e-5)
    np.testing.assert_allclose(found.heading, poses[:, 2], atol=1e-12)
    np.testing.assert_allclose(found.pos_slope, by_pos, atol=1e-12)
    np.testing.assert_allclose(found.heading_slope, by_heading, atol=1e-12)


def test_a_pose_is_the_integral_of_the_car_s_kinematics(way, float64):
    speed, curvature = way
    num = 40000
    time = (np.arange(num) + 0.5) / num * 2.3
    knots = np.linspace(0.0, 4.0, 9)
    v, rate = np.interp(time, knots, speed), np.interp(time, knots, speed * 0.0 + 1.0)
    turn = v * np.interp(time, knots, curvature) * rate * 2.3 / num
    heading = START[2] + np.cumsum(turn) - 0.5 * turn
    step = v * 2.3 / num
    expected = START + [np.sum(step * np.cos(heading)), np.sum(step * np.sin(heading)), turn.sum()]
    found = pose_at(jnp.asarray(START), 4.0, jnp.asarray(speed), jnp.asarray(curvature), 2.3)
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_rows_of_limits_and_of_the_meeting_have_the_slopes_of_finite_differences(way, float64):
    case = jax.tree.map(
        lambda leaf: jnp.asarray(leaf[0], jnp.float64 if leaf.dtype != bool else bool),
        pj.intercept.draw(1, "hard", 5),
    )
    case = dataclasses.replace(case, end_heading=jnp.array(2.0), heading_tolerance=jnp.array(0.1))
    weights = Weights()

    @jax.jit
    def residuals(point):
        speed, curvature = (
            jnp.append(first, rest)
            for first, rest in zip((case.speed, case.curvature), jnp.split(point, 2), strict=True)
        )
        rows, values, _ = limit_rows(case, case.time, speed, curvature, weights, 0.015, 4)
        drive = motion(case.start, case.time, speed, curvature, 4)
        goal = case.target.at(case.time).pos
        end_rows, end_values, _ = meeting_rows(case, drive, goal, weights)
        push, _, cost, _ = obstacle_terms(case, drive, case.time, weights, 0.02)
        slopes = jnp.concatenate([drive.pos_slope, drive.heading_slope[:, None]], axis=1)
        gradient = jnp.einsum("ma,man->n", push, slopes, precision="highest")
        rows, values = jnp.concatenate([rows, end_rows]), jnp.concatenate([values, end_values])
        return values, rows, cost, 2.0 * gradient

    point = jnp.asarray(1.2 * np.concatenate([each[1:] for each in way]))
    values, rows, cost, gradient = residuals(point)
    assert (np.abs(values) > 0.0).sum() > 20 and cost > 0.0
    differences, slopes = [], []
    for k in range(point.size):
        step = 1e-6 * jnp.eye(point.size)[k]
        (after, _, high, _), (before, _, low, _) = residuals(point + step), residuals(point - step)
        differences.append((after - before) / 2e-6)
        slopes.append((high - low) / 2e-6)
    np.testing.assert_allclose(rows.T, differences, atol=1e-4)
    np.testing.assert_allclose(gradient, slopes, rtol=1e-4, atol=1e-3 * np.abs(gradient).max())


@pytest.fixture(scope="module")
def planned():
    cases = jax.tree.map(np.asarray, pj.intercept.draw(12, "hard", 7))
    return cases, pj.plan(PLANNER, cases)


def test_what_the_planner_claims_the_referee_confirms(planned):
    cases, plans = planned
    verdict = pj.intercept.judge(cases, plans)
    solved = pj.solved(plans)
    assert solved.sum() >= 10
    np.testing.assert_array_equal(verdict.success, solved)
    assert verdict.miss[solved].max() <= 0.05
    assert "target" in verdict.sentence(int(np.argmax(solved)))


def test_a_plan_is_sampled_at_a_rate_up_to_its_end(planned):
    cases, plans = planned
    k = int(np.argmax(pj.solved(plans)))
    one = pj.lane(plans, k).sample(50.0)
    assert one.time.shape == (501,) and one.pos.shape == (501, 2)
    np.testing.assert_allclose(one.pos[0], cases.start[k, :2], atol=1e-5)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(one.pos, axis=0), axis=1) * 50.0,
        0.5 * (one.speed[1:] + one.speed[:-1]),
        atol=0.02,
    )
    np.testing.assert_allclose(one.yaw_rate, one.speed * one.curvature, atol=1e-5)
    middle = one.pos[-1] + 0.15 * np.array([np.cos(one.heading[-1]), np.sin(one.heading[-1])])
    assert np.linalg.norm(middle - plans.meeting[k]) <= 0.05
    batch = plans.sample(10.0)
    assert batch.pos.shape == (12, 101, 2)
    with pytest.raises(ValueError, match="rate must be > 0"):
        plans.sample(0.0)


def still(x, y):
    return pj.TurningPath(jnp.array([x, y]), jnp.zeros(2), jnp.array(0.0))


WALL = [[3.9, -0.5], [4.1, -0.5], [4.1, 8.5], [3.9, 8.5]]
AIDE = {"movers": pj.obstacles([], room=(4, 6))}


def scene(target, walls=(), **settings):
    """A case with the room of drawn ones, so that they share a program."""
    return pj.intercept.case(
        still(*target), walls=pj.obstacles(walls, room=(12, 6)), **AIDE, **settings
    )


SCENES = {
    "a wall across": (scene((6.0, 4.0), [WALL]), pj.Status.NO_PATH),
    "start in a wall": (scene((6.0, 4.0), [WALL], start=(3.85, 4.0, 0.0)), pj.Status.BLOCKED),
    "goal in a wall": (scene((4.0, 4.0), [WALL]), pj.Status.BLOCKED),
    "off the map": (scene((8.5, 4.0)), pj.Status.BLOCKED),
    "too far for the time": (scene((7.8, 4.0), time=3.0), pj.Status.NO_PATH),
    "NaN": (scene((np.nan, 4.0)), pj.Status.NON_FINITE),
    "north": (scene((5.0, 5.0), end_heading=0.5 * np.pi), pj.Status.CONVERGED),
    "west": (scene((5.0, 5.0), end_heading=np.pi), pj.Status.CONVERGED),
    "at rest": (scene((5.0, 5.0), initial_speed=0.0), pj.Status.CONVERGED),
    "faster": (scene((5.0, 5.0), initial_speed=1.3, start=(0.8, 1.0, 1.2)), pj.Status.CONVERGED),
}


@pytest.fixture(scope="module")
def scenes():
    cases = [jax.tree.map(np.asarray, case) for case, _ in SCENES.values()]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *cases)
    return batch, pj.plan(PLANNER, batch)


@pytest.mark.parametrize("name", SCENES)
def test_a_case_that_cannot_be_solved_says_why_and_others_are_solved(scenes, name):
    k, status = list(SCENES).index(name), SCENES[name][1]
    case, plan = pj.lane(scenes, k)
    assert plan.status == status
    assert pj.Status(plan.status).message
    verdict = pj.intercept.judge(case, plan)
    assert verdict.success == (status == pj.Status.CONVERGED), verdict.sentence()


@pytest.mark.parametrize("name, heading", [("north", 0.5 * np.pi), ("west", np.pi)])
def test_a_given_heading_is_kept_at_the_meeting(scenes, name, heading):
    plan = pj.lane(scenes[1], list(SCENES).index(name))
    off = plan.sample(10.0).heading[-1] - heading
    assert abs(np.angle(np.exp(1j * off))) <= 0.051


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"time": 0.0}, "time must be > 0"),
        ({"curvature": -1.0}, "curvature must be > 0"),
        ({"time": np.ones(3)}, r"target must have leaves that begin with the batch shape \(3,\)"),
    ],
)
def test_bad_input_is_refused_in_one_line(settings, message):
    with pytest.raises(ValueError, match=message) as caught:
        pj.intercept.case(still(5.0, 5.0), **settings)
    assert "\n" not in str(caught.value)
