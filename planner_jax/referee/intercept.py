"""Float64 NumPy referee of interceptions: decides by kinematics whether a plan succeeds.

An interception is a car's drive to a moving target. The referee integrates the car's equations of
motion [Qu2022, eq. 1] with the plan's speed and curvature. It ignores the plan's status, cost and
meeting point. Only targets of a user's own class are code that planners run too. World frame in the
plane, SI units, headings counter-clockwise from the x axis.
"""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from planner_jax.referee import judging
from planner_jax.referee.clearance import clearances

_SENTENCES = {
    "not finite": "the plan or its case is not finite",
    "time": "the plan ends at {time:.3f} s, off by {excess:.3g} s; it must end after time 0, and "
    "not after the case's time nor after an hour",
    "start": "the plan starts {excess:.3g} off the case in position [m], heading [rad], speed "
    "[m/s] or curvature [1/m]",
    "speed": "{excess:.2%} of its limit above it or below zero at {time:.3f} s",
    **dict.fromkeys(
        ("acceleration", "curvature", "steering rate", "lateral acceleration"), judging.ABOVE_LIMIT
    ),
    "map": "the body's middle is {excess:.3g} m off the map at {time:.3f} s",
    "wall": "the body is {excess:.3g} m inside walls[{nearest_wall}] at {time:.3f} s",
    "mover": "the body is {excess:.3g} m inside movers[{nearest_mover}] at {time:.3f} s",
    "meeting": "the body's middle is {excess:.3g} m from the target at {time:.3f} s",
    "heading": "the heading is {excess:.3g} rad off the required one at {time:.3f} s",
}
LIMITS = tuple(_SENTENCES)
# Fields of a case that may be infinite, besides the limits of the car.
_UNBOUNDED = ("lower", "upper", "tolerance", "heading_tolerance")

LONGEST_STEP = 0.02  # [s], greatest time between two samples of the motion
LONGEST_PLAN = 3600.0  # [s], greatest time of a plan that the referee accepts
# Nodes and weights of the Gauss-Legendre quadrature by which velocities are integrated to
# positions; it is exact for polynomials up to degree 5.
_NODES = np.polynomial.legendre.leggauss(3)
_NODE, _WEIGHT = 0.5 * (_NODES[0] + 1.0), 0.5 * _NODES[1]


@dataclasses.dataclass(frozen=True)
class InterceptVerdict(judging.Verdict):
    """Verdict on B plans in which a car drives to a moving target.

    Measurements are NaN where the inputs are not finite or the plan's time is not in (0, 3600] s. A
    clearance is the body's least distance from an obstacle over the samples: negative if they
    overlap, and infinite without an obstacle.
    """

    SENTENCES = _SENTENCES

    max_speed: np.ndarray  # (B,) [m/s]
    max_acceleration: np.ndarray  # (B,) [m/s^2], |dv/dt|
    rms_acceleration: np.ndarray  # (B,) [m/s^2], sqrt(1/T int (dv/dt)^2 dt)
    max_curvature: np.ndarray  # (B,) [1/m], magnitude
    max_steering_rate: np.ndarray  # (B,) [rad/s], magnitude, of the angle atan(wheelbase curvature)
    max_lateral_acceleration: np.ndarray  # (B,) [m/s^2], magnitude, of the rear axle
    wall_clearance: np.ndarray  # (B,) [m], least distance of the body from a wall
    mover_clearance: np.ndarray  # (B,) [m], least distance from a moving obstacle
    nearest_wall: np.ndarray  # (B,) int, index of the nearest wall, or -1
    nearest_mover: np.ndarray  # (B,) int, index of the nearest moving obstacle, or -1
    miss: np.ndarray  # (B,) [m], from the body's middle to the target when the plan ends
    meeting_time: np.ndarray  # (B,) [s], when the plan ends

    def success_message(self, k: int | tuple) -> str:
        """Describe for plan `k`, a success, when the car meets the target and how exactly."""
        miss, time = np.asarray(self.miss)[k], np.asarray(self.meeting_time)[k]
        return f"the body's middle is {miss:.2g} m from the target after {time:.3g} s"


def referee_intercepts(
    cases,
    plans,
    *,
    truth=None,
    target_positions: Callable | None = None,
    tolerance: float = 1e-3,
    contact_tolerance: float = 1e-3,
) -> InterceptVerdict:
    """Decide for every plan of a batch of interceptions whether it succeeds.

    Speed and curvature are linear between the plan's K + 1 knots in time, so the heading is a cubic
    polynomial of time. Gauss-Legendre quadrature integrates the position between samples, exact to
    rounding. Speed, acceleration, curvature, steering rate and lateral acceleration are compared
    with their limits at their extrema, not at samples.

    The distances of the car's body from the map's border, from walls and from moving obstacles
    (movers) are tested at the knots and at samples between them, at most `LONGEST_STEP` apart: a
    car at 1.5 m/s drives 3 cm in this time. At a sample the distance from a polygon is exact.

    Target positions are computed in float64 for paths with the fields of `TurningPath` (recognised
    by `turn_rate`), `PolynomialPath` (`coeffs`), or a `LaterPath` (`path` and `begin`) of either.
    For other classes `pj.intercept.judge` calls the target's own method `at`, as planners do.

    Args:
        cases: object with the fields of `InterceptCase`, for B cases. Polygons are convex, in
            either orientation, and may repeat corners. Values of absent obstacles are ignored.
        plans: object with the fields of `InterceptPlan`; speed and curvature are (B, K + 1).
        truth: true paths of the B targets; they replace `cases.target`, which may be a prediction.
        target_positions: function `(target, times (B,) [s]) -> positions (B, 2) [m]` for targets
            of other classes. If passed, it is called for the known classes too.
        tolerance: relative tolerance of every limit of the car, the case's tolerance and its
            heading tolerance; absolute tolerance [SI] of the plan's first pose, speed, curvature.
        contact_tolerance: [m], greatest depth of the body in an obstacle, and greatest distance of
            its middle outside the map.

    Returns:
        An `InterceptVerdict` of float64 arrays. A plan with numbers that are not finite fails as
        "not finite". Limits, tolerances and the map's bounds may be infinite.

    Raises:
        ValueError: a leaf has the wrong shape, or the class of the target is not known.
    """
    leaves = _leaves(cases, plans)
    times = leaves["plan.time"].astype(np.float64)
    target = cases.target if truth is None else truth
    # Very large numbers may overflow. The verdict reports them, so NumPy's warnings are off.
    with np.errstate(all="ignore"):
        where = (target_positions or target_positions_of)(target, times)
    leaves["target"] = judging.check_leaf("target_positions", where, (*times.shape, 2))
    judge = functools.partial(_judge, relative=tolerance, contact=contact_tolerance)
    return InterceptVerdict(**judging.judge_in_chunks(judge, leaves, chunk=128))


_SHAPES: dict[str, tuple[int, ...]] = {
    **{"start": (3,), "lower": (2,), "upper": (2,), "speed": (), "curvature": (), "time": ()},
    **{"tolerance": (), "end_heading": (), "heading_tolerance": ()},
    **{f"body.{name}": () for name in ("length", "width", "wheelbase", "rear_overhang")},
    **{f"limits.{name}": () for name in ("speed", "acceleration", "lateral_acceleration")},
    **{f"limits.{name}": () for name in ("curvature", "steering_rate")},
}


def _leaves(cases, plans) -> dict[str, np.ndarray]:
    speed = np.asarray(plans.speed)
    if speed.ndim != 2 or speed.shape[1] < 2:
        raise ValueError(f"plan.speed must be (B, K + 1), K >= 1, got {speed.shape}")
    of_plan = {"start": (3,), "time": (), "curvature": speed.shape[1:], "speed": speed.shape[1:]}
    leaves = judging.read_leaves(plans, of_plan, len(speed), "plan.")
    leaves |= judging.read_leaves(cases, _SHAPES, len(speed))
    for name, group in (("walls", cases.walls), ("movers", cases.movers)):
        leaves |= _obstacle_leaves(name, group, len(speed))
    return leaves


def _obstacle_leaves(name: str, group, batch: int) -> dict[str, np.ndarray]:
    corners = np.asarray(group.corners)
    if corners.ndim != 4 or corners.shape[::3] != (batch, 2) or corners.shape[2] < 3:
        raise ValueError(f"{name}.corners must be ({batch}, N, V >= 3, 2), got {corners.shape}")
    shape = corners.shape[:2]
    present = judging.check_leaf(f"{name}.present", group.present, shape)
    centre = judging.check_leaf(f"{name}.centre", group.centre, (*shape, 2))
    velocity = judging.check_leaf(f"{name}.velocity", group.velocity, (*shape, 2))
    return {
        f"{name}.present": present,
        f"{name}.centre": np.where(present[..., None], centre, 0.0),
        f"{name}.velocity": np.where(present[..., None], velocity, 0.0),
        f"{name}.corners": np.where(present[..., None, None], corners, 0.0),
    }


def target_positions_of(target: object, times: np.ndarray) -> np.ndarray:
    """Return the positions (B, 2) [m] of B targets of the library's classes at `times` (B,) [s]."""
    fields, batch = getattr(target, "__dict__", {}), times.shape

    def leaf(name: str, *trailing: int) -> np.ndarray:
        array = judging.check_leaf(f"target.{name}", fields[name], batch + trailing)
        return array.astype(np.float64)

    if fields.keys() >= {"path", "begin"}:
        return target_positions_of(fields["path"], leaf("begin") + times)
    if "turn_rate" in fields:
        # The chord of a circular arc has the length (arc length) sinc(angle / 2). Its direction is
        # the initial direction, rotated by angle / 2.
        half = 0.5 * leaf("turn_rate") * times
        (x, y), chord = leaf("vel", 2).T, times * np.sinc(half / np.pi)
        cos, sin = np.cos(half), np.sin(half)
        direction = np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)
        return leaf("pos", 2) + chord[:, None] * direction
    if "coeffs" in fields:
        shape = np.shape(fields["coeffs"])
        if len(shape) != 3:
            raise ValueError(f"target.coeffs must be ({len(times)}, n + 1, 2), got {shape}")
        powers = (times - leaf("origin"))[:, None] ** np.arange(shape[1])
        return np.einsum("bk,bki->bi", powers, leaf("coeffs", shape[1], 2))
    raise ValueError(f"a target of class {type(target).__name__} needs target_positions")


def _judge(case: dict, relative: float, contact: float) -> dict:
    end = case["plan.time"]
    finite = judging.finite_lanes(case, _UNBOUNDED)
    driven = finite & (end > 0.0) & (end <= LONGEST_PLAN)
    span = np.where(driven, end, 0.0) / (case["plan.speed"].shape[1] - 1)
    measured, tests = _judge_limits(case, span, relative)
    times, poses = _integrate_poses(case, span)
    found, more = _judge_clearance(case, times, poses, contact)
    measured, tests = measured | found, tests | more
    middle, heading = poses[:, -1, :2], poses[:, -1, 2]
    miss = np.linalg.norm(middle - case["target"], axis=1)
    off = np.abs(_wrap(heading - case["end_heading"]))
    tests["start"] = _start(case, relative)
    tests["meeting"] = (miss > case["tolerance"] * (1.0 + relative), miss, end)
    tests["heading"] = (off > case["heading_tolerance"] * (1.0 + relative), off, end)
    tests = judging.clear_where(~driven, tests)
    late = end - np.minimum(case["time"], LONGEST_PLAN)
    tests["time"] = (
        (late > judging.CONTACT_TIME_TOLERANCE) | (finite & ~driven),
        np.where(finite, np.maximum(late, -end), 0.0),
        end,
    )
    measured |= {"miss": miss, "meeting_time": end}
    for name, value in measured.items():
        measured[name] = np.where(driven, value, -1 if value.dtype.kind == "i" else np.nan)
    return judging.first_failures(tests, LIMITS, finite) | measured


def final_poses(plans, body) -> np.ndarray:
    """Return the rear axles' poses (x [m], y [m], heading [rad]) at the end of B plans, (B, 3)."""
    case = {f"plan.{name}": getattr(plans, name) for name in ("start", "speed", "curvature")}
    case |= {f"body.{name}": getattr(body, name) for name in ("length", "rear_overhang")}
    case = {name: np.asarray(leaf, np.float64) for name, leaf in case.items()}
    end = np.asarray(plans.time, np.float64)
    # For a plan whose time is not in (0, `LONGEST_PLAN`], the start pose is returned.
    end = np.where((end > 0.0) & (end <= LONGEST_PLAN), end, 0.0)
    span = end / (case["plan.speed"].shape[1] - 1)
    with np.errstate(all="ignore"):
        pose = _integrate_poses(case, span)[1][:, -1]
    ahead = 0.5 * case["body.length"] - case["body.rear_overhang"]
    pose[:, 0] -= ahead * np.cos(pose[:, 2])
    pose[:, 1] -= ahead * np.sin(pose[:, 2])
    return pose


def _wrap(angle: np.ndarray) -> np.ndarray:
    return np.arctan2(np.sin(angle), np.cos(angle))


def _start(case: dict, allowed: float) -> tuple:
    away = case["plan.start"] - case["start"]
    errors = [
        np.linalg.norm(away[:, :2], axis=1),
        np.abs(_wrap(away[:, 2])),
        np.abs(case["plan.speed"][:, 0] - case["speed"]),
        np.abs(case["plan.curvature"][:, 0] - case["curvature"]),
    ]
    worst = np.max(errors, axis=0)
    return worst > allowed, worst, np.zeros_like(worst)


def _greatest(values: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    lanes, top = np.arange(len(values)), values.argmax(axis=1)
    return values[lanes, top], np.broadcast_to(times, values.shape)[lanes, top]


def _judge_limits(case: dict, span: np.ndarray, relative: float) -> tuple[dict, dict]:
    v, k, h = case["plan.speed"], case["plan.curvature"], span[:, None]
    knots = h * np.arange(v.shape[1])
    v0, k0, k1, starts = v[:, :-1], k[:, :-1], k[:, 1:], knots[:, :-1]
    rise, bend = np.diff(v) / h, np.diff(k) / h
    # The steering angle atan(L k), of wheelbase L and curvature k, has the rate L k' / (1 + L^2
    # k^2). In a piece k' is constant, so the rate is greatest where |k| is least.
    zero = np.clip(np.where(bend == 0.0, 0.0, -k0 / bend), 0.0, h)
    zero = np.where(k0 * k1 < 0.0, zero, np.where(np.abs(k0) <= np.abs(k1), 0.0, h))
    least = np.where(k0 * k1 < 0.0, 0.0, np.minimum(np.abs(k0), np.abs(k1)))
    wheelbase = case["body.wheelbase"][:, None]
    steering = np.abs(wheelbase * bend) / (1.0 + (wheelbase * least) ** 2)
    # The lateral acceleration v^2 k, of speed v and curvature k, has its extrema where v = 0, and
    # where 2 v' k + v k' = 0.
    slope = 3.0 * rise * bend
    inside = np.where(slope == 0.0, 0.0, -(2.0 * rise * k0 + bend * v0) / slope)
    inside = np.clip(inside, 0.0, h)
    bent = (v0 + rise * inside) ** 2 * (k0 + bend * inside)
    lateral = np.abs(np.concatenate([v**2 * k, bent], axis=1))
    lateral_times = np.concatenate([knots, starts + inside], axis=1)
    peaks = {
        "speed": _greatest(v, knots),
        "acceleration": _greatest(np.abs(rise), starts),
        "curvature": _greatest(np.abs(k), knots),
        "steering rate": _greatest(steering, starts + zero),
        "lateral acceleration": _greatest(lateral, lateral_times),
    }
    measured = {f"max_{name.replace(' ', '_')}": value for name, (value, _) in peaks.items()}
    measured["rms_acceleration"] = np.sqrt(np.mean(rise**2, axis=1))
    tests = {
        name: judging.above(value, case[f"limits.{name.replace(' ', '_')}"], relative, time)
        for name, (value, time) in peaks.items()
    }
    # The car may not drive backwards. A negative speed fails the test of the speed limit.
    limit = case["limits.speed"][:, None]
    scale = np.where(np.isinf(limit), 1.0, np.maximum(limit, judging.SMALLEST_LIMIT))
    excess, when = _greatest(np.maximum(v - limit, -v) / scale, knots)
    tests["speed"] = (excess > relative, excess, when)
    return measured, tests


def _integrate_poses(case: dict, span: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times (B, S) [s] and poses (B, S, 3) of the body's middle; knots are `span` apart."""
    v, k = case["plan.speed"][..., None], case["plan.curvature"][..., None]
    num, h = v.shape[1] - 1, span[:, None, None]
    v0, k0 = v[:, :-1], k[:, :-1]
    rise, bend = (np.where(h > 0.0, np.diff(each, axis=1) / h, 0.0) for each in (v, k))

    def heading_change(tau: np.ndarray) -> np.ndarray:
        return tau * (v0 * k0 + tau * (0.5 * (v0 * bend + rise * k0) + tau * rise * bend / 3.0))

    count = np.maximum(np.ceil(span / LONGEST_STEP - 1e-9), 1.0)
    most = int(count.max(initial=1.0))
    tau = span[:, None] * np.minimum(np.arange(most + 1) / count[:, None], 1.0)  # (B, most + 1)
    whole = heading_change(h)[..., 0]
    before = case["plan.start"][:, 2:] + np.cumsum(whole, axis=1) - whole  # (B, K)
    moved = np.zeros((len(v), num, most, 2))
    for node, weight in zip(_NODE, _WEIGHT, strict=True):
        at = (tau[:, :-1] + node * np.diff(tau, axis=1))[:, None]
        angle = before[..., None] + heading_change(at)
        length = weight * np.diff(tau, axis=1)[:, None] * (v0 + rise * at)
        moved[..., 0] += length * np.cos(angle)
        moved[..., 1] += length * np.sin(angle)
    headings = (before[..., None] + heading_change(tau[:, None, :-1])).reshape(len(v), num * most)
    last = before[:, -1:] + whole[:, -1:]
    times = (span[:, None] * np.arange(num))[..., None] + tau[:, None, :-1]
    times = np.concatenate([times.reshape(len(v), num * most), num * span[:, None]], axis=1)
    poses = np.zeros((*times.shape, 3))
    poses[..., 2] = np.concatenate([headings, last], axis=1)
    poses[:, 1:, :2] = np.cumsum(moved.reshape(len(v), num * most, 2), axis=1)
    ahead = 0.5 * case["body.length"] - case["body.rear_overhang"]
    poses[..., 0] += case["plan.start"][:, 0, None] + ahead[:, None] * np.cos(poses[..., 2])
    poses[..., 1] += case["plan.start"][:, 1, None] + ahead[:, None] * np.sin(poses[..., 2])
    return times, poses


def _judge_clearance(case: dict, times: np.ndarray, poses: np.ndarray, contact: float) -> tuple:
    middle = poses[..., :2]
    outside = np.maximum(case["lower"][:, None] - middle, middle - case["upper"][:, None])
    off, when = _greatest(outside.max(axis=2), times)
    tests, measured = {"map": (off > contact, off, when)}, {}
    half = 0.5 * np.stack([case["body.length"], case["body.width"]], axis=1)
    for name, one in (("walls", "wall"), ("movers", "mover")):
        group = {key: case[f"{name}.{key}"] for key in ("centre", "velocity", "corners", "present")}
        least, when, nearest = clearances(group, half, times, poses)
        measured |= {f"{one}_clearance": least, f"nearest_{one}": nearest}
        tests[one] = (-least > contact, -least, when)
    return measured, tests
