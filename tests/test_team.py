"""Teams of robots: cases, assignment, moving keep-outs, the referee, and plans."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.errors import CaseError
from planner_jax.cost.along import Along
from planner_jax.cost.moving import MovingKeepOut, integrate
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.team.decide import assign
from planner_jax.task.team.plan import TeamPlan
from planner_jax.task.team.spec import SUITES
from planner_jax.trajectory.proportional_minco import proportional_minco
from tests.trees import assert_same

REST_TO_REST = np.array([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])  # of the path's fraction
# A planner that compiles one program, and its recovery.
QUICK = {"attempts": (Attempt(1, LbfgsConfig(max_steps=60)),)}
NET = 0.3  # [m], height of the net in `hanging`


def hanging(points, starts, **settings):
    """Return one team case with targets that stand still in the air at points (M, 3)."""
    pos = np.asarray(points, np.float32)
    ball = pj.BallState(pos=jnp.asarray(pos), vel=jnp.zeros(pos.shape))
    targets = pj.BallPath(ball, jnp.zeros(pos.shape), jnp.zeros(len(pos)))
    return pj.team.case(targets, np.full(len(pos), 6.0), starts, net_height=NET, **settings)


def straight(case, ends, targets, lasting=(3.0, 3.0)):
    """Return the plan in which robot k flies straight to `ends[k]`, at the target `targets[k]`."""
    duration = np.array(lasting)[:, None]
    starts, size = np.asarray(case.head_states)[:, 0], case.shared.num_targets
    steps = (np.asarray(ends) - starts)[:, None] * REST_TO_REST[:, None]
    coeffs = steps * (duration ** -np.arange(8.0))[..., None]
    coeffs[:, 0] += starts
    still = np.zeros((len(starts), size, 8, 3))
    still[:, :, 0] = np.asarray(ends)[:, None]
    still[:, 0] = coeffs
    durations = np.zeros((len(starts), size))
    durations[:, :1] = duration
    order = [[k, *(j for j in range(size) if j != k)] for k in targets]
    times = np.tile(duration, size)
    num = np.zeros(len(starts))
    outcome = {"cost": num, "violation": num, "iterations": num, "status": num.astype(int)}
    robots = CatchPlan(
        **outcome,
        trajectory=pj.PiecewisePolynomial(still, durations),
        gravity=num + 9.81,
        order=np.array(order),
        decided_times=times,
        times=times,
    )
    return TeamPlan(**{name: leaf[0] for name, leaf in outcome.items()}, robots=robots)


def crossing(height, **settings):
    """Return a case and its plan: two robots cross at right angles, `height` [m] apart."""
    points = np.array([[1.5, 0.0, 2.0], [0.0, 1.5, 2.0 + height]])
    starts = points * [-1.0, -1.0, 1.0]
    case = hanging(points + [0.0, 0.0, NET], starts, **settings)
    return case, straight(case, points, (0, 1))


@pytest.mark.parametrize("height, accepted", [(0.8, False), (1.2, True)])
def test_referee_measures_the_least_distance_of_crossing_robots(height, accepted):
    verdict = pj.team.judge(*crossing(height))
    assert verdict.success == accepted
    assert verdict.least_distance == pytest.approx(height, rel=1e-5)
    assert verdict.num_caught == 2
    assert verdict.sentence().startswith("success: 2 caught" if accepted else "distance: robots 0")


def test_a_robot_stays_where_its_trajectory_ends():
    # The second robot flies through the position at which the first one has stood for 2 s.
    ends = np.array([[0.0, 0.0, 2.0], [0.0, 2.0, 2.0]])
    case = hanging(ends + [0.0, 0.0, NET], [[-1.0, 0.0, 2.0], [0.0, -3.0, 2.0]])
    plan = straight(case, ends, (0, 1), [2.0, 6.0])
    verdict = pj.team.judge(case, plan)
    assert verdict.failed_limit == "distance" and verdict.least_distance < 1e-4
    assert 3.0 < verdict.failed_time < 4.0


def test_referee_rejects_a_target_that_is_caught_twice():
    case = hanging([[0.0, 0.0, 2.0 + NET], [5.0, 0.0, 2.0]], [[-2.0, 0.0, 2.0], [2.0, 0.0, 2.0]])
    plan = straight(case, np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 2.0]]), (0, 0))
    # The robots also end at one position; the referee names the first broken rule.
    sentence = pj.team.judge(case, plan).sentence()
    assert sentence == "twice: 1 targets are caught by more than one robot"


def test_referee_names_the_robot_whose_plan_fails():
    case, plan = crossing(1.2)
    case = dataclasses.replace(
        case, head_states=case.head_states + jnp.asarray([[[[0.0]]], [[[0.5]]]])[:, 0]
    )
    verdict = pj.team.judge(case, plan)
    assert verdict.robot == 1 and verdict.sentence().startswith("head state: robot 1: ")


def test_referee_rejects_numbers_that_are_not_finite():
    case, plan = crossing(1.2)
    coeffs = np.array(plan.robots.trajectory.coeffs)
    coeffs[1] = np.nan
    path = dataclasses.replace(plan.robots.trajectory, coeffs=coeffs)
    broken = plan.replace(robots=plan.robots.replace(trajectory=path))
    verdict = pj.team.judge(case, broken)
    assert not verdict.success and verdict.sentence().startswith("not finite: robot 1: ")


def test_case_rejects_robots_that_start_too_near():
    with pytest.raises(CaseError, match=r"starts must be of robots least_distance apart"):
        hanging([[0.0, 0.0, 2.0]], [[0.0, 0.0, 1.0], [0.5, 0.0, 1.0]])


def test_case_far_from_the_origin_is_moved():
    far = np.array([4.0e5, 5.0e6, 0.0])
    points, starts = np.array([[0.0, 0.0, 2.0]]), np.array([[-2.0, 0.0, 1.0], [2.0, 0.0, 1.0]])
    near = hanging(points, starts)
    pos = points + far
    ball = pj.BallState(pos=pos, vel=np.zeros((1, 3)))
    targets = pj.BallPath(ball, np.zeros((1, 3)), np.zeros(1))
    moved = pj.team.case(targets, np.full(1, 6.0), starts + far, net_height=NET)
    np.testing.assert_allclose(moved.head_states, near.head_states, atol=1e-6)
    np.testing.assert_allclose(moved.shared.origin, far[:2])


@pytest.mark.parametrize("suite", SUITES)
def test_suites_share_the_targets_of_catches(suite):
    cases = pj.team.draw(3, suite, seed=5, first=2)
    catches = pj.catch.draw(3, SUITES[suite][0], seed=5, first=2)
    assert_same(cases.shared.replace(head_state=catches.head_state), catches)
    assert cases.num_robots == SUITES[suite][1]
    assert_same(pj.take(cases, 1), pj.take(pj.team.draw(1, suite, seed=5, first=3), 0))


def test_moving_keep_out_is_a_sphere_around_the_path():
    ball = pj.BallState(pos=jnp.zeros(3), vel=jnp.array([1.0, 0.0, 0.0]))
    path = pj.BallPath(ball, jnp.zeros(3), jnp.zeros(()))
    keep_out = MovingKeepOut(path, jnp.asarray(2.0), jnp.asarray(0.5), jnp.asarray(3.0))
    times = jnp.asarray([0.0, 1.0])
    pos = jnp.asarray([[0.5, 1.0, 0.0], [1.5, 0.0, 4.0]])
    np.testing.assert_allclose(keep_out.excess_at(times, pos), [0.5, -1.0], atol=1e-6)
    later = keep_out.later(jnp.asarray(1.0))
    np.testing.assert_allclose(later.excess_at(times - 1.0, pos), [0.5, -1.0], atol=1e-6)


def test_penalty_for_moving_keep_outs_has_exact_slopes(float64):
    random = np.random.default_rng(0)
    maps = proportional_minco(4, (1.0, 2.0))
    along = Along(maps, 4, None, (0.03,), 0.1)
    ball = pj.BallState(pos=jnp.zeros(3), vel=jnp.array([0.3, 0.1, 0.0]))
    path = pj.BallPath(ball, jnp.zeros(3), jnp.zeros(()))
    keep_out = MovingKeepOut(path, *map(jnp.asarray, (1.5, 0.2, 9.0)))
    columns = jnp.asarray(random.normal(0.0, 0.5, (2, maps.waypoints.shape[1], 3)))
    durations = jnp.asarray([0.4, 0.3])

    @jax.jit
    def penalty(columns, durations):
        return integrate((keep_out,), along, columns, durations, True, ())[0].sum()

    slopes = jax.grad(penalty, (0, 1))(columns, durations)
    change = random.normal(size=columns.shape), random.normal(size=2)
    expected = sum((a * b).sum() for a, b in zip(slopes, change, strict=True))
    ahead, behind = (
        penalty(columns + step * change[0], durations + step * change[1]) for step in (1e-6, -1e-6)
    )
    assert float(ahead - behind) / 2e-6 == pytest.approx(float(expected), rel=1e-6)
    assert abs(float(expected)) > 1e-3


@pytest.mark.slow
def test_assignment_catches_as_many_as_all_divisions():
    # Each robot can reach the four targets next to it, and none of the four of the other robot.
    near = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 1.0, 2.0], [1.0, 1.0, 2.0]])
    points = np.concatenate([near, near + [40.0, 0.0, 0.0]])
    case = hanging(points, [[-1.0, 0.0, 1.0], [39.0, 0.0, 1.0]])
    cases = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], case)
    choices = assign(cases, 16, jnp.array([1.0, 1.5]))
    each = np.kron(np.eye(2, dtype=bool), np.ones(4, bool))
    np.testing.assert_array_equal(choices.taken, np.tile(each, (1, 2, 1, 1)))
    catches = choices.times[0, :, :, 3]  # of the last catch; faster robots are earlier
    assert (catches[1] < catches[0]).all()


@pytest.mark.slow
def test_one_robot_equals_the_catch_task():
    cases = jax.tree.map(np.asarray, pj.team.draw(3, "team2-swarm12", seed=8))
    alone = cases.replace(head_states=cases.head_states[:, :1])
    team = pj.plan(pj.team.planner(decide="greedy", **QUICK), alone)
    by_catch = pj.catch.planner(decide="greedy", recovery="brake", **QUICK)
    catches = pj.plan(by_catch, alone.of_robot(0))
    assert_same(jax.tree.map(lambda leaf: leaf[:, 0], team.robots), catches)
    catch_verdict, verdict = pj.catch.judge(alone.of_robot(0), catches), pj.team.judge(alone, team)
    np.testing.assert_array_equal(verdict.success, catch_verdict.success)


@pytest.mark.slow
def test_plan_and_recovery_stay_out_of_a_moving_keep_out():
    case, _ = crossing(0.0)
    middle, vel = np.array([0.0, -0.3, 2.0]), np.array([0.0, 0.5, 0.0])
    ball = pj.BallState(pos=middle.astype(np.float32), vel=vel.astype(np.float32))
    path = pj.BallPath(ball, np.zeros(3, np.float32), np.float32(0.0))
    keep_out = MovingKeepOut(path, *map(np.float32, (1.0, 0.0, 10.0)))
    planner = pj.catch.planner(decide="greedy", recovery="brake", **QUICK)
    nearest = []
    for extras in ((), (keep_out,)):
        alone = case.of_robot(0, present=np.array([True, False]), extras=extras)
        found = pj.plan(planner, jax.tree.map(lambda leaf: np.asarray(leaf)[None], alone))
        assert pj.are_solved(found).all() and found.num_taken[0] == 1
        whole = jax.tree.map(jnp.asarray, pj.take(found.whole, 0))
        times = np.linspace(0.0, float(whole.durations.sum()), 2001)
        pos = np.asarray(jax.vmap(lambda time, path=whole: pj.evaluate(path, time))(times))
        nearest.append(np.linalg.norm(pos - middle - vel * times[:, None], axis=1).min())
    assert nearest[0] < 0.7 and nearest[1] >= 0.999


@pytest.mark.slow
def test_team_plans_are_accepted_and_catch_more_than_one_robot():
    cases = jax.tree.map(np.asarray, pj.team.draw(2, "team2-swarm12", seed=9))
    plans = pj.plan(pj.team.planner(decide="greedy", turns=1, **QUICK), cases)
    verdict = pj.team.judge(cases, plans)
    assert verdict.success.all()
    assert (verdict.num_caught >= plans.robots.num_taken.max(axis=1) + 1).all()
    np.testing.assert_array_equal(verdict.num_caught, plans.num_taken)


@pytest.mark.slow
def test_one_robot_catches_two_targets_that_are_too_near_for_two_robots():
    # Each robot is nearest to a target of its own, and the targets are nearer than the distance.
    case = hanging([[-0.3, 0.0, 2.0], [0.3, 0.0, 2.0]], [[-2.0, 0.0, 1.0], [2.0, 0.0, 1.0]])
    case = dataclasses.replace(case, least_distance=jnp.float32(1.5))
    plan = pj.plan(pj.team.planner(decide="greedy", **QUICK), case)
    verdict = pj.team.judge(case, plan)
    assert verdict.success, verdict.sentence()
    assert verdict.num_caught == 2 and sorted(plan.taken.sum(axis=1)) == [0, 2]


def test_teams_are_planned_on_the_host_only():
    with pytest.raises(TypeError, match="ExactTeam works on the host"):
        pj.solve(pj.team.planner(), pj.team.draw(1))
