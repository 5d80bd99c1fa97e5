"""Balls in sequence: drawn, planned in turn from where the arm is, and judged one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_block import SMALL

import planner_jax as pj
from planner_jax.studies.block import sequence
from planner_jax.studies.block.sequence import narrowed
from planner_jax.task.block.end_poses import flight_of
from planner_jax.task.block.motion import cut, polynomial
from planner_jax.trajectory.polynomial import evaluate

NUM = 12  # the program for 16 cases in jax arrays is one of its own


def drawn(num=NUM, **options):
    return sequence.draw_sequences(num, seed=4, regime="R1", wide=True, **options)


@pytest.fixture(scope="module")
def planned():
    return sequence.plan_in_turn(SMALL, drawn())


@jax.jit
@jax.vmap
def state_at(motion, time):
    return jnp.stack([evaluate(motion, time), evaluate(motion, time, 1)])


def test_balls_arrive_as_far_apart_as_asked():
    sequences = drawn(apart=(0.6, 1.2), balls=4)
    arrivals = sequences.seen + jax.jit(jax.vmap(jax.vmap(flight_of)))(sequences.balls).latest
    gaps = np.diff(arrivals, axis=1)
    assert gaps.min() > 0.599 and gaps.max() < 1.201 and np.ptp(gaps) > 0.4
    np.testing.assert_array_equal(sequences.seen[:, 0], 0.0)


def test_a_sequence_is_the_same_wherever_a_batch_begins():
    many, one = drawn(6, apart=(0.6, 1.2)), drawn(1, apart=(0.6, 1.2), first=4)
    np.testing.assert_array_equal(pj.lane(many, 4).seen, one.seen[0])
    np.testing.assert_array_equal(pj.lane(many, 4).balls.ball.pos, one.balls.ball.pos[0])


@pytest.mark.slow
def test_a_sequence_of_one_is_a_single_ball():
    sequences = drawn(balls=1, delay=0.1)
    planned = sequence.plan_in_turn(SMALL, sequences)
    alone = jax.tree.map(lambda leaf: np.asarray(leaf[:, 0]), sequences.balls)
    plans = pj.plan(SMALL, alone)
    assert pj.solved(plans).sum() > NUM // 2
    np.testing.assert_array_equal(planned.plans.status[:, 0], plans.status)
    np.testing.assert_allclose(planned.plans.contact_time[:, 0], plans.contact_time, atol=1e-5)
    verdict = sequence.judge_in_turn(planned)
    np.testing.assert_array_equal(verdict.success[:, 0], pj.block.judge(alone, plans).success)


def test_each_ball_starts_where_the_motion_to_the_last_one_ends(planned):
    """Angles, rates, time and the ball's own flight; the referee confirms what is claimed."""
    met = pj.solved(planned.plans)
    assert met[:, 1:].mean() > 0.5
    ends = state_at(pj.lane(planned.plans.motion, np.s_[:, 0]), planned.plans.contact_time[:, 0])
    after, second = met[:, 0], pj.lane(planned.cases, np.s_[:, 1])
    np.testing.assert_allclose(second.angles[after], ends[after, 0], atol=1e-4)
    np.testing.assert_allclose(second.rates[after], ends[after, 1], atol=1e-3)
    assert np.abs(second.rates[after]).max() > 1.0  # R1 does not stop for a ball
    gone = np.where(after, planned.plans.contact_time[:, 0], 0.0)
    np.testing.assert_allclose(planned.begins[:, 1] - planned.begins[:, 0], gone, atol=1e-5)
    sequences = drawn()
    latest = jax.jit(jax.vmap(flight_of))
    due = sequences.seen[:, 1] + latest(pj.lane(sequences.balls, np.s_[:, 1])).latest
    np.testing.assert_allclose(planned.begins[:, 1] + latest(second).latest, due, atol=1e-4)
    np.testing.assert_array_equal(sequence.judge_in_turn(planned).success, met)


@pytest.mark.slow
def test_sequences_of_a_batch_are_those_planned_alone(planned):
    sequences = drawn()
    for k in (0, 5):
        one = sequence.plan_in_turn(SMALL, pj.lane(sequences, np.s_[k : k + 1]))
        np.testing.assert_array_equal(one.plans.status[0], planned.plans.status[k])
        np.testing.assert_allclose(one.begins[0], planned.begins[k], atol=1e-3)


@pytest.mark.slow
def test_an_arm_reconsiders_only_when_it_knows_of_the_next_ball(planned):
    """More balls are met than without, and by motions that were the same until then."""
    sequences = drawn()
    greedy = sequence.plan_in_turn(SMALL, sequences, reconsiders=False)
    met, before = pj.solved(planned.plans), pj.solved(greedy.plans)
    changed = planned.plans.contact_time[:, 0] != greedy.plans.contact_time[:, 0]
    assert changed.any() and met[changed, 1].all() and not before[changed, 1].any()
    known = np.maximum(sequences.seen[:, 1] - planned.begins[:, 0], 0.0)
    for share in (0.5, 1.0):
        states = [
            state_at(pj.lane(each.plans.motion, np.s_[:, 0]), share * known)
            for each in (planned, greedy)
        ]
        np.testing.assert_allclose(*states, atol=1e-3)
    foreknown = sequence.plan_in_turn(SMALL, sequences, foreknown=True)
    assert before.sum() < met.sum() <= pj.solved(foreknown.plans).sum()


def test_a_ball_that_flies_past_is_let_through(planned):
    sequences = jax.tree.map(np.array, drawn())
    sequences.balls.ball.vel[:, 1] *= -1.0
    passed = sequence.plan_in_turn(SMALL, sequences, reconsiders=False)
    assert (passed.plans.status[:, 1] == pj.Status.OUT_OF_REACH).all()
    np.testing.assert_array_equal(passed.begins[:, 2], passed.begins[:, 1])
    assert pj.solved(passed.plans)[:, 2].mean() > 0.5


@pytest.mark.parametrize("returns", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_an_arm_without_a_ball_goes_home_or_stops(returns):
    """And is judged while it does; the second ball comes five seconds later."""
    sequences = drawn(balls=2, apart=5.0)
    planned = sequence.plan_in_turn(SMALL, sequences, returns=returns)
    assert sequence.judge_in_turn(planned).success.mean() > 0.7
    met = pj.solved(planned.plans)[:, 0]
    waited = pj.lane(planned.plans.motion, np.s_[:, 1])
    angles, rates = np.moveaxis(state_at(waited, sequences.seen[:, 1] - planned.begins[:, 1]), 1, 0)
    np.testing.assert_allclose(rates, 0.0, atol=1e-4)
    away = np.abs(angles - sequences.balls.arm.home[:, 1]).max(axis=1)
    assert (away[met] < 1e-3).sum() > NUM // 3 if returns else (away[met] > 0.1).all()


def test_narrowed_cases_are_met_in_a_part_of_the_way():
    cases = pj.lane(drawn().balls, np.s_[:, 0])
    flights = jax.jit(jax.vmap(flight_of))
    whole, early, late = (flights(narrowed(cases, *part)) for part in ((0, 1), (0, 0.5), (0.5, 1)))
    np.testing.assert_allclose(early.earliest, whole.earliest, atol=1e-5)
    np.testing.assert_allclose(early.latest, late.earliest, atol=1e-5)
    np.testing.assert_allclose(late.latest, whole.latest, atol=1e-5)


def test_a_cut_motion_is_the_same_until_then():
    rng = np.random.default_rng(0)
    start, first, steps = (jnp.asarray(rng.normal(size=shape)) for shape in (6, 6, (5, 6)))
    motion = jax.jit(polynomial)(start, first, steps, jnp.ones(()))
    at, cut_at = jax.jit(lambda motion, time: evaluate(motion, time)), jax.jit(cut)
    short = cut_at(motion, 0.47)
    assert np.sum(short.durations) == pytest.approx(0.47)
    for time in (0.1, 0.3, 0.47):
        np.testing.assert_allclose(at(short, time), at(motion, time), atol=1e-6)
    np.testing.assert_array_equal(cut_at(motion, 2.0).durations, motion.durations)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"balls": 0}, "balls must be >= 1, got 0"),
        ({"apart": 0.0}, "apart must be > 0, finite and no falling pair, got 0.0"),
        ({"apart": (1.2, 0.6)}, r"apart must be > 0, finite and no falling pair, got \(1.2, 0.6\)"),
        ({"suite": "x"}, "suite must be one of pole, open, short, got 'x'"),
    ],
)
def test_what_is_wrong_with_a_draw_is_named(options, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        drawn(**options)


def test_one_sequence_without_an_axis_is_refused():
    with pytest.raises(ValueError, match="^cases must be a batch of at least one"):
        sequence.plan_in_turn(SMALL, pj.lane(drawn(1), 0))
