"""Float64 NumPy referee of trajectories to rest behind a plan's end; one function a robot.

Such a trajectory has to continue where the plan ends, keep every limit and end at rest, whatever
is true of the plan. No code is shared with the planners but the case's own extra limits.
"""

import dataclasses
import functools
from types import SimpleNamespace

import numpy as np

from planner_jax.referee.block import referee_blocks
from planner_jax.referee.intercept import final_poses, referee_intercepts
from planner_jax.referee.judging import (
    Verdict,
    derivative,
    finite_lanes,
    first_failures,
    judge_in_chunks,
)
from planner_jax.referee.quadrotor import (
    MOTION_SENTENCES,
    MOTION_UNBOUNDED,
    intervals_of,
    judge_motion,
    pieces_of,
    read_flight,
)

_SENTENCES = {"not finite": "the plan or its case is not finite", **MOTION_SENTENCES}
LIMITS = tuple(_SENTENCES)
_SAMPLES, _CHUNK = 400, 2048
_STANDS = 1e-3  # [m/s], speed of a car that stands
_OF_THE_BALL = ("ball", "tilt", "tunnel")


@dataclasses.dataclass(frozen=True)
class RestVerdict(Verdict):
    """What the referee found, one entry a lane; times count from the last contact."""

    SENTENCES = _SENTENCES
    UNBOUNDED = MOTION_UNBOUNDED

    worst_extra: np.ndarray  # (B,) int, place of the extra that is kept worst; -1 without any


def referee_rests(cases, plans) -> RestVerdict:
    """Return the verdict on the recovery trajectory of every plan of a batch.

    Args:
        cases: object with `gravity`, `limits` and `extras`, leaves with leading axis B.
        plans: object with the fields of `QuadrotorPlan`, with `recovery`; leaves have axis B first.
    """
    judge = functools.partial(_judge, extras=cases.extras, relative=1e-3, continuity=1e-4)
    return RestVerdict(**judge_in_chunks(judge, read_flight(cases, plans), _CHUNK))


def _judge(case: dict, extras: tuple, relative: float, continuity: float) -> dict:
    """Return the fields of `RestVerdict` for one chunk of lanes."""
    case = {**case, "head_state": _end_states(case["coeffs"], case["durations"])}
    pieces = pieces_of(case["recovery.coeffs"], case["recovery.durations"])
    intervals = intervals_of(_SAMPLES, pieces.durations.shape[1])
    measured, tests = judge_motion(pieces, case, extras, intervals, relative, continuity)
    found = first_failures(tests, LIMITS, finite_lanes(case))
    return {**found, "worst_extra": measured["worst_extra"]}


def _end_states(coeffs: np.ndarray, durations: np.ndarray) -> np.ndarray:
    """Return position to jerk (B, 4, 3) at the ends of trajectories; empty pieces do not count."""
    lanes, number = np.arange(len(coeffs)), np.arange(durations.shape[1])
    last = np.where(durations > 0.0, number, 0).max(axis=1)
    tail = np.moveaxis(coeffs[lanes, last], 0, -1)
    ends = [derivative(tail, durations[lanes, last], order) for order in range(4)]
    return np.moveaxis(np.stack(ends), -1, 0)


def referee_stops(case, plan, rest) -> str:
    """Return the fault of a car's trajectory to a standstill behind one plan; "" without a fault.

    `referee_intercepts` judges it as a case of its own that begins where the plan ends, without a
    target: its limits, the map, what stands, and what moves until the car stands.

    Args:
        case: object with the fields of `InterceptCase`, of one case.
        plan: object with the fields of `CarPlan`, of that case.
        rest: likewise, from the end of the plan on; its `start` is not read.
    """
    cases, plans, rests = map(_batch_of_one, (case, plan, rest))
    begin = final_poses(plans, cases.body)
    movers = cases.movers
    moved = movers.centre + movers.velocity * np.asarray(plans.time)[:, None, None]
    judged = _replace(
        cases,
        speed=plans.speed[:, -1],
        curvature=plans.curvature[:, -1],
        start=begin,
        time=np.asarray(rests.time),
        tolerance=np.full(1, np.inf),
        heading_tolerance=np.full(1, np.inf),
        movers=_replace(movers, centre=moved),
    )
    verdict = referee_intercepts(
        judged,
        _replace(rests, start=begin),
        target_positions=lambda target, times: begin[:, :2],
    )
    if not verdict.success[0]:
        return verdict.sentence(0)
    last = float(rests.speed[0, -1])
    return "" if abs(last) <= _STANDS else f"stand: the car drives at {last:.3g} m/s in the end"


def referee_stands(case, plan, rest) -> str:
    """Return the fault of an arm's motion to rest behind one plan; "" without a fault.

    `referee_blocks` judges it as a case of its own that begins where the plan ends; what it says
    of the ball, which has been met by then, does not count.

    Args:
        case: object with the fields of `BlockCase`, of one case.
        plan: object with the fields of `ArmPlan`, of that case.
        rest: likewise, from the end of the plan on.
    """
    cases, plans, rests = map(_batch_of_one, (case, plan, rest))
    tail = np.moveaxis(np.asarray(plans.motion.coeffs, np.float64)[:, -1], 0, -1)
    last = np.asarray(plans.motion.durations, np.float64)[:, -1]
    angles, rates = (derivative(tail, last, order).T for order in range(2))
    ends = np.asarray(rests.motion.durations, np.float64).sum(axis=1)
    judged = _replace(
        cases, angles=angles, rates=rates, delay=np.zeros(1), ends_at_rest=np.ones(1, bool)
    )
    verdict = referee_blocks(judged, _replace(rests, contact_time=ends))
    if verdict.success[0] or verdict.failed_limit[0] in _OF_THE_BALL:
        return ""
    return verdict.sentence(0)


def _batch_of_one(tree) -> SimpleNamespace:
    """Return the fields of a dataclass of arrays, with a leading axis of one on every array."""
    found, values = {}, vars(tree)
    for field in dataclasses.fields(tree):
        value = values[field.name]
        if dataclasses.is_dataclass(value):
            value = _batch_of_one(value)
        elif field.metadata.get("pytree_node", True):
            value = np.asarray(value)[None]
        found[field.name] = value
    return SimpleNamespace(**found)


def _replace(tree: SimpleNamespace, **fields) -> SimpleNamespace:
    """Return a copy with other fields."""
    return SimpleNamespace(**{**vars(tree), **fields})
