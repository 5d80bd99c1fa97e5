"""Catches of targets that appear one by one: decided anew at every appearance and every catch.

At such an event the decision is asked about the targets that have appeared, are not caught and may
still be caught, from the state in which the quadrotor then is on its plan; the planner plans what
it says. Of the new plan those catches are kept after which the quadrotor can come to rest. It is
flown from there on if it is solved, and if they are more than what is left of the plan that is
flown, or as many sooner. After the last of them the quadrotor brakes, and waits where it is at
rest.

What was flown is put together to one plan of the whole case, and the referee judges that: all of
its limits, every joint, and the net at each catch. Bookkeeping is done in NumPy on the host, for
all cases at once, each of which goes on to its own next event.
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from planner_jax.core.protocol import Decision, Status, is_solved
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.planning.plan import plan
from planner_jax.referee.catch import CatchVerdict, referee_catches
from planner_jax.studies.catch.appearing import states_of
from planner_jax.studies.catch.braking import Braking, braking
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial, shift_basis, states_at

CHUNKS = (16, 64)  # cases that are decided in one compiled call
_SIZE = 8  # coefficients of a piece
_REST = 1e4  # [s], for which the quadrotor waits at the end of its way, if nothing appears
_SOONER = 1e-3  # [s], by which as many catches have to be over sooner
_LEAST = 1e-6  # [s], of a piece; a shorter one is left out


def _path(coeffs: Any, durations: Any) -> PiecewisePolynomial:
    """A trajectory, or a batch, of NumPy leaves."""
    return PiecewisePolynomial(coeffs=coeffs, durations=durations)


@dataclasses.dataclass
class _Course:
    """Where B quadrotors fly, and what they catch there; in float64, changed in place."""

    began: np.ndarray  # (B,) [s]
    coeffs: np.ndarray  # (B, P, 8, 3), of the plan's pieces, the way to rest, and the wait
    durations: np.ndarray  # (B, P) [s]
    order: np.ndarray  # (B, N), the targets in the order of their catches
    times: np.ndarray  # (B, N) [s], when each of these is caught; infinite for the others

    def states(self, now: np.ndarray) -> np.ndarray:
        """Position to jerk (B, 4, 3) at times (B,) [s]."""
        return states_at(_path(self.coeffs, self.durations), now - self.began)

    def replace(self, lanes: np.ndarray, other: "_Course") -> None:
        """Take over the courses (L, ...) of some lanes (L,)."""
        for field in dataclasses.fields(self):
            getattr(self, field.name)[lanes] = getattr(other, field.name)


@dataclasses.dataclass(frozen=True)
class Flown:
    """What came of B cases, on the host."""

    caught: np.ndarray  # (B, N) [s], when each target was caught; infinite if it was not
    cases: CatchCase  # as they were flown: what was caught is present, with a place for the rest
    # All that was flown, up to where the quadrotor comes to rest; the status is that of the last
    # plan that was asked for, which was not flown if it is unsolved.
    plans: CatchPlan


def fly_live(cases: CatchCase, decision: Decision, *, planner: ExactCatch | None = None) -> Flown:
    """Fly cases whose targets appear one by one, deciding anew at every event.

    Args:
        cases: (B,), of `draw_appearing`.
        decision: such as `Greedy()`.
        planner: `ExactCatch()` if not given.
    """
    known: Any = jax.tree.map(np.asarray, cases)
    planner = planner or ExactCatch()
    decided = DecidedPlanner(planner, decision)
    appears = known.targets.appears.astype(np.float64)
    caught = np.full(appears.shape, np.inf)
    course = _waiting(known, planner.num_pieces)
    now = np.zeros(len(appears))
    goes_on = _finite(known)
    status = np.where(goes_on, Status.FEASIBLE, Status.NON_FINITE)
    flown = []
    while True:
        left = known.present & (appears <= now[:, None]) & (known.horizon > now[:, None])
        left &= np.isinf(caught)
        lanes = np.flatnonzero(left.any(axis=1) & goes_on)
        if lanes.size:
            status[lanes] = _decide(decided, known, course, lanes, now, left)
        events = np.concatenate([np.where(known.present, appears, np.inf), course.times], axis=1)
        event = np.where(events > now[:, None], events, np.inf).min(axis=1)
        goes_on &= np.isfinite(event)
        if not goes_on.any():
            break
        until = np.where(goes_on, event, now)
        flown.append(_cut(course, now, until))
        row, place = np.nonzero((course.times == until[:, None]) & goes_on[:, None])
        caught[row, course.order[row, place]] = until[row]
        now = until
    at_rest = course.began + course.durations[:, :-1].sum(axis=1)
    flown.append(_cut(course, now, np.maximum(at_rest, now)))
    return _as_one_plan(known, flown, caught, status)


def judge_live(flown: Flown) -> CatchVerdict:
    """What the referee says of all that was flown: the whole way, and every catch."""
    return referee_catches(flown.cases, flown.plans, target_states=states_of)


def _finite(cases: Any) -> np.ndarray:
    """Which cases (B,) are finite; one that is not is not flown."""
    leaves = [leaf.reshape(len(leaf), -1) for leaf in jax.tree.leaves(cases)]
    return np.all([np.isfinite(leaf).all(axis=1) for leaf in leaves], axis=0)


def _waiting(cases: Any, num_pieces: int) -> _Course:
    """Courses that stay where the quadrotors begin."""
    batch, size = cases.present.shape
    coeffs = np.zeros((batch, size * num_pieces + 2, _SIZE, 3))
    coeffs[:, :, 0] = cases.head_state[:, None, 0]
    durations = np.zeros(coeffs.shape[:2])
    durations[:, -1] = _REST
    return _Course(
        began=np.zeros(batch),
        coeffs=coeffs,
        durations=durations,
        order=np.tile(np.arange(size), (batch, 1)),
        times=np.full((batch, size), np.inf),
    )


def _decide(
    decided: DecidedPlanner,
    cases: Any,
    course: _Course,
    lanes: np.ndarray,
    now: np.ndarray,
    left: np.ndarray,
) -> np.ndarray:
    """Plan anew what is left (B, N) of lanes (L,), and take over what is better.

    Returns:
        Statuses (L,) of the new plans.
    """
    asked = _as_known(cases, course.states(now), now, left)
    begins = range(0, lanes.size, CHUNKS[-1])
    parts = [_planned(decided, asked, lanes[begin : begin + CHUNKS[-1]]) for begin in begins]
    plans, ways = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    new = _course_of(plans, ways, now[lanes])
    before = course.times[lanes]
    before = np.where(before > now[lanes, None], before, np.inf)
    num, num_before = (np.isfinite(times).sum(axis=1) for times in (new.times, before))
    last, last_before = (_latest(times) for times in (new.times, before))
    better = (num > num_before) | ((num == num_before) & (last < last_before - _SOONER))
    taken = better & is_solved(plans.status)
    chosen = _Course(**{f.name: getattr(new, f.name)[taken] for f in dataclasses.fields(new)})
    course.replace(lanes[taken], chosen)
    return plans.status


def _latest(times: np.ndarray) -> np.ndarray:
    """The last finite one of times (B, N), (B,)."""
    return np.where(np.isfinite(times), times, -np.inf).max(axis=1)


def _as_known(cases: Any, states: np.ndarray, now: np.ndarray, left: np.ndarray) -> CatchCase:
    """The cases as they are now: times count from here, and of other targets nothing is known.

    Args:
        cases: (B,).
        states: (B, 4, 3), of the quadrotors.
        now: (B,) [s].
        left: (B, N) bool, of the targets.
    """
    dtype = cases.horizon.dtype

    def known(leaf: np.ndarray) -> np.ndarray:
        return np.where(left.reshape(left.shape + (1,) * (leaf.ndim - 2)), leaf, 0.0).astype(dtype)

    since = now[:, None]
    targets = dataclasses.replace(cases.targets, appears=cases.targets.appears - since)
    return dataclasses.replace(
        cases,
        targets=jax.tree.map(known, targets),
        present=left,
        horizon=np.where(left, cases.horizon - since, 1.0).astype(dtype),
        head_state=states.astype(dtype),
    )


def _planned(decided: DecidedPlanner, asked: CatchCase, lanes: np.ndarray) -> tuple[Any, Any]:
    """Plans of some lanes (L,), up to a chunk, and the ways to rest (L, N) after their catches."""
    chunk = next(chunk for chunk in CHUNKS if lanes.size <= chunk)
    filled = np.append(lanes, np.full(chunk - lanes.size, lanes[0]))
    plans: Any = plan(decided, jax.tree.map(lambda leaf: leaf[filled], asked))
    limits = jax.tree.map(lambda leaf: leaf[filled], asked.limits)
    ways = jax.device_get(_brakings(_leg_ends(plans), plans.gravity, limits))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: lanes.size], (plans, ways))


_brakings = jax.jit(jax.vmap(jax.vmap(braking, in_axes=(0, None, None))))


def _leg_ends(plans: CatchPlan) -> np.ndarray:
    """Position to jerk (L, N, 4, 3) at the catches."""
    batch, size = plans.order.shape
    coeffs, durations = (np.asarray(leaf) for leaf in jax.tree.leaves(plans.trajectory))
    last = durations.shape[1] // size - 1
    ends = coeffs.reshape(batch * size, -1, _SIZE, 3)[:, last:]
    spans = durations.reshape(batch * size, -1)[:, last:]
    states = states_at(_path(ends, spans), spans[:, 0]).astype(coeffs.dtype)
    return states.reshape(batch, size, 4, 3)


def _course_of(plans: CatchPlan, ways: Braking, now: np.ndarray) -> _Course:
    """Courses of plans (L, ...) that begin now (L,), up to the last catch with a way to rest."""
    coeffs = np.asarray(plans.trajectory.coeffs, np.float64)
    batch, size = plans.order.shape
    legs = np.asarray(plans.trajectory.durations, np.float64).reshape(batch, size, -1)
    planned = legs.sum(axis=2) > 0.0
    after = planned & ways.possible
    last = np.where(after.any(axis=1), size - 1 - after[:, ::-1].argmax(axis=1), -1)
    planned &= np.arange(size) <= last[:, None]
    legs = np.where(planned[:, :, None], legs, 0.0)
    ends, durations = legs.sum(axis=2).cumsum(axis=1), legs.reshape(batch, -1)
    lanes = np.arange(batch)
    way, time = (leaf[lanes, last].astype(np.float64) for leaf in (ways.coeffs, ways.duration))
    rest = np.zeros_like(way)
    rest[:, 0] = (way * time[:, None, None] ** np.arange(_SIZE)[:, None]).sum(axis=1)
    return _Course(
        began=now.copy(),
        coeffs=np.concatenate([coeffs, way[:, None], rest[:, None]], axis=1),
        durations=np.column_stack([durations, time, np.full_like(time, _REST)]),
        order=np.asarray(plans.order, int),
        times=np.where(planned, now[:, None] + ends, np.inf),
    )


def _moved(coeffs: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Coefficients (..., 8, 3) of the same polynomials for a time that begins later, by (...)."""
    factors, powers = shift_basis(_SIZE)
    matrix = factors * by[..., None, None] ** powers
    return np.einsum("...ij,...jk->...ik", matrix, coeffs)


def _cut(course: _Course, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pieces (B, P, 8, 3) of the courses between two times, and their durations (B, P)."""
    ends = course.durations.cumsum(axis=1) + course.began[:, None]
    starts = ends - course.durations
    from_ = np.maximum(starts, begin[:, None])
    durations = np.minimum(ends, end[:, None]) - from_
    durations = np.where(durations > _LEAST, durations, 0.0)
    return _moved(course.coeffs, np.where(durations > 0.0, from_ - starts, 0.0)), durations


def _as_one_plan(
    cases: Any,
    flown: list[tuple[np.ndarray, np.ndarray]],
    caught: np.ndarray,
    status: np.ndarray,
) -> Flown:
    """All that was flown as a plan of N + 1 places: the catches, and the way to rest."""
    batch, size = caught.shape
    coeffs, durations = (np.concatenate(parts, axis=1) for parts in zip(*flown, strict=True))
    times = np.sort(caught, axis=1)
    coeffs, durations = _in_legs(coeffs, durations, times)
    # Other places repeat the last catch.
    late = np.maximum(_latest(times), 0.0)
    order = np.column_stack([np.argsort(caught, axis=1, kind="stable"), np.full(batch, size)])
    times = np.column_stack([np.where(np.isfinite(times), times, late[:, None]), late])
    zeros = np.zeros(batch)
    made: dict[str, Any] = dict(
        cost=zeros,
        violation=zeros,
        iterations=zeros.astype(int),
        status=status,
        trajectory=_path(coeffs, durations),
        gravity=cases.gravity,
        order=order,
        decided_times=times,
        times=times,
    )
    return Flown(caught=caught, cases=_as_caught(cases, caught), plans=CatchPlan(**made))


def _in_legs(
    coeffs: np.ndarray, durations: np.ndarray, catches: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pieces of all legs, as many of each: up to each catch, and from the last one on.

    Args:
        coeffs: (B, P, 8, 3), one after another in time.
        durations: (B, P) [s], zero for those that were not flown.
        catches: (B, N) [s], rising, infinite for those that were not made.

    Returns:
        Pieces (B, (N + 1) * M, 8, 3), and durations, zero in the legs that were not flown.
    """
    batch, size = catches.shape
    legs: list[tuple[int, int, np.ndarray, np.ndarray]] = []
    for k in range(batch):
        kept = durations[k] > 0.0
        own, spans = coeffs[k, kept], durations[k, kept]
        place = np.searchsorted(catches[k], spans.cumsum() - 0.5 * spans)
        place = np.minimum(place, np.isfinite(catches[k]).sum())
        legs += [(k, n, own[place == n], spans[place == n]) for n in np.unique(place)]
    most = max((spans.size for *_, spans in legs), default=1)
    pieces = np.zeros((batch, size + 1, most, _SIZE, 3))
    spent = np.zeros((batch, size + 1, most))
    for k, n, own, spans in legs:
        pieces[k, n], spent[k, n] = _split(own, spans, most)
    return pieces.reshape(batch, -1, _SIZE, 3), spent.reshape(batch, -1)


def _as_caught(cases: Any, caught: np.ndarray) -> CatchCase:
    """The cases with what was caught present, and an absent target more."""

    def one_more(leaf: np.ndarray) -> np.ndarray:
        return np.concatenate([leaf, leaf[:, :1]], axis=1)

    present = np.column_stack([np.isfinite(caught), np.zeros(len(caught), bool)])
    return dataclasses.replace(
        cases,
        targets=jax.tree.map(one_more, cases.targets),
        present=present,
        # The referee looks at no more of a target that was not caught than that it is absent.
        head_state=np.where(_finite(cases)[:, None, None], cases.head_state, np.nan),
        horizon=one_more(cases.horizon),
        order=one_more(cases.order),
        times=one_more(cases.times),
        optional=False,
    )


def _split(coeffs: np.ndarray, spans: np.ndarray, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Pieces (K, 8, 3) and durations (K,) as `num` of them, the longest cut into equal parts."""
    longest = spans.argmax()
    parts = num - spans.size + 1
    each = spans[longest] / parts
    cut = _moved(np.broadcast_to(coeffs[longest], (parts, _SIZE, 3)), each * np.arange(parts))
    return (
        np.concatenate([coeffs[:longest], cut, coeffs[longest + 1 :]]),
        np.concatenate([spans[:longest], np.full(parts, each), spans[longest + 1 :]]),
    )
