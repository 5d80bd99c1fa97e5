"""Receding-horizon planning of blocks: a motion is planned again as more observations arrive.

At specified times (moments) the flight is fitted to all observations so far. If the current motion
still meets the newly fitted ball near the shield's centre, the arm continues it. Otherwise a new
motion is planned from the state that the arm will have when the new motion can start. If no new
motion meets the ball closer to the shield's centre, the arm continues its current motion and brakes
after the contact. The pieces of all executed motions form one plan, which the referee judges
against the true ball. With a single moment the arm plans once. Positions are in the robot's base
frame with z up, in SI units.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Status, is_solved, select_into, take
from planner_jax.planning.plan import plan
from planner_jax.planning.replan import Replanning
from planner_jax.sims.perception.contact_check import end_at_contact
from planner_jax.sims.perception.flight_fit import FlightFit, Sight
from planner_jax.sims.perception.observation import (
    Eye,
    cautious,
    fit_errors,
    fit_throws,
    frame_times,
    watch,
)
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.plan import BlockPlan, append_braking
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.task.block.problem.terms import Weights, contact_terms
from planner_jax.task.block.replan import ReplanBlock, WarmBlock
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

_NEAR = 0.02  # [m] A contact within this distance of the shield's centre needs no new motion.
# Greatest relative excess of a contact's offset, tilt or time over its limit without re-planning.
_EXCESS = 0.05
_LONG = 100.0  # [s] Duration of the standstill piece after a motion, longer than any flight.


@dataclasses.dataclass(frozen=True)
class Aim:
    """Requirements on the contact with an estimated ball, added to the requirements of a case."""

    offset: float  # [m] greatest distance of the contact from the shield's centre
    at_rest: bool = False  # whether the arm must be at rest at the contact
    edge: float = 0.0  # [m] cut from both ends of the path on which the shield may meet a ball


# Requirements on a contact, the strictest first: offset from the shield's centre, and length cut
# from the ball's path [m]. Each aim is tried for balls that no plan meets under stricter aims.
AIMS = (Aim(0.005, at_rest=True, edge=0.05), Aim(0.005, edge=0.05), Aim(0.03, edge=0.03), Aim(0.09))


@struct.dataclass
class Decided:
    """A batch of B throws, and the motions of arms that planned while observing the balls.

    To judge the motions, pass `cases` and `plans` to `end_at_contact` and then to the referee.
    """

    cases: BlockCase  # cases with the true balls, and with the delay at which the motions start
    plans: BlockPlan  # all executed and planned pieces of each arm's motion
    fits: FlightFit  # fits of the flights at M moments, leaves (M, B, ...)
    start: Array  # (B,) [s], start of the arm's first motion; infinite if it never moves
    motions: Array  # (B,) int32, number of started motions

    def fit_errors(self, place: int) -> tuple[Array, Array]:
        """Return position errors of the flights fitted at moment number `place`, and their std [m].

        Both arrays (B,) are for the time halfway between a ball's entries into outer and inner box.
        """
        return fit_errors(self.cases, take(self.fits, place))


def plan_with_aims(
    planner: Planner, cases: BlockCase | Replanning, aims: Sequence[Aim] = AIMS
) -> BlockPlan:
    """Plan cases with estimated balls, with the requirements `aims` tried one after another.

    An aim limits the contact's distance from the shield's centre, and may require standstill. Each
    case gets the plan for the first aim that can be met, or else the plan of least violation. A
    `Replanning` is a case with the motion being executed.
    """
    cases, plans = jax.tree.map(np.asarray, cases), None
    lanes = np.arange(cases.batch_shape[0])
    for aim in aims:
        some = take(cases, lanes)
        is_again = isinstance(some, Replanning)
        aimed = cautious(some.case if is_again else some, **dataclasses.asdict(aim))
        # Convert to NumPy: for JAX arrays, JAX would compile the planner's programs once more.
        aimed = jax.tree.map(np.asarray, aimed)
        asked = dataclasses.replace(some, case=aimed) if is_again else aimed
        found = jax.tree.map(np.array, plan(planner, asked))
        plans = found if plans is None else select_into(plans, found, lanes)
        lanes = np.flatnonzero(~is_solved(plans.status))
        if not lanes.size:
            break
    assert plans is not None
    return plans


def decide(
    planner: Planner[BlockCase, BlockPlan],
    cases: BlockCase,
    eye: Eye,
    moments: Sequence[float],
    *,
    overhead: float = 0.05,
    seed: int | np.ndarray = 0,
    aims: Sequence[Aim] = AIMS,
    shortest: float = 0.03,
    patient: bool = False,
    again: bool = True,
) -> Decided:
    """Simulate a batch of arms that observe their balls, and plan motions at specified moments.

    Args:
        planner: planner of motions from scratch. With several moments it must be an `OnlineBlock`,
            whose re-planner refines motions that are being executed.
        cases: a batch of B cases with the true balls, and with the arms' initial states.
        eye: the camera, its noise and its frame rate.
        moments: [s], increasing times at which the flights are fitted to all observations so far.
        overhead: [s], time from the fit of a flight until a new motion may start, which includes
            the planning time, >= 0.
        seed: seed of the noise, or one seed for each throw, (B,).
        aims: requirements on the contact, tried in this order; their fields `offset`, the greatest
            distances from the shield's centre, must not decrease.
        shortest: [s], time before the latest possible contact in which no new motion is started.
        patient: whether an arm that has not started waits for more observations, as long as a
            motion that starts later would still meet the first aim.
        again: whether an arm may replace its motion; if not, it starts one motion only.

    Raises:
        ArgumentError: moments that do not increase from 0 or later, or a negative overhead.
        TypeError: several moments for a planner other than `OnlineBlock`.
    """
    moments = [float(moment) for moment in moments]
    if len(moments) == 0 or moments[0] < 0.0 or not np.all(np.diff(moments) > 0.0):
        raise ArgumentError("moments", "from 0 or later", moments, verb="rise")
    require(bool(overhead >= 0.0), "overhead", ">= 0", overhead)
    if len(moments) > 1 and not isinstance(planner, OnlineBlock):
        raise TypeError(f"{type(planner).__name__} decides once: give it one moment")
    cases = jax.tree.map(np.asarray, cases)
    dtype, num = cases.gravity.dtype, cases.batch_shape[0]
    times = jnp.asarray(frame_times(eye, moments[-1]), dtype)
    places = watch(cases, eye, times, _keys(seed))
    begin = np.full(num, moments[0] + overhead, dtype)
    cases = dataclasses.replace(cases, delay=begin)
    arms = _Arms(cases)
    fits = []
    for moment, following in zip(moments, [*moments[1:], None], strict=True):
        balls, fit = jax.tree.map(
            np.asarray, fit_throws(cases, eye, times, places, dtype.type(moment))
        )
        begin = np.full(num, moment + overhead, dtype)
        known = dataclasses.replace(cases, ball=balls, delay=begin)
        fits.append(fit)
        open_ = np.asarray(fit.status) == Sight.SEEN
        left = np.asarray(_latest(cautious(known))) - begin
        stands = arms.motions == 0
        open_ &= (left > shortest) & (again | stands)
        useful = arms.count_useful(known, aims)
        if patient and following is not None:
            later = np.full(num, following + overhead, dtype)
            lanes = np.flatnonzero(open_ & stands)
            if lanes.size:
                some = take(dataclasses.replace(known, delay=later), lanes)
                open_[lanes] = ~is_solved(plan_with_aims(planner, some, aims[:1]).status)
        arms.decide(planner, known, np.where(open_, useful, 0), aims)
    plans = arms.compose()
    seen = np.asarray(fits[-1].status) == Sight.SEEN
    status = np.where(seen | is_solved(plans.status), plans.status, Status.NON_FINITE)
    plans = dataclasses.replace(plans, status=status.astype(np.int32))
    every = jax.tree.map(lambda *leaves: np.stack(leaves), *fits)
    start, motions = host_leaf(arms.first), host_leaf(arms.motions)
    return Decided(cases=cases, plans=plans, fits=every, start=start, motions=motions)


class _Arms:
    def __init__(self, cases: BlockCase):
        num, dtype = cases.batch_shape[0], cases.gravity.dtype
        self.cases, self.since = cases, np.array(cases.delay)
        self.plans = BlockPlan(
            motion=_still(cases, (1, 3)),
            contact_time=host_leaf(np.array(cases.delay)),
            cost=host_leaf(np.full(num, np.inf, dtype)),
            violation=host_leaf(np.full(num, np.inf, dtype)),
            iterations=host_leaf(np.zeros(num, np.int32)),
            status=host_leaf(np.full(num, Status.INFEASIBLE, np.int32)),
        )
        self.done: list[PiecewisePolynomial] = []
        self.first, self.motions = np.full(num, np.inf, dtype), np.zeros(num, np.int32)

    def count_useful(self, known: BlockCase, aims: Sequence[Aim]) -> np.ndarray:
        """Count, for each of B arms, the `aims` that are stricter than its current motion meets."""
        num = np.full(len(self.motions), len(aims))
        if not self.motions.any():
            return num
        since = dataclasses.replace(known, delay=self.since)
        moves = is_solved(self.plans.status)
        for offset in sorted({aim.offset for aim in aims}, reverse=True):
            closer = sum(aim.offset < offset for aim in aims)
            near = cautious(since, offset=max(offset, _NEAR))
            meets = np.asarray(_meets(near, self.plans))
            num = np.where(moves & meets, closer, num)
        return num

    def decide(
        self, planner: Planner, known: BlockCase, useful: np.ndarray, aims: Sequence[Aim]
    ) -> None:
        """Plan new motions to block the estimated balls; arm b tries the first useful[b] aims."""
        begun = dataclasses.replace(self.cases, delay=self.since)
        tasks = ReplanBlock().begin(begun, self.plans, known.delay - self.since, ball=known.ball)
        moves, begin = is_solved(self.plans.status), np.asarray(known.delay)
        for num in np.unique(useful[moves & (useful > 0)]):
            lanes = np.flatnonzero(moves & (useful == num))
            assert isinstance(planner, OnlineBlock)
            warm, some = WarmBlock(planner=planner), take(tasks, lanes)
            found = plan_with_aims(warm, some, aims[:num])
            self._begin(begin, lanes, found)
            useful[lanes[is_solved(found.status)]] = 0
        # Planning from scratch takes long. It is done only for arms that would miss their balls.
        lanes = np.flatnonzero(useful == len(aims))
        if lanes.size:
            self._begin(begin, lanes, plan_with_aims(planner, take(tasks.case, lanes), aims))

    def _begin(self, begin: np.ndarray, lanes: np.ndarray, found: BlockPlan) -> None:
        good = is_solved(found.status)
        if not good.any():
            return
        lanes, found = lanes[good], take(found, good)
        # The first solved plans determine the shape of the coefficient arrays of all motions.
        if not self.motions.any():
            still = _still(self.cases, found.motion.coeffs.shape[1:3])
            self.plans = dataclasses.replace(self.plans, motion=still)
        until = np.array(self.since)
        until[lanes] = begin[lanes]
        self.done.append(
            jax.tree.map(
                np.asarray, _cut_executed(self.cases, self.plans.motion, until - self.since)
            )
        )

        def put(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            old[lanes] = new
            return old

        steps = self.plans.iterations[lanes]
        self.plans = jax.tree.map(put, jax.tree.map(np.array, self.plans), found)
        self.plans.iterations[lanes] += steps
        self.since[lanes] = begin[lanes]
        self.first[lanes] = np.minimum(self.first[lanes], begin[lanes])
        self.motions[lanes] += 1

    def compose(self) -> BlockPlan:
        motions = [*self.done, self.plans.motion]
        coeffs = np.concatenate([motion.coeffs for motion in motions], axis=1)
        durations = np.concatenate([motion.durations for motion in motions], axis=1)
        # Move pieces of zero duration to the end, and let them hold the final angles and rates.
        order = np.argsort(durations <= 0.0, axis=1, kind="stable")
        num = max(int((durations > 0.0).sum(axis=1).max()), 1)
        coeffs = np.take_along_axis(coeffs, order[:, :num, None, None], axis=1)
        durations = np.take_along_axis(durations, order[:, :num], axis=1)
        last = np.maximum((durations > 0.0).sum(axis=1) - 1, 0)
        rows = np.arange(len(last))
        of_last, long = coeffs[rows, last], durations[rows, last, None]
        end, power = np.zeros_like(of_last), np.arange(of_last.shape[1])
        end[:, 0] = np.sum(of_last * long[..., None] ** power[:, None], axis=1)
        slope = power * long ** np.maximum(power - 1, 0)
        end[:, 1] = np.sum(of_last * slope[..., None], axis=1)
        coeffs = np.where((durations > 0.0)[:, :, None, None], coeffs, end[:, None])
        return dataclasses.replace(
            self.plans,
            motion=PiecewisePolynomial(coeffs=host_leaf(coeffs), durations=host_leaf(durations)),
            cost=self.plans.cost + self.since - self.cases.delay,
        )


def _still(cases: BlockCase, shape: tuple[int, ...]) -> PiecewisePolynomial:
    num, dtype = cases.batch_shape[0], cases.gravity.dtype
    coeffs = np.zeros((num, *shape, cases.angles.shape[1]), dtype)
    coeffs[:, :, 0], coeffs[:, :, 1] = cases.angles[:, None], cases.rates[:, None]
    durations = np.zeros((num, shape[0]), dtype)
    return PiecewisePolynomial(coeffs=host_leaf(coeffs), durations=host_leaf(durations))


def _keys(seed: int | np.ndarray) -> Array:
    return jax.vmap(jax.random.key)(seed) if np.ndim(seed) else jax.random.key(seed)


@jax.jit
@jax.vmap
def _latest(case: BlockCase) -> Array:
    return flight_of(case).latest


@jax.jit
def _meets(cases: BlockCase, plans: BlockPlan) -> Array:
    def one(case: BlockCase, plan: BlockPlan) -> Array:
        time = plan.contact_time - case.delay
        angles = evaluate(plan.motion, jnp.minimum(time, jnp.sum(plan.motion.durations)))
        flight = flight_of(case)
        excess = contact_terms(case, flight, angles, plan.contact_time, Weights())[2]
        return flight.comes & (excess <= _EXCESS)

    return jax.vmap(one)(cases, end_at_contact(cases, plans))


@jax.jit
@jax.vmap
def _cut_executed(case: BlockCase, motion: PiecewisePolynomial, time: Array) -> PiecewisePolynomial:
    """Append braking and standstill to a motion, and cut it at a time () [s] from its start."""
    motion = append_braking(case, motion)
    end = jnp.sum(motion.durations)
    stand = jnp.zeros_like(motion.coeffs[:1]).at[0, 0].set(evaluate(motion, end))
    durations = jnp.append(motion.durations, jnp.asarray(_LONG, end.dtype))
    starts = jnp.cumsum(durations) - durations
    return PiecewisePolynomial(
        coeffs=jnp.concatenate([motion.coeffs, stand]),
        durations=jnp.clip(time - starts, 0.0, durations),
    )
