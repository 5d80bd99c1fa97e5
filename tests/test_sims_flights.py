"""Whole flights in closed loop: plans are executed, and noise is tolerated."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from flax import struct
from test_solve import GOALS, Well, WellProblem

import planner_jax as pj
from planner_jax.core.protocol import Status, is_solved, is_unsolved
from planner_jax.planning.plan import plan
from planner_jax.robot.attitude import yaw_at
from planner_jax.robot.heading import Heading
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.noise import NOISES
from planner_jax.sims.robots.quadrotor.robot import Quadrotor
from planner_jax.sims.tasks import catch_ahead
from planner_jax.sims.tasks.catch import CATCH_WORLD, fly_catches, throws
from planner_jax.sims.tasks.catch_ahead import LIMITS, bounds, compile_attempts, plan_ahead, within
from planner_jax.sims.tasks.catch_pilot import is_worth_flying
from planner_jax.sims.tasks.hit import HIT_WORLD, fly_hits, volleys
from planner_jax.task.hit.spec import REAL_SCENARIOS

TRACES = []


def evaluate_contact_positions(flown):
    times = flown.contact.planned_time[:, 0] - flown.began
    return np.asarray(jax.vmap(pj.evaluate)(flown.plan.trajectory, times))


def contact_errors(flown):
    places = flown.contact.robot_pos[:, 0] - evaluate_contact_positions(flown)
    times = flown.contact.time - flown.contact.planned_time
    return np.linalg.norm(places, axis=1), np.abs(times[:, 0])


@pytest.fixture(scope="module")
def catches():
    return fly_catches(Loop(CATCH_WORLD), throws(3, seed=1))


@pytest.fixture(scope="module")
def hits():
    return fly_hits(Loop(HIT_WORLD), volleys(3, REAL_SCENARIOS["S.1"], seed=1))


@pytest.mark.slow
def test_without_noise_every_ball_is_caught_where_and_when_it_was_planned(catches):
    assert catches.caught.all()
    places, times = contact_errors(catches.flown)
    assert places.max() < 0.02 and times.max() < 0.002
    assert catches.flown.tracking[:, 1].max() < 0.02


@pytest.mark.slow
def test_without_noise_every_ball_is_hit_where_and_when_it_was_planned(hits):
    places, times = contact_errors(hits.flown)
    assert places.max() < 0.02 and times.max() < 0.002
    assert hits.miss.max() < 0.05  # from the target, after 1.5 s of flight


@pytest.mark.slow
def test_a_plan_of_the_other_task_is_refused(catches, hits):
    with pytest.raises(ValueError, match="^plan must be a CatchPlan, got a HitPlan$"):
        fly_catches(Loop(CATCH_WORLD), throws(3, seed=1), plan=hits.first_plan)
    with pytest.raises(ValueError, match="^plan must be a HitPlan, got a CatchPlan$"):
        served = volleys(3, REAL_SCENARIOS["S.1"], seed=1)
        fly_hits(Loop(HIT_WORLD), served, plan=catches.first_plan)


@pytest.mark.slow
def test_a_passed_plan_is_flown(catches):
    again = fly_catches(Loop(CATCH_WORLD), throws(3, seed=1), plan=catches.first_plan)
    np.testing.assert_allclose(again.flown.contact.time, catches.flown.contact.time, atol=1e-5)


def with_tool(world, **changes):
    tool = dataclasses.replace(world.robot.tool, **changes)
    model = dataclasses.replace(world.robot.model, tool=tool)
    return dataclasses.replace(world, robot=dataclasses.replace(world.robot, model=model))


MOON = {"gravity": 1.62}


@pytest.mark.parametrize(
    ("fly", "world", "message"),
    [
        (fly_catches, with_tool(CATCH_WORLD, height=0.3), ("net_height", 0.2, 0.3)),
        (fly_catches, with_tool(CATCH_WORLD, radius=0.1), ("net_radius", 0.125, 0.1)),
        (fly_catches, dataclasses.replace(CATCH_WORLD, **MOON), ("gravity", 9.81, 1.62)),
        (fly_hits, with_tool(HIT_WORLD, height=0.1), ("racket_height", 0.06, 0.1)),
        (fly_hits, with_tool(HIT_WORLD, radius=0.2), ("racket_radius", 0.11, 0.2)),
        (fly_hits, dataclasses.replace(HIT_WORLD, **MOON), ("gravity", 9.8, 1.62)),
    ],
)
def test_a_world_other_than_the_planned_one_is_refused(fly, world, message):
    name, planned, flown = message
    with pytest.raises(ValueError) as error:
        fly(Loop(world), throws(2) if fly is fly_catches else volleys(2))
    rule = f"{name} must be the same in plan and flown world"
    found = f"got {planned} in the plan's case and {flown} in the world"
    assert str(error.value) == f"{rule}, {found}"


WIDER = [bounds(Loop(CATCH_WORLD), distance) for distance in LIMITS]


@pytest.mark.slow
def test_a_ball_is_planned_alone_where_no_plan_can_include_the_next_ball():
    suite = jax.tree.map(np.asarray, pj.catch.draw(2, "throws", seed=4, num_targets=2))
    both = dataclasses.replace(suite, present=np.ones((2, 2), bool))
    # In the second case the next ball must be caught at once, so that no plan catches both balls.
    both = dataclasses.replace(both, horizon=both.horizon * np.array([[1.0, 2.0], [1.0, 0.02]]))
    known, plans = plan_ahead(pj.catch.planner(decide="greedy"), both, 0, WIDER)
    assert not known.present[1, 1] and known.present[1, 0]
    assert not is_unsolved(plans.status).any()


@struct.dataclass
class Outcome:
    status: np.ndarray
    violation: np.ndarray


@pytest.mark.parametrize(
    ("pair", "alone", "chosen"),
    [
        ({3.0: 0.02, 4.5: -0.1}, {3.0: -0.1}, (True, 4.5)),
        ({3.0: 0.3, 4.5: 0.2, 5.0: 0.05}, {3.0: -0.1}, (True, 5.0)),
        ({3.0: 0.3, 4.5: 0.2, 5.0: 0.15}, {3.0: -0.1}, (False, 3.0)),
        ({3.0: 9.0, 4.5: np.nan, 5.0: np.nan}, {3.0: -0.1}, (False, 3.0)),
        ({3.0: 0.3, 4.5: 0.2, 5.0: 0.15}, {3.0: 0.5, 4.5: 0.4, 5.0: 0.6}, (False, 4.5)),
    ],
)
def test_the_next_ball_is_given_up_only_where_no_limits_admit_both(
    monkeypatch, pair, alone, chosen
):
    def fake_plan_all(_, cases):
        rate = round(float(cases.limits.body_rate[0]), 3)
        violation = (pair if cases.present.all() else alone)[rate]
        status = Status.CONVERGED if violation <= 0.0 else Status.INFEASIBLE
        return Outcome(np.array([status]), np.array([violation]))

    monkeypatch.setattr(catch_ahead, "plan_all", fake_plan_all)
    both = jax.tree.map(np.asarray, pj.catch.draw(1, "parabola2", seed=4))
    known, plans = plan_ahead(pj.catch.planner(), within(both, WIDER[0]), 0, WIDER)
    assert (known.present.all(), known.limits.body_rate[0]) == chosen
    assert plans.violation[0] == (pair if chosen[0] else alone)[chosen[1]]


@pytest.mark.parametrize(("violation", "share"), [(-0.1, 0.5), (0.3, 1.0)], ids=["slow", "fast"])
def test_a_single_ball_is_caught_at_half_speed_where_such_a_plan_exists(
    monkeypatch, violation, share
):
    both = jax.tree.map(np.asarray, pj.catch.draw(1, "parabola2", seed=4))
    full = both.limits.speed[0].item()

    def fake_plan_all(_, cases):
        single = -0.1 if cases.limits.speed[0] > 0.6 * full else violation
        found = 0.3 if cases.present.all() else single
        status = Status.CONVERGED if found <= 0.0 else Status.INFEASIBLE
        return Outcome(np.array([status]), np.array([found]))

    monkeypatch.setattr(catch_ahead, "plan_all", fake_plan_all)
    known, plans = plan_ahead(pj.catch.planner(), within(both, WIDER[0]), 0, WIDER)
    assert not known.present.all() and plans.violation[0] == -0.1
    np.testing.assert_allclose(known.limits.speed, share * full)


def in_lab(num_balls):
    world = dataclasses.replace(CATCH_WORLD, num_balls=num_balls)
    return Loop(world, NOISES["lab"], replan=100.0)


@pytest.mark.slow
def test_with_noise_latency_and_wrong_drag_balls_are_caught_by_replanning():
    assert fly_catches(in_lab(1), throws(8, drag_error=0.15)).caught.all()


@pytest.mark.slow
def test_a_second_ball_is_caught_after_the_first():
    assert fly_catches(in_lab(2), throws(4, 2, drag_error=0.15)).caught.sum() >= 7


@pytest.mark.slow
def test_balls_that_would_be_missed_are_caught_by_new_decisions():
    missed = throws(200, 3, seed=102, drag_error=0.15)[[58, 62, 71, 73, 92, 131, 143, 188]]
    assert fly_catches(in_lab(3), missed, seed=102).success.sum() >= 6


@pytest.mark.parametrize(
    ("fresh", "warm", "preferred"),
    [
        ((0.3, 1.0), (0.0, 9.0), False),  # a feasible plan is not replaced
        ((0.0, 9.0), (0.3, 1.0), True),
        ((0.3, 1.0), (0.4, 1.0), True),
        ((0.4, 1.0), (0.3, 1.0), False),
        ((0.0, 1.0), (0.0, 2.0), True),
        ((0.0, 0.99), (0.0, 1.0), False),  # the gain is too small
        ((np.nan, 1.0), (0.9, 1.0), False),
        ((0.9, 1.0), (np.nan, 1.0), True),
    ],
)
def test_a_plan_from_scratch_is_flown_if_it_violates_less_or_costs_less(fresh, warm, preferred):
    plan: Any = SimpleNamespace
    first, second = (plan(violation=v, cost=c) for v, c in (fresh, warm))
    assert bool(is_worth_flying(first, second)) == preferred


@pytest.mark.slow
@pytest.mark.parametrize("seen", [0.25, 0.6])
def test_a_hit_planned_once_without_noise_lands_on_the_target(seen):
    served = volleys(4, REAL_SCENARIOS["S.4"], seen=seen)
    flights = fly_hits(Loop(HIT_WORLD), served)
    assert flights.miss.max() < 0.05


def test_some_serves_of_a_batch_keep_the_time_of_their_plan():
    served = volleys(3, seen=0.4)
    some = served[np.array([2, 0])]
    assert some.seen == 0.4
    np.testing.assert_array_equal(some.believed, served.believed[[2, 0]])


def test_a_serve_without_time_for_observations_is_rejected():
    with pytest.raises(ValueError, match="seen must be > 0 and <= 1, got 0"):
        volleys(1, seen=0.0)


@pytest.mark.slow
def test_a_replanned_hit_lands_on_the_target():
    served = volleys(4, REAL_SCENARIOS["S.4"])
    assert fly_hits(Loop(HIT_WORLD, replan=50.0), served).miss.max() < 0.05
    assert fly_hits(Loop(HIT_WORLD, NOISES["lab"], replan=50.0), served).miss.max() < 0.5


@pytest.mark.slow
def test_a_user_robot_hits_the_ball_as_planned():
    robot = pj.read_robot(Path(__file__).parent / "data" / "my_quadrotor.yaml")
    world = dataclasses.replace(HIT_WORLD, robot=Quadrotor(robot))
    served = volleys(4, REAL_SCENARIOS["S.1"], seed=1, robot=robot)
    flights = fly_hits(Loop(world), served)
    assert flights.flown.tracking[:, 1].max() < 0.02
    assert (flights.miss < 0.5).all()


@pytest.mark.slow
def test_a_heavy_robot_with_a_large_net_catches():
    robot = pj.robot_named("x500-net")
    world = dataclasses.replace(CATCH_WORLD, robot=Quadrotor(robot))
    flights = fly_catches(Loop(world), throws(4, seed=1, robot=robot))
    assert flights.flown.tracking[:, 1].max() < 0.05
    assert flights.caught.mean() >= 0.75


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class TracedProblem(WellProblem):
    def prepare(self, case):
        TRACES.append(case)
        return case


def test_attempts_compiled_ahead_are_not_traced_again():
    first, second = WellProblem.attempts
    own = dataclasses.replace(first, solver=pj.LbfgsConfig(max_steps=41, step_cap=0.2))
    planner, easy = TracedProblem.planner(attempts=(own, second, own)), Well(GOALS[:1].repeat(3))
    compile_attempts(planner, easy)
    before = len(TRACES)
    assert before > 0
    plans = plan(planner, Well(np.append(GOALS, np.float32(np.nan))))
    assert is_solved(plans.status).tolist() == [True] * 5 + [False]
    assert len(TRACES) == before


def test_compiling_ahead_also_accepts_a_planner_on_the_host():
    tried = []

    class OnHost(pj.Planner):
        attempts = WellProblem.attempts

        def solve_on_host(self, cases, attempt):
            tried.append(attempt)
            return jax.device_get(plan(WellProblem.planner(attempts=(attempt,)), cases))

    compile_attempts(OnHost(), Well(GOALS))
    assert tried == [WellProblem.attempts[0]]


@pytest.mark.slow
@pytest.mark.parametrize("follows", ["angles", "ball"])
def test_flights_follow_the_heading_of_their_plans(follows):
    served = volleys(3, REAL_SCENARIOS["S.1"], seed=1)
    angle = 0.8 if follows == "angles" else 0.0
    rows = {"angles": [angle] * 2, "times": [0.0, 1.0], "max_yaw_rate": 2.0, "start": [angle, 0.0]}
    tiled = {name: np.array([row] * 3, np.float32) for name, row in rows.items()}
    cases = served.cases.replace(heading=Heading(**tiled, follows=follows))
    flights = fly_hits(Loop(HIT_WORLD, record=True), dataclasses.replace(served, cases=cases))
    assert flights.success.all() and flights.flown.tracking[:, 1].max() < 0.03
    record, flown = flights.flown.record, flights.flown
    quat = record.physics.qpos[..., 3:7]
    yaw = 2.0 * np.arctan2(quat[..., 3], quat[..., 0])
    before = record.time <= flown.contact.time.max()
    if follows == "angles":
        assert np.abs(yaw[before] - angle).max() < 0.05
    else:
        since = np.clip(record.time - flown.began[:, None], 0.0, None)
        wanted = jax.vmap(jax.vmap(yaw_at, (None, 0)))(flown.plan.heading, since)[..., 0]
        late = before & (record.time >= flown.began[:, None])
        assert np.abs(yaw - wanted)[late].max() < 0.05
