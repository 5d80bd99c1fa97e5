"""Float64 NumPy referee of hits: decides by physics whether a plan succeeds.

A hit is a quadrotor's return of a ball to a target with a racket. `referee.quadrotor` checks the
flight. This module integrates the ball up to the impact, which is at the end of the trajectory, and
on to its landing. Of the planners' code it runs only limits that a user adds (`referee.extras`).
World frame, z up, ground at z = 0, SI units.

Equations of [Yu2023bat]: eq. 2 is the drag, eq. 18 the limits, and eq. 3 the impact with the
coefficient of restitution beta. Eq. 3 prints 1 - beta; this module has 1 + beta, which follows from
the paper's definition of beta.
"""

import dataclasses
import functools

import numpy as np

from planner_jax.referee import judging, quadrotor

_SENTENCES = {
    "not finite": judging.NOT_FINITE,
    "contact time": "off by {excess:.3g} s; it must be positive, the end of the trajectory "
    "({time:.3f} s), and before the ball lands",
    **quadrotor.MOTION_SENTENCES,
    **{f"hitting speed {axis}": judging.ABOVE_LIMIT for axis in "xyz"},
    "contact": "the racket centre is {excess:.3g} m from the ball at {time:.3f} s",
    "wrong face": "the ball leaves the racket's face at {excess:.3g} m/s at {time:.3f} s",
    "apex low": "{excess:.2%} below the least apex at {time:.3f} s",
    "apex high": "{excess:.2%} above the greatest apex at {time:.3f} s",
    "landing": "the ball lands {excess:.3g} m from the target at {time:.3f} s",
}
LIMITS = tuple(_SENTENCES)
_CASE_SHAPES = {
    **{"ball.pos": (3,), "ball.vel": (3,), "head_state": (4, 3), "target": (3,), "drag": ()},
    **{"restitution": (), "racket_height": (), "racket_radius": ()},
    **{"hit_limits.hitting_speed": (3,), "hit_limits.min_apex": (), "hit_limits.max_apex": ()},
}
_SPIN_SHAPES = {"lift": (3,), "around.wind": (3,)}
_SPIN_SHAPES |= {"around.friction": (), "around.grip": (), "around.reach": ()}

_INCOMING_STEPS = 60  # number of Runge-Kutta steps of the ball's flight up to the impact
RIM = 0.9  # fraction of the racket's radius within which the ball must meet the racket


@dataclasses.dataclass(frozen=True)
class HitVerdict(judging.FlightVerdict):
    """Verdict on B plans in which a quadrotor hits a ball, with measurements of ball and impact."""

    SENTENCES = _SENTENCES
    UNBOUNDED = quadrotor.MOTION_UNBOUNDED | {
        "landing": "the ball never comes down to the target's height; its apex is at {time:.3f} s"
    }

    hitting_velocity: np.ndarray  # (B, 3) [m/s], of the quadrotor at the impact
    apex: np.ndarray  # (B,) [m], greatest height of the ball after the impact
    # (B, 3) [m], where the ball falls to the target's height; NaN if it never does.
    landing_point: np.ndarray
    # (B,) [m], horizontal distance from landing point to target; infinite without landing point.
    landing_error: np.ndarray
    contact_error: np.ndarray  # (B,) [m], distance of racket centre and ball at the impact

    def success_message(self, k: int | tuple) -> str:
        """Describe for plan `k`, a success, how far from the target the ball lands."""
        return f"the ball lands {np.asarray(self.landing_error)[k]:.2g} m from the target"


def referee_hits(
    cases,
    plans,
    *,
    drag_after_impact: bool = False,
    tolerance: float = 1e-3,
    landing_tolerance: float = 0.01,
    contact_tolerance: float = 5e-3,
    continuity_tolerance: float = 1e-4,
) -> HitVerdict:
    """Decide for every plan of a batch of hits whether it succeeds.

    The impact is at the end of the trajectory. An error e of the n-th derivative at time 0, or a
    jump by e between pieces, counts as the displacement |e| h^n / n!, with pieces of mean duration
    h (at least 0.1 s).

    Args:
        cases: object with the fields of `HitCase`, for B cases.
        plans: object with the fields of `HitPlan`, for B plans of M polynomial pieces of degree D:
            coefficients (B, M, D + 1, 3), durations (B, M).
        drag_after_impact: whether the ball has drag after the impact too.
        tolerance: relative tolerance of every limit of the case.
        landing_tolerance: [m], greatest horizontal distance between landing point and target.
        contact_tolerance: [m], greatest distance between racket centre and ball at the impact. If
            the case has `racket_radius`, the distance may also not exceed 0.9 times the radius.
        continuity_tolerance: greatest displacement at time 0 and between pieces, relative to the
            largest coordinate at the ends of the pieces (at least 1 m).

    Returns:
        A `HitVerdict` of float64 arrays. A plan with numbers that are not finite fails as "not
        finite", without an effect on other plans. Limits of a case may be infinite.

    Raises:
        ValueError: an array has the wrong shape.
    """
    leaves = quadrotor.read_flight(cases, plans)
    leaves |= judging.read_leaves(cases, _CASE_SHAPES, len(leaves["lane"]))
    leaves |= judging.read_leaves(plans, {"stroke.time": ()}, len(leaves["lane"]))
    if cases.lift is not None:
        leaves |= judging.read_leaves(cases, _SPIN_SHAPES, len(leaves["lane"]))
    tolerances = {"relative": tolerance, "continuity": continuity_tolerance}
    tolerances |= {"landing": landing_tolerance, "contact": contact_tolerance}
    judge = functools.partial(
        _judge,
        extras=cases.extras,
        intervals=quadrotor.intervals_of(leaves["durations"].shape[1]),
        drag_after_impact=drag_after_impact,
        tolerances=tolerances,
    )
    return HitVerdict(**judging.judge_in_chunks(judge, leaves, chunk=2048))


def _judge(
    case: dict, extras: tuple, intervals: int, drag_after_impact: bool, tolerances: dict
) -> dict:
    pieces = quadrotor.pieces_of(case["coeffs"], case["durations"])
    if "recovery.coeffs" in case:
        from planner_jax.referee.recovery import append_recovery  # few plans have a recovery

        pieces = append_recovery(pieces, case)
    measured, tests = quadrotor.judge_motion(
        pieces, case, extras, intervals, tolerances["relative"], tolerances["continuity"]
    )
    at_impact, impact_tests = _judge_impact(case, drag_after_impact, tolerances)
    finite = judging.finite_lanes(case)
    return judging.first_failures(tests | impact_tests, LIMITS, finite) | measured | at_impact


def ball_acc(vel: np.ndarray, air) -> np.ndarray:
    """Return the accelerations g - K_D |v| v of balls; `air` has rows K_D and g, or also spin."""
    if len(air) > 2:
        from planner_jax.referee.spin import spin_acc  # the spin of few balls is known

        return spin_acc(vel, air)
    acc = -air[0] * np.sqrt((vel * vel).sum(axis=0)) * vel
    acc[2] -= air[1]
    return acc


def ball_step(state: np.ndarray, step: np.ndarray, air) -> np.ndarray:
    """Return the states (6, ...) of balls after one Runge-Kutta step of order 4."""
    half, vel = 0.5 * step, state[3:]
    acc_1 = ball_acc(vel, air)
    acc_2 = ball_acc(vel + half * acc_1, air)
    acc_3 = ball_acc(vel + half * acc_2, air)
    acc_4 = ball_acc(vel + step * acc_3, air)
    pos = state[:3] + step * vel + step**2 / 6.0 * (acc_1 + acc_2 + acc_3)
    return np.concatenate([pos, vel + step / 6.0 * (acc_1 + 2.0 * (acc_2 + acc_3) + acc_4)])


def _return_in_vacuum(state, height, gravity) -> tuple:
    """Return greatest height and its time, landing point and its time, for balls without drag."""
    pos, vel = state[:3], state[3:]
    apex_time = np.maximum(vel[2], 0.0) / gravity
    apex = pos[2] + 0.5 * gravity * apex_time**2
    time = (vel[2] + np.sqrt(vel[2] ** 2 + 2.0 * gravity * (pos[2] - height))) / gravity
    time = np.where(apex >= height, time, np.nan)
    landing = pos + vel * time
    landing[2] -= 0.5 * gravity * time**2
    return apex, apex_time, landing, time


def _judge_impact(case: dict, drag_after_impact: bool, tolerances: dict) -> tuple[dict, dict]:
    durations, end = case["durations"], case["durations"].sum(axis=1)
    air, spins = np.stack([case["drag"], case["gravity"]]), "lift" in case
    if spins:
        around = case["lift"].T, case["around.wind"].T, case["around.reach"][None]
        air = np.concatenate([air, *around])
    state = np.concatenate([case["ball.pos"].T, case["ball.vel"].T])
    for _ in range(_INCOMING_STEPS):
        state = ball_step(state, end / _INCOMING_STEPS, air)
    tail = case["coeffs"][:, -1].transpose(1, 2, 0)
    pos, vel, normal = (judging.derivative(tail, durations[:, -1], order) for order in range(3))
    if "limits.air.drag" in case:  # the thrust is along a + g e_3 + d (v - w)
        normal += case["limits.air.drag"] * (vel - case["limits.air.wind"].T)
    normal[2] += case["gravity"]
    # Without thrust the racket's normal is set to zero. The ball's speed along it is 0, and the
    # plan fails the test "wrong face", which requires a negative speed.
    normal /= np.maximum(np.linalg.norm(normal, axis=0), np.finfo(float).tiny)
    racket = pos + case["racket_height"] * normal
    approach = ((state[3:] - vel) * normal).sum(axis=0)
    after = state.copy()
    push = -(1.0 + case["restitution"]) * approach
    after[3:] += push * normal
    if spins:
        from planner_jax.referee.spin import rub_ball  # the spin of few balls is known

        rub, air[2:5] = rub_ball(case, state[3:] - vel, normal, push)
        after[3:] += rub
    target = case["target"].T
    if drag_after_impact or spins:
        from planner_jax.referee.return_flight import return_in_air  # else in closed form

        returned = return_in_air(after, target[2], air)
    else:
        returned = _return_in_vacuum(after, target[2], case["gravity"])
    apex, apex_time, landing, flight_time = returned
    miss = np.linalg.norm(landing[:2] - target[:2], axis=0)
    measured = {
        "hitting_velocity": vel.T,
        "apex": apex,
        "landing_point": landing.T,
        "landing_error": np.where(np.isnan(miss), np.inf, miss),
        "contact_error": np.linalg.norm(racket - state[:3], axis=0),
    }
    apex_at = end + apex_time
    landing_at = np.where(np.isnan(flight_time), apex_at, end + flight_time)
    tests = _impact_tests(case, measured, tolerances, end, apex_at, landing_at)
    tests["wrong face"] = (approach >= 0.0, approach, end)
    tests["contact time"] = _contact_time(case, end, state)
    return measured, tests


def _impact_tests(case, measured, tolerances, end, apex_at, landing_at) -> dict:
    relative = tolerances["relative"]
    contact, landing = measured["contact_error"], measured["landing_error"]
    widest = np.minimum(tolerances["contact"], RIM * case.get("racket_radius", np.inf))
    lowest, highest = case["hit_limits.min_apex"], case["hit_limits.max_apex"]
    tests = {
        "contact": (~(contact <= widest), contact, end),
        "landing": (~(landing <= tolerances["landing"]), landing, landing_at),
        "apex low": judging.above(-measured["apex"], -lowest, relative, apex_at),
        "apex high": judging.above(measured["apex"], highest, relative, apex_at),
    }
    for axis, name in enumerate("xyz"):
        speed = np.abs(measured["hitting_velocity"][:, axis])
        limit = case["hit_limits.hitting_speed"][:, axis]
        tests[f"hitting speed {name}"] = judging.above(speed, limit, relative, end)
    return tests


def _contact_time(case: dict, end: np.ndarray, ball: np.ndarray) -> tuple:
    """Test that the impact is at the time `end` of the trajectory, with `ball` above the ground."""
    shortest = case["durations"].min(axis=1)
    claim = np.abs(case["stroke.time"] - end)
    height = np.minimum(case["ball.pos"][:, 2], ball[2])
    grounded = np.maximum(-height, 0.0) / np.maximum(np.abs(ball[5]), 1e-3)
    excess = np.maximum(np.maximum(claim, -shortest), grounded)
    is_late = claim > judging.CONTACT_TIME_TOLERANCE
    return is_late | (shortest <= 0.0) | (height <= 0.0), excess, end
