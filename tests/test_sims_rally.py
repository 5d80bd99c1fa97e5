"""The closed loop of rallies: estimates across an impact, and trials."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.ball.estimation import EkfState
from planner_jax.ball.flight import BallState, fly
from planner_jax.core.errors import ArgumentError
from planner_jax.perception.drag import RlsState
from planner_jax.sims import rally_ball, rally_loop, rally_state
from planner_jax.sims.scoring import racket_impact
from planner_jax.sims.settings import RallyFly
from planner_jax.sims.tasks.rally import StateFile
from planner_jax.task.rally.suites import COURSES
from tests.trees import assert_same

DRAG, GRAVITY = jnp.asarray(0.06), jnp.asarray(9.8)
NORMAL = jnp.asarray([0.6, 0.0, 0.8])
TOOL_VEL = jnp.asarray([0.2, -0.1, 1.0])
BALL = BallState(jnp.asarray([0.1, 0.2, 1.6]), jnp.asarray([0.3, -0.2, -4.0]))


def trial(time, bounce_time, is_due):
    """Return the part of a trial that belongs to the estimate of its ball."""
    belief = EkfState(jnp.concatenate([BALL.pos, BALL.vel]), jnp.diag(jnp.full(6, 1e-4)))
    bounce = rally_state.Bounce(
        jnp.asarray(bounce_time), TOOL_VEL, NORMAL, jnp.zeros(3), jnp.asarray(is_due), jnp.ones(())
    )
    return types.SimpleNamespace(
        time=jnp.asarray(time),
        bounce=bounce,
        restitution=RlsState(jnp.asarray(1.7), jnp.asarray(0.01)),
        estimate=types.SimpleNamespace(belief=belief, drag=DRAG),
    )


FIELDS = [field.name for field in dataclasses.fields(rally_state.Trial)]
LOOP = types.SimpleNamespace(
    world=types.SimpleNamespace(gravity=9.8), sensing=types.SimpleNamespace(latency=0.02)
)


def test_a_ball_is_predicted_across_an_impact_that_is_felt_but_not_yet_seen():
    ball = rally_ball.predict(trial(1.0, 0.99, True), LOOP, 0.1)
    there = fly(BALL, jnp.asarray(0.01), DRAG, GRAVITY, num_steps=4)[0]
    vel = racket_impact(there.vel, TOOL_VEL, NORMAL, jnp.asarray(0.7))
    after = fly(BallState(there.pos, vel), jnp.asarray(0.11), DRAG, GRAVITY, num_steps=4)[0]
    np.testing.assert_allclose(ball.pos, after.pos, atol=1e-5)
    np.testing.assert_allclose(ball.vel, after.vel, atol=1e-4)


def test_an_impact_that_was_seen_does_not_change_the_prediction():
    ball = rally_ball.predict(trial(1.0, 0.5, False), LOOP, 0.1)
    after = fly(BALL, jnp.asarray(0.12), DRAG, GRAVITY, num_steps=4)[0]
    np.testing.assert_allclose(ball.pos, after.pos, atol=1e-5)


def test_the_covariance_across_an_impact_has_the_jacobian_of_the_impact_map():
    state = trial(1.0, 0.99, True)
    belief = state.estimate.belief
    after = rally_ball.reflect_belief(state, belief)
    slope = np.eye(6)
    of = lambda vel: racket_impact(vel, TOOL_VEL, NORMAL, jnp.asarray(0.7))  # noqa: E731
    slope[3:, 3:] = jax.jacfwd(of)(BALL.vel)
    approach = float(jnp.sum((BALL.vel - TOOL_VEL) * NORMAL))
    expected = slope @ np.asarray(belief.covariance) @ slope.T
    expected += np.diag(np.repeat([0.01, 0.1], 3) ** 2)
    expected[3:, 3:] += 0.01 * approach**2 * np.outer(NORMAL, NORMAL)
    np.testing.assert_allclose(after.covariance, expected, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(after.mean[3:], of(BALL.vel), atol=1e-5)


def test_two_robots_hit_in_turn():
    own = [
        rally_loop._own_hits(types.SimpleNamespace(hits=jnp.asarray(hits)), jnp.arange(2)).tolist()
        for hits in range(5)
    ]
    assert own == [[0, 0], [1, 0], [1, 1], [2, 1], [2, 2]]


@pytest.mark.parametrize(
    ("course", "height", "before", "after", "breaks"),
    [
        ("volley", 1.0, (-0.01, 0.0, 1.5), (0.01, 0.0, 1.5), True),
        ("volley", 1.0, (-0.01, 0.0, 1.6), (0.01, 0.0, 1.6), False),
        ("volley", 1.0, (0.2, 0.0, 1.0), (0.1, 0.0, 1.0), False),
        ("juggle", 9.0, (-0.01, 0.0, 1.0), (0.01, 0.0, 1.0), False),
        ("volleybots-juggle", 2.4, (0.2, 0.0, 3.0), (0.1, 0.0, 3.0), False),
        ("volleybots-juggle", 2.6, (0.2, 0.0, 3.0), (0.1, 0.0, 3.0), True),
        ("volleybots-juggle", 0.3, (0.2, 0.0, 3.0), (0.1, 0.0, 3.0), True),
    ],
)
def test_a_trial_ends_at_the_net_and_outside_the_robots_heights(
    course, height, before, after, breaks
):
    at = lambda ball: types.SimpleNamespace(  # noqa: E731
        robot_pos=jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, height]]),
        ball_pos=jnp.tile(jnp.asarray(ball), (2, 1, 1)),
    )
    assert bool(rally_loop._breaks_rule(COURSES[course], at(before), at(after))) == breaks


@pytest.mark.parametrize(("aside", "inside"), [(0.2, 1), (0.3, 0)])
def test_balls_of_every_third_hit_count_in_the_circle(aside, inside):
    zero = jnp.zeros(())
    where = jnp.asarray(COURSES["target"].places[2]) + jnp.array([0.0, aside, 0.1])
    contact = types.SimpleNamespace(
        met=jnp.ones((), bool), ball_pos=where, **dict.fromkeys(("offset", "tracking"), zero)
    )
    contact.time = contact.planned_time = zero
    case = types.SimpleNamespace(
        restitution=zero, drag=zero, places=jnp.asarray(COURSES["target"].places)
    )
    counts = []
    for hits in range(7):
        state = rally_state.Trial(**dict.fromkeys(FIELDS, zero)).replace(
            restitution=RlsState(zero, zero),
            estimate=types.SimpleNamespace(drag=zero),
            hits=jnp.asarray(hits),
            lost=jnp.zeros((), bool),
            last=rally_state.Passage(*[zero] * 6),
        )
        after = rally_loop._score(state, case, COURSES["target"], jnp.ones((), bool), contact)
        assert int(after.hits) == hits + 1
        counts.append((int(after.aimed), int(after.inside)))
    assert counts == [(0, 0)] * 3 + [(1, inside)] + [(0, 0)] * 2 + [(1, inside)]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"hits": 0}, "hits must be"),
        ({"restitution_error": 1.0}, "restitution_error must be"),
        ({"replan": 0.0}, "replan must be"),
        ({"suite": "tennis"}, "suite must be"),
        ({"state": "trials.npz", "batch": 4}, "batch must be left out"),
    ],
)
def test_settings_out_of_their_range_are_errors_of_one_line(options, words):
    with pytest.raises(ArgumentError, match=words) as raised:
        RallyFly(**options)
    assert "\n" not in str(raised.value)


def test_a_state_file_continues_its_own_run_only(tmp_path):
    file = StateFile(tmp_path / "trials.npz", "run 1")
    like = {"time": np.zeros(2), "calls": np.zeros((), int)}
    assert file.load(like) is like
    file.save({"time": np.array([0.5, 1.0]), "calls": np.array(3)})
    assert_same(file.load(like), {"time": np.array([0.5, 1.0]), "calls": np.array(3)})
    with pytest.raises(ArgumentError, match="state must be the file of a run with these settings"):
        dataclasses.replace(file, identity="run 2").load(like)
    file.path.write_bytes(file.path.read_bytes()[:100])
    with pytest.raises(ArgumentError, match="state must be a whole file"):
        file.load(like)


@pytest.mark.slow
def test_a_run_that_continues_from_its_state_equals_a_run_in_one_piece(tmp_path):
    def trials(hits, **options):
        task = RallyFly(num=2, seed=7, hits=hits, **options).flight()
        return task.fly(task.cases(), record=True).flown

    state = {"state": str(tmp_path / "trials.npz")}
    trials(2, **state)
    assert_same(vars(trials(8, **state)), vars(trials(8)))


@pytest.mark.slow
def test_two_robots_keep_a_ball_over_the_net():
    task = RallyFly(num=3, seed=7, suite="volley", hits=8).flight()
    cases = task.cases()
    flights = task.fly(cases, record=True)
    end = flights.flown.trial
    assert flights.success.all() and (end.worst_offset < 0.08).all()
    balls = flights.flown.qpos[..., -3:]
    np.testing.assert_allclose(balls[:, :, 0], balls[:, :, 1], atol=1e-4)
    turns = (np.diff(np.sign(balls[0, :, 0, 0])) != 0).sum()
    assert turns >= end.hits[0]  # the first ball comes over the net, too


@pytest.mark.slow
def test_rallies_with_noise_and_wrong_estimates_go_on_and_lost_balls_end_a_trial():
    task = RallyFly(num=4, seed=7, hits=6).flight()
    rallies = task.cases()
    away = np.array(rallies.cases.ball.pos)
    away[3, 0] += 30.0  # no robot reaches this ball
    ball = BallState(away, rallies.cases.ball.vel)
    cases = rallies.cases.replace(ball=ball)
    flights = task.fly(type(rallies)(**{**vars(rallies), "cases": cases}), record=True)
    assert flights.success.tolist() == [True, True, True, False]
    end = flights.flown.trial
    assert end.lost[3] and end.hits[3] == 0 and not end.lost[:3].any()
    assert (end.worst_offset < 0.08).all()
    error = np.asarray(end.restitution.estimate)[:3] - 1.0 - rallies.cases.restitution[:3]
    assert (np.abs(error) < 0.03).all()  # 0.07 at the start
    recording = task.recording(rallies, flights, np.arange(2))
    assert recording.robot.shape[:2] == recording.wanted.shape[:2]
    assert np.isfinite(recording.balls).all()
