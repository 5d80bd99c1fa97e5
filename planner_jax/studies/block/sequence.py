"""Balls thrown one after another: each is blocked from where the arm is by then.

The arm knows a ball from the moment at which it is first seen. When it has met one it goes on to
the next if that is known, else back towards its home until it is; the motion to the ball is planned
from the angles and with the rates that the joints have then. Where the next ball is seen while the
arm is on its way to one, and could not be met from where that motion ends, the rest of the motion
is planned anew: so that the ball is met somewhere from where the next one can be met, too.

Robot base frame, z up, SI units.
"""

import dataclasses
import functools
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.baselines.parts.bang_bang import bang_bang, least_times
from planner_jax.core.protocol import AnyPlanner, is_solved, solved
from planner_jax.planning.plan import require_batch
from planner_jax.referee.block import BlockVerdict, referee_blocks
from planner_jax.studies.block.subset import chosen, plans_where
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.clearance import least_clearances
from planner_jax.task.block.end_poses import flight_of
from planner_jax.task.block.motion import cut
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.scene import Box
from planner_jax.task.block.suites import draw_cases
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

# Parts of a ball's way between the boxes, from 0 where it gets in to 1, in which it is met instead
# if it has to be met elsewhere.
PARTS = ((0.5, 1.0), (0.0, 0.5), (0.75, 1.0), (0.25, 0.75))
_SHARES = np.linspace(0.0, 1.0, 5)  # of the way home
_SAMPLES = 48  # of that way, where it is looked at
_MARGIN = 0.003  # [m], kept from everything on it
_LONG = 60.0  # [s], for which an arm may wait


@struct.dataclass
class BlockSequence:
    """K balls for one arm, in the order in which they come; a batch has one more axis in front."""

    balls: BlockCase  # (K, ...), each as if it were alone; the arm's state is that at time 0
    seen: Array  # (K,) [s], when each is first seen, 0 for the first one

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one sequence, (B,) for a batch."""
        return np.shape(self.seen)[:-1]


@struct.dataclass
class PlannedSequence:
    """What is planned for a batch of sequences, ball by ball."""

    # (B, K, ...), of each ball with the arm as its last motion leaves it. Times count from then on.
    cases: BlockCase
    plans: BlockPlan  # (B, K, ...), from then on: the arm waits, then moves to the ball
    begins: Array  # (B, K) [s], since the first ball was seen: when that was


def draw_sequences(
    num: int,
    suite: str = "pole",
    seed: int = 0,
    *,
    balls: int = 3,
    apart: float | tuple[float, float] = 0.8,
    first: int = 0,
    **settings: Any,
) -> BlockSequence:
    """Drawn sequences of throws; unless they are stopped they reach the inner box in turn.

    Args:
        num: B, how many, >= 1.
        suite: a key of `SUITES`.
        seed: >= 0. Sequence k of so many balls of a suite and seed is always the same one.
        balls: K of each, >= 1.
        apart: [s], from one that would get into the inner box to the next one that would; or the
            shortest and the longest such time, between which it is drawn.
        first: place of the first sequence, >= 0.
        **settings: such as `regime`, `wide` and `delay`; see `draw_cases`.

    Raises:
        ValueError: an argument is out of its range; one line.
    """
    if balls < 1:
        raise ValueError(f"balls must be >= 1, got {balls}")
    shortest, longest = np.broadcast_to(apart, 2)
    if not 0.0 < shortest <= longest < np.inf:
        raise ValueError(f"apart must be > 0, finite and no falling pair, got {apart}")
    cases = draw_cases(suite, num * balls, seed, first * balls, **settings)
    arrivals = np.asarray(jax.jit(jax.vmap(flight_of))(cases).latest).reshape(num, balls)
    tag = zlib.crc32(f"{suite} sequence".encode())
    gaps = np.stack(
        [
            np.random.default_rng([seed, first + k, tag]).uniform(shortest, longest, balls)
            for k in range(num)
        ]
    )
    due = arrivals[:, :1] + np.cumsum(gaps, axis=1) - gaps[:, :1]
    seen = due - arrivals
    return BlockSequence(
        balls=jax.tree.map(
            lambda leaf: jnp.asarray(np.asarray(leaf).reshape(num, balls, *leaf.shape[1:])), cases
        ),
        seen=jnp.asarray(seen - seen[:, :1], cases.delay.dtype),
    )


def plan_in_turn(
    planner: AnyPlanner[BlockCase, BlockPlan],
    sequences: BlockSequence,
    *,
    reconsiders: bool = True,
    returns: bool = True,
    foreknown: bool = False,
) -> PlannedSequence:
    """Plan ball after ball, all sequences of a batch at once.

    A ball for which no plan is found is let through: the arm goes on as if it had not come. What
    the arm knows of a ball, it knows `delay` after that is first seen; planning takes no time.

    Args:
        planner: of single balls, such as `pj.block.planner()`.
        sequences: a batch.
        reconsiders: whether the motion to a ball is planned anew for the sake of the next one, as
            soon as that is known; else each ball is met wherever its plan likes.
        returns: whether an arm that knows of no ball goes back towards home, as far as the
            straight line of its joints is free; else it stands where it is, as soon as it can.
        foreknown: whether all balls are known as soon as the first one is: a bound of what
            reconsidering may reach, by the same search, and no plan for an arm that only sees.

    Returns:
        NumPy leaves. Ball k + 1 starts where, when and as fast as the motion to ball k ends, if
        one was found.

    Raises:
        ValueError: the sequences are not a batch.
    """
    require_batch(sequences)
    sequences = jax.tree.map(np.asarray, sequences)
    num, length = sequences.seen.shape
    known = sequences.seen + sequences.balls.delay
    if foreknown:
        known[:, 1:] = known[:, :1]
    now: Any = np.zeros_like(known[:, 0])
    arm = _Arm(
        time=now,
        angles=sequences.balls.angles[:, 0],
        rates=sequences.balls.rates[:, 0],
    )
    turns: list[_Turn] = []
    for k in range(length):
        ball = jax.tree.map(lambda leaf, k=k: leaf[:, k], sequences.balls)
        coming = _Coming(ball=ball, seen=sequences.seen[:, k], known=known[:, k])
        turn = _planned(planner, coming, arm, returns, np.ones(num, bool))
        if reconsiders and k > 0:
            turns[-1], turn = _reconsidered(planner, coming, turns[-1], turn, returns)
        turns.append(turn)
        arm = _on_host(_after(turn))
    turns = _of_one_length(turns)
    return jax.tree.map(
        lambda *leaves: np.stack(leaves, axis=1),
        *(PlannedSequence(cases=t.case, plans=t.plan, begins=t.begin) for t in turns),
    )


def judge_in_turn(planned: PlannedSequence, **settings: Any) -> BlockVerdict:
    """What the referee says of every ball, each a case of its own; all its arrays are (B, K).

    Args:
        planned: what `plan_in_turn` made.
        **settings: such as `tolerance`; see `referee_blocks`.
    """
    shape = np.shape(planned.begins)
    cases, plans = jax.tree.map(
        lambda leaf: np.reshape(leaf, (-1, *np.shape(leaf)[2:])), (planned.cases, planned.plans)
    )
    verdict = referee_blocks(cases, plans, **settings)
    fields = {f.name: getattr(verdict, f.name) for f in dataclasses.fields(verdict)}
    return BlockVerdict(**{name: value.reshape(shape) for name, value in fields.items()})


@struct.dataclass
class _Arm:
    """Where the arm is when no motion to a ball is left."""

    time: Array  # () [s], since the first ball was seen
    angles: Array  # (6,) [rad]
    rates: Array  # (6,) [rad/s]


@struct.dataclass
class _Coming:
    """A ball, and what is known of it when; times count from when the first ball was seen."""

    ball: BlockCase
    seen: Array  # () [s]
    known: Array  # () [s], when the arm may start


@struct.dataclass
class _Turn:
    """One ball, from the end of the last motion on; but for `begin` times count from there."""

    begin: Array  # () [s], of the turn, since the first ball was seen
    case: BlockCase
    plan: BlockPlan  # from then on: what is waited, and the motion to the ball


def _planned(planner: Any, coming: _Coming, arm: _Arm, returns: bool, wanted: np.ndarray) -> _Turn:
    """The turns of B balls; those that are not wanted (B,) are not planned, and unsolved."""
    case, wait, asked = _begun(coming, arm, returns)
    plans = plans_where(planner, _on_host(asked), wanted)
    motion = _one_after_another(wait, asked.delay, plans.motion)
    return _on_host(_Turn(arm.time, case, dataclasses.replace(plans, motion=motion)))


def _reconsidered(
    planner: Any, coming: _Coming, last: _Turn, turn: _Turn, returns: bool
) -> tuple[_Turn, _Turn]:
    """A ball's turn and the one before, which is changed where that makes the ball met."""
    again, may = _begun_again(last, coming.known)
    is_open = np.asarray(may) & solved(last.plan) & ~solved(turn.plan)
    again = _on_host(again)
    for part in PARTS:
        if not is_open.any():
            break
        plans = plans_where(planner, narrowed(again, *part), is_open)
        motion = _one_after_another(last.plan.motion, again.delay, plans.motion)
        other = _on_host(dataclasses.replace(last, plan=dataclasses.replace(plans, motion=motion)))
        wanted = is_open & solved(plans)
        if not wanted.any():
            continue
        following = _planned(planner, coming, _on_host(_after(other)), returns, wanted)
        better = wanted & solved(following.plan)
        is_open = is_open & ~better
        last = chosen(better, *_of_one_length([other, last]))
        turn = chosen(better, *_of_one_length([following, turn]))
    return last, turn


def narrowed(cases: BlockCase, begin: float, end: float) -> BlockCase:
    """Cases whose balls have to be met in a part of the way between the boxes.

    Args:
        cases: one, or a batch.
        begin: share of the way from the outer box to the inner one, in [0, 1].
        end: likewise, > `begin`.
    """
    scene = cases.scene

    def between(share: float) -> Box:
        return jax.tree.map(
            lambda outer, inner: (1.0 - share) * outer + share * inner, scene.outer, scene.inner
        )

    scene = dataclasses.replace(scene, outer=between(begin), inner=between(end))
    return dataclasses.replace(cases, scene=scene)


@functools.partial(jax.jit, static_argnames="returns")
@functools.partial(jax.vmap, in_axes=(0, 0, None))
def _begun(
    coming: _Coming, arm: _Arm, returns: bool
) -> tuple[BlockCase, PiecewisePolynomial, BlockCase]:
    """A ball's case from where the arm is, what the arm does meanwhile, and what is asked."""
    ball = coming.ball
    moved = drag_free_flight(ball.ball, arm.time - coming.seen, ball.gravity)
    case = dataclasses.replace(
        ball,
        ball=BallState(pos=moved.pos, vel=moved.vel),
        delay=jnp.zeros_like(ball.delay),
        angles=arm.angles,
        rates=arm.rates,
    )
    wait = _waiting(case, returns)
    lead = jnp.maximum(coming.known - arm.time, 0.0)
    return case, wait, _from_motion(case, wait, lead)


@jax.jit
@jax.vmap
def _begun_again(turn: _Turn, known: Array) -> tuple[BlockCase, Array]:
    """What is to be planned from a time [s] since the first ball was seen, and whether it can be.

    Only while the arm is on its way to the ball.
    """
    time = jnp.maximum(known - turn.begin, 0.0)
    motion = turn.plan.motion
    return _from_motion(turn.case, motion, time), time < turn.plan.contact_time


@jax.jit
@jax.vmap
def _after(turn: _Turn) -> _Arm:
    """Where the arm is after a turn; if the ball is let through, where it was before."""
    met, motion = is_solved(turn.plan.status), turn.plan.motion
    end = jnp.sum(motion.durations)
    return _Arm(
        time=turn.begin + jnp.where(met, turn.plan.contact_time, 0.0),
        angles=jnp.where(met, evaluate(motion, end), turn.case.angles),
        rates=jnp.where(met, evaluate(motion, end, 1), turn.case.rates),
    )


def _from_motion(case: BlockCase, motion: PiecewisePolynomial, time: Array) -> BlockCase:
    """A case that is planned from a time () [s] of a motion on."""
    return dataclasses.replace(
        case, delay=time, angles=evaluate(motion, time), rates=evaluate(motion, time, 1)
    )


@jax.jit
@jax.vmap
def _one_after_another(
    first: PiecewisePolynomial, until: Array, second: PiecewisePolynomial
) -> PiecewisePolynomial:
    """A motion up to a time () [s], and from then on another one."""
    parts = [cut(first, until), second]
    powers = max(part.coeffs.shape[1] for part in parts)
    padded = [
        jnp.pad(part.coeffs, ((0, 0), (0, powers - part.coeffs.shape[1]), (0, 0))) for part in parts
    ]
    return PiecewisePolynomial(
        coeffs=jnp.concatenate(padded),
        durations=jnp.concatenate([part.durations for part in parts]),
    )


def _waiting(case: BlockCase, returns: bool) -> PiecewisePolynomial:
    """The arm as it brakes, or goes towards its home as far as that is free, and then stands."""
    limits = case.limits
    stopping = 0.5 * case.rates * jnp.abs(case.rates) / limits.acceleration
    away = jnp.where(returns, case.arm.home - case.angles - stopping, 0.0)

    def to(share: Array) -> tuple[PiecewisePolynomial, Array]:
        """The motion of a share of the way, and whether it is free."""
        turn = stopping + share * away
        least = jnp.max(least_times(turn, case.rates, limits.velocity, limits.acceleration))
        motion = bang_bang(case.angles, case.rates, turn, least, limits.acceleration)
        times = least * jnp.asarray(np.linspace(0.0, 1.0, _SAMPLES), least.dtype)
        angles = jax.vmap(lambda time: evaluate(motion, time))(times)
        return motion, jnp.min(least_clearances(case.arm, case.scene, angles)) > _MARGIN

    motions, free = jax.vmap(to)(jnp.asarray(_SHARES, case.angles.dtype))
    farthest = jnp.max(jnp.where(free, jnp.arange(len(_SHARES)), 0))
    motion = jax.tree.map(lambda leaf: leaf[farthest], motions)
    end = evaluate(motion, jnp.sum(motion.durations))
    return PiecewisePolynomial(
        coeffs=jnp.concatenate(
            [motion.coeffs, jnp.zeros_like(motion.coeffs[:1]).at[0, 0].set(end)]
        ),
        durations=jnp.append(motion.durations, _LONG),
    )


def _of_one_length(turns: list[_Turn]) -> list[_Turn]:
    """Turns whose motions have as many pieces as the longest one; what is new lasts 0 s."""
    numbers = [turn.plan.motion.durations.shape[1] for turn in turns]
    same = []
    for turn, number in zip(turns, numbers, strict=True):
        motion = _on_host(_with_empty(turn.plan.motion, max(numbers) - number))
        same.append(dataclasses.replace(turn, plan=dataclasses.replace(turn.plan, motion=motion)))
    return same


@functools.partial(jax.jit, static_argnames="pieces")
def _with_empty(motion: PiecewisePolynomial, pieces: int) -> PiecewisePolynomial:
    """Motions (B, ...) and so many pieces more that last 0 s."""

    def one(motion: PiecewisePolynomial) -> PiecewisePolynomial:
        end = jnp.sum(motion.durations)
        still = jnp.zeros((pieces, *motion.coeffs.shape[1:]), motion.coeffs.dtype)
        still = still.at[:, :2].set(jnp.stack([evaluate(motion, end), evaluate(motion, end, 1)]))
        return PiecewisePolynomial(
            coeffs=jnp.concatenate([motion.coeffs, still]),
            durations=jnp.concatenate([motion.durations, jnp.zeros(pieces, end.dtype)]),
        )

    return jax.vmap(one)(motion)


def _on_host(tree: Any) -> Any:
    return jax.tree.map(np.asarray, tree)
