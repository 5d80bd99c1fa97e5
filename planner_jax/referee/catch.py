"""Float64 NumPy referee of catches: decides by physics whether a plan succeeds.

A catch is a quadrotor's meeting with a moving target in the hoop of its net. `referee.quadrotor`
checks the flight, this module the plan's order of targets, catch times and targets' positions. Of
the planners' code it runs only limits that a user adds. World frame, z up, SI units.

Equations of [Yu2023catch]: a ball with linear drag (eq. 9a); the net's centre p + l z_d at the
height l above the quadrotor's position p (eq. 22); and the angle between z_d and minus the ball's
velocity (eq. 25). The unit vector z_d points along the thrust.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal

import numpy as np

from planner_jax.referee import judging, quadrotor
from planner_jax.referee.air import load_pieces
from planner_jax.referee.recovery import append_recovery

_ORDER_OF_MOTION = (
    *("head state", "continuity", "speed", "thrust low", "thrust high", "body rate"),
    *("heading start", "heading jump", "yaw rate"),
    *("acceleration", "rotor low", "rotor high", "tilt", "ground", "extra", "recovery"),
)
_SENTENCES = {
    "not finite": judging.NOT_FINITE,
    "order": "{excess:.0f} wrong entries, the first at {time:.3f} s; caught targets must be named "
    "once, before the others",
    "catch time": "off by {excess:.3g} s at {time:.3f} s; catches must be at rising positive "
    "times, where their pieces end, and not after the target's horizon",
    **{name: quadrotor.MOTION_SENTENCES[name] for name in _ORDER_OF_MOTION},
    "net": "the target is {excess:.2%} outside the hoop's radius at {time:.3f} s",
    "net plane": "the target is {excess:.3g} m off the hoop's plane at {time:.3f} s",
    "angle": "{excess:.2%} above its limit between the net's axis and minus the target's velocity "
    "at {time:.3f} s",
}
LIMITS = tuple(_SENTENCES)

# [m/s] A slower target counts as standing still, and the angle between net and velocity is not
# tested, because rounding determines the direction of so small a velocity.
SLOWEST_TARGET = 1e-6


@dataclasses.dataclass(frozen=True)
class CatchVerdict(judging.FlightVerdict):
    """Verdict on B plans in which a quadrotor catches up to N targets each.

    Arrays (B, N) are in the order of the catches, like the plan's `order` and `times`. Their
    entries are NaN after the last catch, and where the plan names an absent or repeated target.
    """

    SENTENCES = _SENTENCES
    UNBOUNDED = quadrotor.MOTION_UNBOUNDED

    net_distance: np.ndarray  # (B, N) [m], from the net's centre to the target at the catch
    net_offset: np.ndarray  # (B, N) [m], height of the target above the hoop's plane at the catch
    # (B, N) [rad], angle between the net's axis and minus the target's velocity; NaN for a target
    # that stands still.
    angle: np.ndarray
    catch_times: np.ndarray  # (B, N) [s], end of the pieces up to each catch
    caught: np.ndarray  # (B, N) bool, whether the tests of order, catch time, net and angle pass
    num_caught: np.ndarray  # (B,) int, number of caught targets

    def success_message(self, k: int | tuple) -> str:
        """Describe for plan `k`, a success, how many targets it catches, and the greatest miss."""
        if not (number := int(np.asarray(self.num_caught)[k])):
            return "there is no target to catch"
        farthest = np.nanmax(self.net_distance[k])
        return f"{number} caught, at most {farthest:.2g} m from the net's centre"


def referee_catches(
    cases,
    plans,
    *,
    target_states: Callable | None = None,
    net_test: Literal["plane", "ball"] = "plane",
    tolerance: float = 1e-3,
    contact_tolerance: float = 5e-3,
    continuity_tolerance: float = 1e-4,
) -> CatchVerdict:
    """Decide for every plan of a batch of catches whether it succeeds.

    The trajectory has M pieces for each target. Catch i = 0, 1, ... in the plan's order is at the
    end of piece (i + 1) M - 1. Absent targets are ignored, and so are pieces of zero duration after
    the last catch. If targets are optional, the pieces with a duration determine the number of
    catches, and each of these catches is judged.

    Target positions are computed in float64 for paths with the fields of `BallPath` (recognised by
    `ball`), `HarmonicPath` (`amplitude`) or `PathTable` (`resolution`). The arguments
    `tolerance=0.05, net_test="ball"` reproduce the success criterion of [Yu2023catch].

    Args:
        cases: object with the fields of `CatchCase`, for B cases of N targets. Unless `optional`,
            all present targets must be caught. The case's own order and times are not read.
        plans: object with the fields of `CatchPlan`, for B plans of polynomial pieces of degree D:
            coefficients (B, N * M, D + 1, 3), durations (B, N * M).
        target_states: function `(targets, order, times) -> (pos, vel)` for targets of other
            classes, with order (B, N) int, times (B, N) [s], pos and vel (B, N, 3) [m], [m/s].
            Entry [b, i] is of target `order[b, i]` of case b at `times[b, i]`. Values for absent
            targets are ignored. If passed, the function is called for the known classes too.
        net_test: "plane" requires that the target is within `contact_tolerance` of the hoop's plane
            and within the net's radius of the hoop's axis. "ball" requires only that the target is
            within the net's radius of the hoop's centre.
        tolerance: relative tolerance of all limits of the case, also of the net's radius and angle.
        contact_tolerance: [m], greatest distance between target and hoop's plane at the catch.
        continuity_tolerance: greatest displacement at time 0 and between pieces, relative to the
            largest coordinate at the ends of the pieces (at least 1 m).

    Returns:
        A `CatchVerdict` of float64 arrays. A plan with numbers that are not finite fails as "not
        finite". Limits of a case, also the net's radius, its angle and a horizon, may be infinite.

    Raises:
        ValueError: an array has the wrong shape, the class of the targets is not known, or
            `net_test` is neither "plane" nor "ball".
    """
    if net_test not in ("plane", "ball"):
        raise ValueError(f'net_test must be "plane" or "ball", got {net_test!r}')
    leaves = _read(cases, plans)
    shape = leaves["present"].shape
    # Very large numbers may overflow. The verdict reports them, so NumPy's warnings are off.
    with np.errstate(all="ignore"):
        order = np.nan_to_num(leaves["order"].astype(np.float64))
        order = np.clip(np.rint(order), 0, shape[1] - 1).astype(np.int64)
        times = _ends(leaves["durations"].astype(np.float64), shape[1])
        if target_states is None:
            pos, vel = _follow_targets(cases.targets, order, times)
        else:
            pos, vel = target_states(cases.targets, order, times)
    leaves["target pos"] = judging.check_leaf("target_states' pos", pos, (*shape, 3))
    leaves["target vel"] = judging.check_leaf("target_states' vel", vel, (*shape, 3))
    tolerances = {"relative": tolerance, "contact": contact_tolerance}
    tolerances["continuity"] = continuity_tolerance
    judge = functools.partial(
        _judge,
        extras=cases.extras,
        intervals=quadrotor.intervals_of(leaves["durations"].shape[1] // shape[1]),
        net_test=net_test,
        optional=bool(cases.optional),
        tolerances=tolerances,
    )
    return CatchVerdict(**judging.judge_in_chunks(judge, leaves, chunk=2048))


def _read(cases, plans) -> dict[str, np.ndarray]:
    coeffs, present = quadrotor.check_coeffs(plans.trajectory.coeffs), np.asarray(cases.present)
    batch, pieces = coeffs.shape[:1], coeffs.shape[1]
    if present.ndim != 2 or present.shape[:1] != batch or 0 in present.shape[1:]:
        raise ValueError(f"present must be ({batch[0]}, N), got {present.shape}")
    num = present.shape[1]
    if pieces % num:
        raise ValueError(f"coeffs must have N * M pieces for N = {num} targets, got {pieces}")
    leaves = quadrotor.read_flight(cases, plans) | {"present": present}
    shapes = {"horizon": (num,), "head_state": (4, 3)}
    shapes |= {"net.height": (), "net.radius": (), "net.max_angle": ()}
    leaves |= judging.read_leaves(cases, shapes, len(coeffs))
    return leaves | judging.read_leaves(plans, {"order": (num,), "times": (num,)}, len(coeffs))


def _ends(durations: np.ndarray, num: int) -> np.ndarray:
    each = durations.shape[1] // num
    return np.cumsum(durations, axis=1)[:, each - 1 :: each]


def _follow_targets(targets, order: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the position and velocity of target order[b, i] of case b at the time times[b, i]."""
    lanes, finite = np.arange(len(order))[:, None], np.ones(order.shape, bool)

    def leaf(name: str, value, *trailing: int) -> np.ndarray:
        value = judging.check_leaf(f"targets.{name}", value, order.shape + trailing)
        value = value[lanes, order].astype(np.float64)
        finite[...] &= np.isfinite(value).all(axis=tuple(range(2, value.ndim)))
        return value

    fields = dir(targets)
    if "ball" in fields:
        states = _ball_states(
            leaf("ball.pos", targets.ball.pos, 3),
            leaf("ball.vel", targets.ball.vel, 3),
            leaf("drag", targets.drag, 3),
            leaf("gravity", targets.gravity),
            times,
        )
    elif "amplitude" in fields:
        vel, amplitude = leaf("vel", targets.vel, 3), leaf("amplitude", targets.amplitude, 3)
        rate = leaf("rate", targets.rate)[..., None]
        angle = rate * times[..., None] + leaf("phase", targets.phase)[..., None]
        pos = leaf("pos", targets.pos, 3) + vel * times[..., None] + amplitude * np.sin(angle)
        states = pos, vel + amplitude * rate * np.cos(angle)
    elif "resolution" in fields:
        nodes = np.shape(targets.pos)[2] if np.ndim(targets.pos) == 4 else 0
        if nodes < 4:
            raise ValueError(f"targets.pos must be (B, N, T >= 4, 3), got {np.shape(targets.pos)}")
        states = _table_states(
            leaf("pos", targets.pos, nodes, 3),
            leaf("vel", targets.vel, nodes, 3),
            leaf("resolution", targets.resolution),
            times,
        )
    else:
        raise ValueError(f"targets of class {type(targets).__name__} need target_states")
    pos, vel = (np.where(finite[..., None], state, np.nan) for state in states)
    return pos, vel


def _ball_states(start, vel, drag, gravity, times) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities (B, N, 3) of N balls of B cases, with linear drag.

    For position s_0 and velocity v_0 at time 0, drag K [1/s], gravity g and x = K t it is at
    s_0 + (v_0 - g / K) (1 - e^-x) / K + g t / K [Yu2023catch, eq. 9a]. This is computed as
    s_0 + v_0 t f(x) + g t^2 h(x) with f = (1 - e^-x) / x and h = (1 - f) / x, which allows K = 0.
    For small x, the series h = 1/2! - x/3! + x^2/4! - ... is summed to rounding.
    """
    times = times[..., None]
    x = drag * times
    series, term = np.zeros_like(x), np.full_like(x, 0.5)
    for k in range(3, 18):
        series += term
        term *= -x / k
    small = np.abs(x) < 0.5
    divisor = np.where(small, 1.0, x)
    f = np.where(small, 1.0 - x * series, -np.expm1(-divisor) / divisor)
    h = np.where(small, series, (divisor + np.expm1(-divisor)) / divisor**2)
    pull = gravity[..., None] * [0.0, 0.0, -1.0]
    return start + times * (vel * f + pull * times * h), vel * np.exp(-x) + pull * times * f


def _table_states(pos, vel, resolution, times) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate positions and velocities of targets, which are stored at equal time steps.

    Entry k of a table is at time (k - 1) * resolution. The interpolation is cubic convolution with
    the parameter a = -1/2 [Keys1981]. Before and after the table's times the velocity is constant.
    """
    last = pos.shape[2] - 3
    inside = np.minimum(np.maximum(times, 0.0), last * resolution)
    position = np.nan_to_num(inside / resolution)
    first = np.clip(np.floor(position), 0, last - 1)
    u = (position - first)[..., None]

    def read(nodes: np.ndarray) -> np.ndarray:
        window = first.astype(np.int64)[..., None, None] + np.arange(4)[:, None]
        before, left, right, after = np.moveaxis(np.take_along_axis(nodes, window, 2), 2, 0)
        rise, slope, end_slope = right - left, 0.5 * (right - before), 0.5 * (after - left)
        bend, twist = 3.0 * rise - 2.0 * slope - end_slope, slope + end_slope - 2.0 * rise
        return left + u * (slope + u * (bend + u * twist))

    at = read(vel)
    return read(pos) + (times - inside)[..., None] * at, at


def _judge(
    case: dict, extras: tuple, intervals: int, net_test: str, optional: bool, tolerances: dict
) -> dict:
    durations, present = case["durations"], case["present"] != 0.0
    num = present.shape[1]
    ends = _ends(durations, num)
    each = durations.shape[1] // num
    number = present.sum(axis=1, keepdims=True)
    if optional:
        planned = (durations.reshape(len(durations), num, each) != 0.0).any(axis=2)
        number = np.minimum(planned.cumprod(axis=1).sum(axis=1, keepdims=True), number)
    due = np.arange(num) < number
    flown = np.repeat(due, each, axis=1) | (durations != 0.0)
    pieces = quadrotor.pieces_of(case["coeffs"], durations, flown)
    right, target = _test_order(case["order"], present, due, optional)
    lanes = np.arange(len(due))
    wrong = (~right).sum(axis=1).astype(np.float64)
    order_test = (wrong > 0.0, wrong, ends[lanes, right.argmin(axis=1)])
    held = due & right
    # The arrays of catches have N entries. Entries behind the last catch may hold any numbers, also
    # NaN, and are replaced by values that pass all tests.
    case = case | {
        "coeffs": np.moveaxis(pieces.coeffs, 0, -1),
        "order": np.where(due, case["order"], 0.0),
        "times": np.where(due, case["times"], 0.0),
        "horizon": np.where(held, case["horizon"][lanes[:, None], target], np.inf),
        "target pos": np.where(held[..., None], case["target pos"], 0.0),
        "target vel": np.where(held[..., None], case["target vel"], 0.0),
    }
    whole = append_recovery(pieces, case) if "recovery.coeffs" in case else pieces
    motion, tests = quadrotor.judge_motion(
        whole, case, extras, intervals, tolerances["relative"], tolerances["continuity"]
    )
    tests = judging.clear_where(np.logical_not(whole.flown.any(axis=1)), tests)
    measured, catch_tests = _judge_catches(case, pieces, held, ends, net_test, tolerances)
    tests |= {name: _worst(test, held) for name, test in catch_tests.items()}
    tests["order"] = order_test
    finite = judging.finite_lanes(case, ("horizon", "net.radius", "net.max_angle"))
    verdict = judging.first_failures(tests, LIMITS, finite)
    caught = held & (verdict["failed_limit"] != LIMITS[0])[:, None]
    for failed, _, _ in catch_tests.values():
        caught &= ~failed
    return verdict | motion | measured | {"caught": caught, "num_caught": caught.sum(axis=1)}


def _test_order(
    order: np.ndarray, present: np.ndarray, due: np.ndarray, optional: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Test the order in which B plans catch N targets; all arrays are (B, N).

    Entries of `order` where `due` is true are catches and must name present targets. Other entries
    must name absent targets, or any targets if targets are optional. No target may be named twice.
    Returns whether each entry is right, and the target that it names.
    """
    num = due.shape[1]
    order = np.nan_to_num(order, nan=-1.0)
    named = (order == np.rint(order)) & (order >= 0.0) & (order < num)
    target = np.where(named, order, 0.0).astype(np.int64)
    same = (target[:, :, None] == target[:, None, :]) & named[:, None, :]
    repeated = np.tril(same, -1).any(axis=2)
    kind = present[np.arange(len(due))[:, None], target]
    fits = kind | ~due if optional else kind == due
    return named & fits & ~repeated, target


def _judge_catches(case, pieces, held, ends, net_test: str, tolerances: dict) -> tuple[dict, dict]:
    each = pieces.durations.shape[1] // held.shape[1]
    spans = pieces.durations[:, each - 1 :: each]
    pos, acc = (
        np.moveaxis(judging.derivative(np.moveaxis(tail, -1, 0), spans, order), 0, -1)
        for tail, order in (
            (pieces.coeffs[:, :, each - 1 :: each], 0),
            (load_pieces(pieces, case).coeffs[:, :, each - 1 :: each], 2),
        )
    )
    thrust = acc + case["gravity"][:, None, None] * [0.0, 0.0, 1.0]
    size = np.linalg.norm(thrust, axis=-1, keepdims=True)
    # Without thrust the net's axis has no direction: it is set to 0, and the angle is set to pi.
    axis = thrust / np.maximum(size, np.finfo(float).tiny)
    centre = pos + case["net.height"][:, None, None] * axis
    miss, vel = case["target pos"] - centre, case["target vel"]
    offset = (miss * axis).sum(axis=-1)
    distance = np.linalg.norm(miss, axis=-1)
    across = np.linalg.norm(miss - offset[..., None] * axis, axis=-1)
    sine, cosine = np.linalg.norm(np.cross(axis, vel), axis=-1), -(axis * vel).sum(axis=-1)
    angle = np.where(size[..., 0] > 0.0, np.arctan2(sine, cosine), np.pi)
    at_rest = np.linalg.norm(vel, axis=-1) <= SLOWEST_TARGET
    radius, widest = case["net.radius"], case["net.max_angle"]
    relative = tolerances["relative"]
    from_axis = distance if net_test == "ball" else across
    from_plane = np.zeros_like(offset) if net_test == "ball" else np.abs(offset)
    tests = {
        "catch time": _catch_time(case, held, ends),
        "net": judging.above(from_axis, radius[:, None], relative, ends),
        "net plane": (from_plane > tolerances["contact"], from_plane, ends),
        "angle": judging.above(np.where(at_rest, 0.0, angle), widest[:, None], relative, ends),
    }
    measured = {
        "net_distance": np.where(held, distance, np.nan),
        "net_offset": np.where(held, offset, np.nan),
        "angle": np.where(held & ~at_rest, angle, np.nan),
        "catch_times": np.where(held, ends, np.nan),
    }
    return measured, tests


def _catch_time(case: dict, held: np.ndarray, ends: np.ndarray) -> tuple:
    each = case["durations"].shape[1] // held.shape[1]
    shortest = case["durations"].reshape(*held.shape, each).min(axis=2)
    after = np.where(held, 0.0, shortest).min(axis=1, keepdims=True)
    shortest = np.where(after < 0.0, np.minimum(shortest, after), shortest)
    off = np.maximum(np.abs(case["times"] - ends), ends - case["horizon"])
    is_late = off > judging.CONTACT_TIME_TOLERANCE
    return is_late | (shortest <= 0.0), np.maximum(off, -shortest), ends


def _worst(test: tuple, held: np.ndarray) -> tuple:
    failed, excess, time = test
    failed = failed & held
    value = np.where(failed | (held & np.isnan(excess)), excess, -np.inf)
    pick, lanes = value.argmax(axis=1), np.arange(len(value))
    return failed.any(axis=1), value[lanes, pick], time[lanes, pick]
