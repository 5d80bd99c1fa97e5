"""Flights of teams: several robots of one world, and their catches."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.errors import ArgumentError
from planner_jax.robot.quadrotor_model import PAPER_CATCHER
from planner_jax.sims.launch import flight_keys, ready
from planner_jax.sims.loop import fly_leg
from planner_jax.sims.model import mujoco_model, place_balls
from planner_jax.sims.robot import Physics
from planner_jax.sims.robots.quadrotor.robot import Quadrotor
from planner_jax.sims.robots.quadrotor.squad import Squad
from planner_jax.sims.settings import TeamFly
from planner_jax.sims.tasks.catch_pilot import CatchPilot
from planner_jax.sims.tasks.team import Teams, fly_teams
from tests.test_team import crossing

NET = PAPER_CATCHER.tool.height


def batch(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.asarray(leaf).dtype)[None], tree)


def test_robots_of_a_squad_have_their_own_parts_of_the_state():
    one, squad = Quadrotor(PAPER_CATCHER), Squad(Quadrotor(PAPER_CATCHER), 2)
    places = jnp.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.5]])
    qpos, qvel, act = squad.at_rest(places, 9.81)
    state = squad.state(Physics(qpos, qvel, act))
    np.testing.assert_allclose(state.pos, places)
    np.testing.assert_allclose(squad.place(np.asarray(qpos)), places.ravel())
    np.testing.assert_allclose(act.reshape(2, 4)[1], one.at_rest(places[1], 9.81)[2])
    assert [list(place) for place, _ in squad.places(np.asarray(qpos))] == places.tolist()


def test_settings_of_teams_out_of_their_range_are_errors():
    for options, words in (({"suite": "swarm12"}, "suite"), ({"replan": 10.0}, "replan")):
        with pytest.raises(ArgumentError, match=f"^{words} must be"):
            TeamFly(**options)
    world = TeamFly(num=1, suite="team3-swarm12").flight().world()
    model = mujoco_model(world)
    assert (model.nq, model.nv, model.nu) == (3 * 7 + 36, 3 * 6 + 36, 12)


@pytest.mark.slow
def test_team_flies_in_one_world_and_one_robot_flies_as_in_the_catch_task():
    case, plan = crossing(1.2)
    ends = np.asarray(plan.robots.trajectory.coeffs)[:, 0, 0] * [-1.0, -1.0, 1.0]
    vel = np.array([[0.0, 0.0, -0.5]] * 2)
    pos = ends + [0.0, 0.0, NET] - 3.0 * vel  # the balls reach the nets after 3 s
    targets = dataclasses.replace(
        case.shared.targets,
        ball=pj.BallState(pos=jnp.asarray(pos, jnp.float32), vel=jnp.asarray(vel, jnp.float32)),
    )
    case = case.replace(shared=case.shared.replace(targets=targets))
    task = TeamFly(num=1, noise="none").flight()
    single = task.world().robot.member
    loop = dataclasses.replace(
        task.loop(True), world=dataclasses.replace(task.world(), num_balls=2)
    )
    plans = batch(plan).replace(robots=jax.tree.map(np.float32, batch(plan.robots)))
    plans = plans.replace(robots=plans.robots.replace(order=np.asarray(plan.robots.order)[None]))
    flights = fly_teams(loop, Teams(np.arange(1), batch(case)), plans)
    assert flights.success.all() and flights.planned.all()
    assert flights.least_distance[0] == pytest.approx(1.2, abs=0.01)
    assert flights.flown.tracking[0, 1] < 0.02
    np.testing.assert_allclose(flights.flown.contact.time, 3.0, atol=0.02)
    recording = task.recording(Teams(np.arange(1), batch(case)), flights, np.arange(1))
    assert recording.robot.shape[2] == 14 and recording.wanted.shape[2:] == (2, 3)

    world = dataclasses.replace(loop.world, robot=Squad(single, 1))
    first = jax.tree.map(lambda leaf: leaf[:, :1], (plans.robots, case.head_states[None]))
    alone = case.replace(head_states=case.head_states[:1])
    flown = fly_teams(
        dataclasses.replace(loop, world=world),
        Teams(np.arange(1), batch(alone)),
        plans.replace(robots=first[0]),
    ).flown
    loop = dataclasses.replace(loop, world=dataclasses.replace(world, robot=single))
    start = ready(loop, case.head_states[:1, 0], flight_keys(0, np.arange(1)))
    every, no_drag = np.ones(2, bool), np.zeros((1, 2), np.float32)
    physics = jax.vmap(
        lambda physics: place_balls(loop.world, physics, targets.ball, no_drag[0], every)
    )(start.physics)
    start = dataclasses.replace(
        start,
        physics=physics,
        launched=jnp.asarray(every[None]),
        plan=jax.tree.map(lambda leaf: jnp.asarray(leaf[:, 0]), plans.robots),
    )
    end, records = fly_leg(
        loop,
        CatchPilot(),
        start,
        None,
        jnp.asarray(no_drag),
        num_periods=flown.record.time.shape[1],
    )
    np.testing.assert_array_equal(records[0].physics.qpos, flown.record.physics.qpos)
    np.testing.assert_array_equal(end.contact.time, flown.contact.time)
    assert end.contact.met.tolist() == [[True, False]] == flown.contact.met.tolist()
