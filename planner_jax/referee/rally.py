"""Float64 NumPy referee of rallies: follows the ball from hit to hit, and decides by physics.

`referee.quadrotor` checks the flight. This module integrates the ball with drag to the first
contact, applies the impact of the racket as the trajectory has it there, flies on to the second
contact, and so on. An error of one hit thus changes all later flights. Equations are as in
`referee.hit`. World frame, z up, SI units.
"""

import dataclasses
import functools

import numpy as np

from planner_jax.referee import judging, quadrotor
from planner_jax.referee.hit import RIM, ball_step
from planner_jax.referee.return_flight import return_in_air

_SENTENCES = {
    "not finite": judging.NOT_FINITE,
    "contact time": "hit {failed_hit} is off by {excess:.3g} s; the times must increase from 0 to "
    "the end of the trajectory, with the ball above the ground",
    **quadrotor.MOTION_SENTENCES,
    **{f"hitting speed {axis}": "hit {failed_hit}: " + judging.ABOVE_LIMIT for axis in "xyz"},
    "contact": "hit {failed_hit}: the racket centre is {excess:.3g} m from the ball at {time:.3f} "
    "s",
    "wrong face": "hit {failed_hit}: the ball leaves the racket's face at {excess:.3g} m/s at "
    "{time:.3f} s",
    "contact low": "hit {failed_hit}: {excess:.2%} below the least height at {time:.3f} s",
    "contact high": "hit {failed_hit}: {excess:.2%} above the greatest height at {time:.3f} s",
    "apex low": "after hit {failed_hit}: {excess:.2%} below the least apex at {time:.3f} s",
    "apex high": "after hit {failed_hit}: {excess:.2%} above the greatest apex at {time:.3f} s",
    "place": "after hit {failed_hit}: the ball comes {excess:.3g} m beside its box at {time:.3f} s",
    "planned place": "after hit {failed_hit}: the ball comes {excess:.3g} m beside the planned "
    "place at {time:.3f} s",
}
LIMITS = tuple(_SENTENCES)
_STEPS = 60  # number of Runge-Kutta steps of the ball's flight to a contact


@dataclasses.dataclass(frozen=True)
class RallyVerdict(judging.FlightVerdict):
    """Verdict on B plans of K hits each, with measurements of every contact and flight."""

    SENTENCES = _SENTENCES
    UNBOUNDED = quadrotor.MOTION_UNBOUNDED

    failed_hit: np.ndarray  # (B,) int, number of the hit that fails, from 1; 0 for other limits
    hitting_velocity: np.ndarray  # (B, K, 3) [m/s], of the quadrotor at the contacts
    contact_error: np.ndarray  # (B, K) [m], distance of racket centre and ball at the contacts
    apex: np.ndarray  # (B, K) [m], greatest height of the ball after each contact
    # (B, K) [m], distance of the ball from the planned place, at the next contact. After the last
    # contact: the horizontal distance where the ball falls to the height of the planned place.
    place_error: np.ndarray

    def success_message(self, k: int | tuple) -> str:
        """Describe for plan `k`, a success, how far the ball comes from the planned places."""
        contact, place = np.asarray(self.contact_error)[k], np.asarray(self.place_error)[k]
        return (
            f"{contact.size} hits within {1e3 * contact.max():.2g} mm of the racket's centre, and "
            f"{1e3 * place.max():.2g} mm of the planned places"
        )


def referee_rallies(
    cases,
    plans,
    *,
    tolerance: float = 1e-3,
    place_tolerance: float = 0.01,
    contact_tolerance: float = 5e-3,
    continuity_tolerance: float = 1e-4,
) -> RallyVerdict:
    """Decide for every plan of a batch of rallies whether all of its hits succeed.

    Args:
        cases: object with the fields of `RallyCase`, for B cases of K hits.
        plans: object with the fields of `RallyPlan`, for B plans of M polynomial pieces.
        tolerance: relative tolerance of every limit of the case.
        place_tolerance: [m], greatest distance of the ball from its box and from the planned place.
        contact_tolerance: [m], greatest distance between racket centre and ball at a contact. If
            the case has `racket_radius`, the distance may also not exceed 0.9 times the radius.
        continuity_tolerance: as in `referee_hits`.

    Returns:
        A `RallyVerdict` of float64 arrays. The ball of a hit follows from all hits before it.

    Raises:
        ValueError: an array has the wrong shape.
    """
    leaves = quadrotor.read_flight(cases, plans)
    num, hits = len(leaves["lane"]), np.shape(plans.places)[-2]
    names = ("min_apex", "max_apex", "min_contact", "max_contact")
    shapes = {
        **{"ball.pos": (3,), "ball.vel": (3,), "head_state": (4, 3), "drag": ()},
        **{"places": (hits, 3), "place_range": (hits, 3), "restitution": ()},
        **{
            "ball_time": (),
            "racket_height": (),
            "racket_radius": (),
            "hit_limits.hitting_speed": (3,),
        },
        **{f"hit_limits.{name}": () for name in names},
    }
    leaves |= judging.read_leaves(cases, shapes, num)
    shapes = {"strokes.time": (hits,), "places": (hits, 3)}
    leaves |= judging.read_leaves(plans, shapes, num, "plan.")
    judge = functools.partial(
        _judge,
        extras=cases.extras,
        intervals=quadrotor.intervals_of(leaves["durations"].shape[1] // hits),
        tolerances={
            "relative": tolerance,
            "place": place_tolerance,
            "contact": contact_tolerance,
            "continuity": continuity_tolerance,
        },
    )
    return RallyVerdict(**judging.judge_in_chunks(judge, leaves, chunk=1024))


def _judge(case: dict, extras: tuple, intervals: int, tolerances: dict) -> dict:
    pieces = quadrotor.pieces_of(case["coeffs"], case["durations"])
    measured, tests = quadrotor.judge_motion(
        pieces, case, extras, intervals, tolerances["relative"], tolerances["continuity"]
    )
    tests, numbers, hit_measurements = _judge_hits(case, tolerances, tests)
    result = judging.first_failures(tests, LIMITS, judging.finite_lanes(case))
    failed_hit = np.zeros(len(case["lane"]), int)
    for name, number in numbers.items():
        failed_hit = np.where(result["failed_limit"] == name, number, failed_hit)
    return result | measured | hit_measurements | {"failed_hit": failed_hit}


def _judge_hits(case: dict, tolerances: dict, tests: dict) -> tuple[dict, dict, dict]:
    """Follow the balls through all hits, and add tests; a test has the first hit that fails.

    Returns the tests (failed, excess, time), the number of the tested hit (B,) for each of the new
    tests, and measurements (B, K, ...).
    """
    ball = np.concatenate([case["ball.pos"].T, case["ball.vel"].T])
    contacts, returns, parts = [], [], []
    for k in range(case["plan.places"].shape[1]):
        contact, after, measured, own = _judge_contact(case, k, ball, tolerances)
        contacts.append(contact)
        returns.append(after)
        parts.append((measured, own))
        ball = after
    for k, (measured, own) in enumerate(parts):
        at_next = contacts[k + 1] if k + 1 < len(contacts) else None
        of_flight, more = _judge_flight(case, k, returns[k], at_next, tolerances)
        measured |= of_flight
        own |= more
    new, numbers, lanes = {}, {}, np.arange(len(case["lane"]))
    for name in parts[0][1]:
        failed, excess, time = (np.stack([own[name][i] for _, own in parts]) for i in range(3))
        hit = np.where(failed.any(axis=0), failed.argmax(axis=0), excess.argmax(axis=0))
        new[name] = failed.any(axis=0), excess[hit, lanes], time[hit, lanes]
        numbers[name] = hit + 1
    found = {name: np.stack([each[name] for each, _ in parts], axis=1) for name in parts[0][0]}
    return tests | new, numbers, found


def _judge_contact(case: dict, k: int, ball: np.ndarray, tolerances: dict) -> tuple:
    """Follow balls (6, B) to contact k and through the impact.

    Returns the balls' states (6, B) just before and after the impact, measurements, and tests.
    """
    times, air = case["plan.strokes.time"], np.stack([case["drag"], case["gravity"]])
    time, before = times[:, k], times[:, k - 1] if k else case["ball_time"]
    for _ in range(_STEPS):
        ball = ball_step(ball, (time - before) / _STEPS, air)
    pos, vel, thrust = _motion_at(case, time)
    if "limits.air.drag" in case:  # the thrust is along a + g e_3 + d (v - w)
        thrust += case["limits.air.drag"] * (vel - case["limits.air.wind"].T)
    thrust[2] += case["gravity"]
    # Without thrust the normal is set to zero, and the plan fails the test "wrong face".
    normal = thrust / np.maximum(np.linalg.norm(thrust, axis=0), np.finfo(float).tiny)
    error = np.linalg.norm(pos + case["racket_height"] * normal - ball[:3], axis=0)
    approach = ((ball[3:] - vel) * normal).sum(axis=0)
    after = ball.copy()
    after[3:] -= (1.0 + case["restitution"]) * approach * normal

    relative, limits = tolerances["relative"], "hit_limits."
    widest = np.minimum(tolerances["contact"], RIM * case.get("racket_radius", np.inf))
    total, is_last = case["durations"].sum(axis=1), k == times.shape[1] - 1
    late = np.abs(time - total) if is_last else np.maximum(time - total, 0.0)
    grounded = np.maximum(-ball[2], 0.0) / np.maximum(np.abs(ball[5]), 1e-3)
    is_wrong = (late > judging.CONTACT_TIME_TOLERANCE) | (time <= before) | (ball[2] <= 0.0)
    tests = {
        "contact time": (is_wrong, np.maximum(np.maximum(late, before - time), grounded), time),
        "contact": (~(error <= widest), error, time),
        "wrong face": (approach >= 0.0, approach, time),
        "contact low": judging.above(-ball[2], -case[f"{limits}min_contact"], relative, time),
        "contact high": judging.above(ball[2], case[f"{limits}max_contact"], relative, time),
    }
    for axis, name in enumerate("xyz"):
        limit = case["hit_limits.hitting_speed"][:, axis]
        tests[f"hitting speed {name}"] = judging.above(np.abs(vel[axis]), limit, relative, time)
    return ball, after, {"hitting_velocity": vel.T, "contact_error": error}, tests


def _judge_flight(case: dict, k: int, ball: np.ndarray, at_next, tolerances: dict) -> tuple:
    """Measure and test the flights of balls (6, B) after contact k.

    `at_next` (6, B) are the balls at the next contact, None after the last contact.
    """
    planned, centre = case["plan.places"][:, k].T, case["places"][:, k].T
    start = case["plan.strokes.time"][:, k]
    found = return_in_air(ball, planned[2], np.stack([case["drag"], case["gravity"]]))
    apex, apex_time, point, duration = found
    if at_next is None:
        error = np.linalg.norm(point[:2] - planned[:2], axis=0)
    else:
        point, duration = at_next[:3], case["plan.strokes.time"][:, k + 1] - start
        error = np.linalg.norm(point - planned, axis=0)
    error = np.where(np.isnan(error), np.inf, error)
    beside = np.maximum(np.abs(point - centre) - case["place_range"][:, k].T, 0.0)
    beside = np.nan_to_num(np.linalg.norm(beside, axis=0), nan=np.inf)
    time = start + np.where(np.isnan(duration), apex_time, duration)
    relative, widest = tolerances["relative"], tolerances["place"]
    lowest, highest = (case[f"hit_limits.{name}_apex"] for name in ("min", "max"))
    tests = {
        "apex low": judging.above(-apex, -lowest, relative, start + apex_time),
        "apex high": judging.above(apex, highest, relative, start + apex_time),
        "place": (beside > widest, beside, time),
        "planned place": (error > widest, error, time),
    }
    return {"apex": apex, "place_error": error}, tests


def _motion_at(case: dict, time: np.ndarray) -> list[np.ndarray]:
    """Return position, velocity and acceleration (3, B) of B trajectories at times (B,) [s]."""
    ends = case["durations"].cumsum(axis=1)
    piece = np.minimum((time[:, None] > ends).sum(axis=1), ends.shape[1] - 1)
    lanes = np.arange(len(time))
    local = time - (ends - case["durations"])[lanes, piece]
    coeffs = case["coeffs"][lanes, piece].transpose(1, 2, 0)
    return [judging.derivative(coeffs, local, order) for order in range(3)]
