"""Float64 NumPy referee of interceptions: decides by kinematics whether a plan succeeds.

An interception is a car's drive to a moving target. The referee integrates the car's equations of
motion [Qu2022, eq. 1] with the plan's speed and curvature, and tests that the car touches nothing
[Qu2022, eqs 7 and 8c]. It ignores the plan's status, cost and meeting point. Only targets of a
user's own class are code that planners run too. World frame in the plane, SI units, headings
counter-clockwise from the x axis. Positions of a case and its plan are relative to the case's
origin.
"""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from planner_jax.referee import judging
from planner_jax.referee.clearance import clearances, edges, greatest_speeds, separation
from planner_jax.referee.drive import LONGEST_PLAN, LONGEST_STEP, sample_poses

_SENTENCES = {
    "not finite": judging.NOT_FINITE,
    "time": "the plan ends at {time:.3f} s, off by {excess:.3g} s; it must end after time 0, and "
    "not after the case's time nor after an hour",
    "early": "the plan ends at {time:.3f} s, {excess:.3g} s before the earliest time",
    "origin": "the origin of the plan's positions is {excess:.3g} m from the case's origin",
    "start": "the plan starts {excess:.3g} off the case in position [lengths of the body], heading "
    "[rad], speed [speed limits] or curvature [1 / length of the body]",
    "speed": "{excess:.2%} of its limit above it, or too fast in reverse, at {time:.3f} s",
    **dict.fromkeys(
        ("acceleration", "jerk", "curvature", "steering rate", "lateral acceleration"),
        judging.ABOVE_LIMIT,
    ),
    "map": "the body's middle is {excess:.3g} m off the map at {time:.3f} s",
    "wall": "the body is {excess:.3g} m inside walls[{nearest_wall}] or its margin at {time:.3f} s",
    "mover": "the body is {excess:.3g} m inside movers[{nearest_mover}] or its margin at "
    "{time:.3f} s",
    "meeting": "the body's middle is {excess:.3g} m from the target at {time:.3f} s",
    "heading": "the heading is {excess:.3g} rad off the required one at {time:.3f} s",
    "end speed": "the speed at the end, {end_speed:.4g} m/s, is {excess:.3g} m/s out of its range",
}
LIMITS = tuple(_SENTENCES)
# Fields of a case that may be infinite, besides the limits of the car.
_UNBOUNDED = ("lower", "upper", "tolerance", "heading_tolerance", "end_speed")

# Between two samples no point of the body moves farther relative to an obstacle than this share of
# the body's length.
LONGEST_MOVE = 1.0 / 40.0
# Greatest number of steps between samples into which a plan is divided, and greatest number of
# distances from obstacles whose bounds are computed together.
MOST_STEPS, _MOST_BOUNDS = 2**17, 2**18
_SMALLEST_LIMIT = np.finfo(float).tiny  # a limit of 0 counts as this number in a relative excess
CONTACT_SHARE = 2.5e-3  # default of `contact_tolerance`, divided by the length of the body
# Nodes and weights of the Gauss-Legendre quadrature on (0, 1) of squared accelerations and jerks;
# it is exact for polynomials up to degree 7.
_NODES = np.polynomial.legendre.leggauss(4)
_NODE, _WEIGHT = 0.5 * (_NODES[0] + 1.0), 0.5 * _NODES[1]


@dataclasses.dataclass(frozen=True)
class InterceptVerdict(judging.Verdict):
    """Verdict on B plans in which a car drives to a moving target.

    Measurements are NaN where the inputs are not finite or the plan's time is not in (0, 3600] s. A
    clearance is the body's least distance from an obstacle over the samples: negative if they
    overlap, and infinite without an obstacle. RMS is the square root of the mean over time. The
    lateral acceleration is speed^2 * curvature of the rear axle, and the lateral jerk its
    derivative in time.
    """

    SENTENCES = _SENTENCES

    max_speed: np.ndarray  # (B,) [m/s], magnitude
    max_acceleration: np.ndarray  # (B,) [m/s^2], |dv/dt|
    rms_acceleration: np.ndarray  # (B,) [m/s^2], sqrt(1/T int (dv/dt)^2 dt)
    # Greatest change of the acceleration at a knot, divided by the duration of a piece.
    max_jerk: np.ndarray  # (B,) [m/s^3], magnitude
    max_curvature: np.ndarray  # (B,) [1/m], magnitude
    max_steering_rate: np.ndarray  # (B,) [rad/s], magnitude, of the angle atan(wheelbase curvature)
    max_lateral_acceleration: np.ndarray  # (B,) [m/s^2], magnitude, of the rear axle
    rms_lateral_acceleration: np.ndarray  # (B,) [m/s^2], of the rear axle
    rms_lateral_jerk: np.ndarray  # (B,) [m/s^3], of the rear axle
    rms_steering_rate: np.ndarray  # (B,) [rad/s]
    total_curvature_variation: np.ndarray  # (B,) [1/m], sum of the magnitudes of its changes
    wall_clearance: np.ndarray  # (B,) [m], least distance of the body from a wall
    mover_clearance: np.ndarray  # (B,) [m], least distance from a moving obstacle
    nearest_wall: np.ndarray  # (B,) int, index of the nearest wall, or -1
    nearest_mover: np.ndarray  # (B,) int, index of the nearest moving obstacle, or -1
    # Distance of the body's middle from the target, or from the region around it, when the plan
    # ends; 0 in the region.
    miss: np.ndarray  # (B,) [m]
    meeting_time: np.ndarray  # (B,) [s], when the plan ends
    end_speed: np.ndarray  # (B,) [m/s], when the plan ends

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
    contact_tolerance: float | None = None,
) -> InterceptVerdict:
    """Decide for every plan of a batch of interceptions whether it succeeds.

    Speed and curvature are linear between the plan's K + 1 knots in time, so the heading is a cubic
    polynomial of time. Gauss-Legendre quadrature integrates the position between samples, exact to
    rounding. Speed, acceleration, jerk, curvature, steering rate and lateral acceleration are
    compared with their limits at their extrema, not at samples.

    The distances of the car's body from the map's border, from walls and from moving obstacles
    (movers) are tested at samples: at the knots, at the times when a mover appears or vanishes, and
    between them. Two samples are at most `LONGEST_STEP` = 0.02 s apart, and so close that no point
    of the body moves farther than `LONGEST_MOVE` = 1/40 of the body's length relative to any point
    of an obstacle. A plan is divided into at most `MOST_STEPS` = 131072 such steps, or one step for
    each piece between knots; a plan that needs more steps has longer steps. At a sample the
    distance from an obstacle is exact, and must be at least the case's margin.

    The body's middle must be near the region around the target when the plan ends. The plan must
    not end before the case's earliest time, also if its planner does not choose the time.

    Target positions are computed in float64 for paths with the fields of `TurningPath` (recognised
    by `turn_rate`), `PolynomialPath` (`coeffs`), `ControlledPath` (`controls`), or a `LaterPath`
    (`path` and `begin`) of one of them.
    For other classes `pj.intercept.judge` calls the target's own method `at`, as planners do.

    Args:
        cases: object with the fields of `InterceptCase`, for B cases. Polygons are convex, in
            either orientation, and may repeat corners. Values of absent obstacles are ignored.
        plans: object with the fields of `InterceptPlan`; speed and curvature are (B, K + 1).
        truth: true paths of the B targets, relative to the case's origin; they replace
            `cases.target`, which may be a prediction.
        target_positions: function `(target, times (B,) [s]) -> positions (B, 2) [m]` for targets
            of other classes. If passed, it is called for the known classes too.
        tolerance: relative tolerance of every limit of the car, the case's tolerance and its
            heading tolerance. Errors of the plan's start and of its speed at the end are divided by
            these scales: the body's length for the position, 1 rad for the heading, the speed limit
            for speeds, and 1 / length for the curvature. Without a speed limit the scale is the
            case's initial speed, or one length of the body in a second if this speed is greater.
        contact_tolerance: [m], greatest depth of the body in an obstacle or its margin, and
            greatest distance of its middle outside the map. None: 1/400 of the body's length, which
            is 1 mm for the default car.

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
    **{"tolerance": (), "end_heading": (), "heading_tolerance": (), "earliest": (), "margin": ()},
    **{"end_speed": (2,), "map_heading": (), "origin": (2,)},
    **{f"body.{name}": () for name in ("length", "width", "wheelbase", "rear_overhang")},
    **{f"limits.{name}": () for name in ("speed", "acceleration", "lateral_acceleration")},
    **{f"limits.{name}": () for name in ("curvature", "steering_rate")},
}


def _leaves(cases, plans) -> dict[str, np.ndarray]:
    speed = np.asarray(plans.speed)
    if speed.ndim != 2 or speed.shape[1] < 2:
        raise ValueError(f"plan.speed must be (B, K + 1), K >= 1, got {speed.shape}")
    of_plan = {"start": (3,), "time": (), "curvature": speed.shape[1:], "speed": speed.shape[1:]}
    leaves = judging.read_leaves(plans, of_plan | {"origin": (2,)}, len(speed), "plan.")
    leaves |= judging.read_leaves(cases, _SHAPES, len(speed))
    for name, missing in (("reverse_speed", 0.0), ("jerk", np.inf)):
        limit = vars(cases.limits)[name]
        limit = np.full(len(speed), missing) if limit is None else limit
        leaves[f"limits.{name}"] = judging.check_leaf(f"limits.{name}", limit, (len(speed),))
    region = np.asarray(cases.region)
    if region.ndim != 3 or region.shape[::2] != (len(speed), 2) or region.shape[1] < 1:
        raise ValueError(f"region must be ({len(speed)}, V >= 1, 2), got {region.shape}")
    leaves["region"] = region
    for name, group in (("walls", cases.walls), ("movers", cases.movers)):
        leaves |= _obstacle_leaves(name, group, len(speed))
    return leaves


def _obstacle_leaves(name: str, group, batch: int) -> dict[str, np.ndarray]:
    corners = np.asarray(group.corners)
    if corners.ndim != 4 or corners.shape[::3] != (batch, 2) or corners.shape[2] < 3:
        raise ValueError(f"{name}.corners must be ({batch}, N, V >= 3, 2), got {corners.shape}")
    shape = corners.shape[:2]
    present = judging.check_leaf(f"{name}.present", group.present, shape)
    sizes: dict[str, tuple[int, ...]] = {"centre": (2,), "velocity": (2,), "radius": ()}
    sizes |= {"growth": (), "corners": corners.shape[2:]}
    track = group.track if name == "movers" else None
    if track is not None:
        poses = np.asarray(track.poses)
        if poses.ndim != 4 or poses.shape[2] < 1:
            raise ValueError(f"{name}.track.poses must be (B, N, K >= 1, 3), got {poses.shape}")
        sizes = {key: size for key, size in sizes.items() if key not in ("centre", "velocity")}
        sizes |= {"track.poses": (poses.shape[2], 3)}
        sizes |= {f"track.{key}": () for key in ("begin", "step", "end")}
    shapes = {key: (shape[1], *size) for key, size in sizes.items()}
    leaves = {f"{name}.present": present}
    for key, leaf in judging.read_leaves(group, shapes, batch, f"{name}.").items():
        exists = present.reshape(*shape, *[1] * (leaf.ndim - 2)) != 0
        leaves[key] = np.where(exists, leaf, 1.0 if key.endswith("step") else 0.0)
    return leaves


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
    if "controls" in fields:
        shape = np.shape(fields["controls"])
        if len(shape) != 3:
            raise ValueError(f"target.controls must be ({len(times)}, K, 2), got {shape}")
        state, controls = leaf("state", 4)[:, None], leaf("controls", shape[1], 2)
        velocities = state[..., 2:] + np.pad(np.cumsum(controls, axis=1), [(0, 0), (1, 0), (0, 0)])
        step, k = leaf("step")[:, None], np.arange(shape[1] + 1)
        longest = np.where(k == shape[1], np.inf, step)
        spent = np.clip(times[:, None] - k * step, np.where(k == 0, -np.inf, 0.0), longest)
        return state[:, 0, :2] + np.einsum("bk,bki->bi", spent, velocities)
    raise ValueError(f"a target of class {type(target).__name__} needs target_positions")


def _judge(case: dict, relative: float, contact: float | None) -> dict:
    end, length = case["plan.time"], case["body.length"]
    finite = judging.finite_lanes(case, _UNBOUNDED)
    driven = finite & (end > 0.0) & (end <= LONGEST_PLAN)
    span = np.where(driven, end, 0.0) / (case["plan.speed"].shape[1] - 1)
    measured, tests = _judge_limits(case, span, relative)
    found = _find_clearances(case, span)
    allowed = CONTACT_SHARE * length if contact is None else contact
    outside, when = found.pop("outside"), found.pop("outside_time")
    tests["map"] = (outside > allowed, outside, when)
    for one in ("wall", "mover"):
        short = case["margin"] - found[f"{one}_clearance"]
        tests[one] = (short > allowed, short, found.pop(f"{one}_time"))
    final = found.pop("final_pose")
    miss = _distance_from_region(case, final)
    off = np.abs(_wrap(final[:, 2] - case["end_heading"]))
    apart = np.linalg.norm(case["plan.origin"] - case["origin"], axis=1)
    tests["origin"] = (apart > 0.0, apart, np.zeros_like(apart))
    tests["start"] = _start(case, relative)
    tests["meeting"] = (miss > case["tolerance"] * (1.0 + relative), miss, end)
    tests["heading"] = (off > case["heading_tolerance"] * (1.0 + relative), off, end)
    speed, (least, most) = case["plan.speed"][:, -1], case["end_speed"].T
    out = np.maximum(least - speed, speed - most)
    tests["end speed"] = (out > relative * _speed_scale(case), out, end)
    too_soon = case["earliest"] - end
    tests["early"] = (too_soon > judging.CONTACT_TIME_TOLERANCE, too_soon, end)
    tests = judging.clear_where(~driven, tests)
    late = end - np.minimum(case["time"], LONGEST_PLAN)
    tests["time"] = (
        (late > judging.CONTACT_TIME_TOLERANCE) | (finite & ~driven),
        np.where(finite, np.maximum(late, -end), 0.0),
        end,
    )
    measured |= found | {"miss": miss, "meeting_time": end, "end_speed": speed}
    for name, value in measured.items():
        measured[name] = np.where(driven, value, -1 if value.dtype.kind == "i" else np.nan)
    return judging.first_failures(tests, LIMITS, finite) | measured


def _distance_from_region(case: dict, pose: np.ndarray) -> np.ndarray:
    normals = edges(case["region"])[0]
    point = np.concatenate([pose[:, :2] - case["target"], np.zeros((len(pose), 1))], axis=1)
    gap = separation(case["region"], normals, point, np.zeros((len(pose), 2)))
    return np.maximum(gap, 0.0)


def _wrap(angle: np.ndarray) -> np.ndarray:
    return np.arctan2(np.sin(angle), np.cos(angle))


def _speed_scale(case: dict) -> np.ndarray:
    """Return the scale [m/s] by which errors of speeds are divided, see `referee_intercepts`."""
    limit, other = case["limits.speed"], np.maximum(case["speed"], case["body.length"])
    return np.where(np.isinf(limit), other, limit)


def _start(case: dict, allowed: float) -> tuple:
    away, length = case["plan.start"] - case["start"], case["body.length"]
    errors = [
        np.linalg.norm(away[:, :2], axis=1) / length,
        np.abs(_wrap(away[:, 2])),
        np.abs(case["plan.speed"][:, 0] - case["speed"]) / _speed_scale(case),
        np.abs(case["plan.curvature"][:, 0] - case["curvature"]) * length,
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
        "speed": _greatest(np.abs(v), knots),
        "acceleration": _greatest(np.abs(rise), starts),
        "jerk": _greatest(np.abs(np.diff(rise, prepend=rise[:, :1])) / h, starts),
        "curvature": _greatest(np.abs(k), knots),
        "steering rate": _greatest(steering, starts + zero),
        "lateral acceleration": _greatest(lateral, lateral_times),
    }
    measured = {f"max_{name.replace(' ', '_')}": value for name, (value, _) in peaks.items()}
    measured["rms_acceleration"] = np.sqrt(np.mean(rise**2, axis=1))
    measured["total_curvature_variation"] = np.abs(np.diff(k)).sum(axis=1)
    measured |= _root_mean_squares(v0, k0, rise, bend, h)
    # The integral of the squared steering rate L^2 k'^2 / (1 + u^2)^2 with u = L k over time is
    # L k' F, where F is the change of u / (2 (1 + u^2)) + atan(u) / 2.
    u = wheelbase * k
    change = np.diff(0.5 * (u / (1.0 + u**2) + np.arctan(u)))
    square = np.maximum(wheelbase * bend * change, 0.0) / h
    measured["rms_steering_rate"] = np.sqrt(square.mean(axis=1))
    tests = {}
    for name, (value, time) in peaks.items():
        limit = case[f"limits.{name.replace(' ', '_')}"]
        tests[name] = judging.above(value, limit, relative, time, smallest=_SMALLEST_LIMIT)
    # The speed in reverse, a negative speed, has a limit of its own; 0 without a reverse gear.
    limit, reverse = (case[f"limits.{name}"][:, None] for name in ("speed", "reverse_speed"))
    scale = np.where(np.isinf(limit), 1.0, np.maximum(limit, _SMALLEST_LIMIT))
    excess, when = _greatest(np.maximum(v - limit, -v - reverse) / scale, knots)
    tests["speed"] = (excess > relative, excess, when)
    return measured, tests


def _root_mean_squares(v0, k0, rise, bend, h) -> dict[str, np.ndarray]:
    """Return the RMS of lateral acceleration v^2 k and of its derivative 2 v v' k + v^2 k'."""
    acceleration, jerk = np.zeros(v0.shape), np.zeros(v0.shape)
    for node, weight in zip(_NODE, _WEIGHT, strict=True):
        v, k = v0 + node * h * rise, k0 + node * h * bend
        acceleration += weight * (v**2 * k) ** 2
        jerk += weight * (2.0 * v * rise * k + v**2 * bend) ** 2
    squares = {"rms_lateral_acceleration": acceleration, "rms_lateral_jerk": jerk}
    return {name: np.sqrt(square.mean(axis=1)) for name, square in squares.items()}


def _group(case: dict, name: str) -> dict[str, np.ndarray]:
    prefix = f"{name}."
    return {key.removeprefix(prefix): x for key, x in case.items() if key.startswith(prefix)}


def _count_steps(case: dict, span: np.ndarray) -> np.ndarray:
    """Return the number (B,) of steps between samples into which each piece is divided."""
    v, k = np.abs(case["plan.speed"]), np.abs(case["plan.curvature"])
    length, rear = case["body.length"], case["body.rear_overhang"]
    far = np.hypot(np.maximum(np.abs(length - rear), np.abs(rear)), 0.5 * case["body.width"])
    v, k = (np.maximum(each[:, 1:], each[:, :-1]) for each in (v, k))
    rate = (v * (1.0 + k * far[:, None])).max(axis=1) + greatest_speeds(_group(case, "movers"))
    count = np.maximum(span / LONGEST_STEP, span * rate / (LONGEST_MOVE * length))
    most = max(MOST_STEPS // v.shape[1], 1)
    return np.clip(np.nan_to_num(np.ceil(count - 1e-9), nan=1.0, posinf=most), 1.0, most)


def _find_clearances(case: dict, span: np.ndarray) -> dict[str, np.ndarray]:
    """Return final poses and clearances; plans of similar numbers of samples are computed together.

    The memory is bounded by `_MOST_BOUNDS`, or by one plan.
    """
    count = _count_steps(case, span)
    widest = max(8, *(case[f"{name}.present"].shape[1] for name in ("walls", "movers")))
    bounds = count * (case["plan.speed"].shape[1] - 1) * widest
    order, parts, first = np.argsort(count, kind="stable"), [], 0
    for k in range(1, len(order) + 1):
        if k == len(order) or (k + 1 - first) * bounds[order[k]] > _MOST_BOUNDS:
            parts.append(order[first:k])
            first = k
    parts = parts or [order]
    found = []
    for part in parts:
        own = {key: leaf[part] for key, leaf in case.items()}
        found.append(_measure_clearances(own, span[part], count[part]))
    back = np.argsort(np.concatenate(parts))
    return {key: np.concatenate([each[key] for each in found])[back] for key in found[0]}


def _measure_clearances(case: dict, span: np.ndarray, count: np.ndarray) -> dict[str, np.ndarray]:
    movers = _group(case, "movers")
    ends = [movers[key] for key in ("track.begin", "track.end") if key in movers]
    extra = np.concatenate([np.zeros((len(span), 0)), *ends], axis=1)
    times, poses = sample_poses(case, span, count, extra)
    cos, sin = np.cos(case["map_heading"])[:, None], np.sin(case["map_heading"])[:, None]
    x, y = poses[..., 0], poses[..., 1]
    middle = np.stack([cos * x + sin * y, cos * y - sin * x], axis=2)
    outside = np.maximum(case["lower"][:, None] - middle, middle - case["upper"][:, None])
    found: dict[str, np.ndarray] = {"final_pose": poses[:, -1]}
    found["outside"], found["outside_time"] = _greatest(outside.max(axis=2), times)
    half = 0.5 * np.stack([case["body.length"], case["body.width"]], axis=1)
    for one, group in (("wall", _group(case, "walls")), ("mover", movers)):
        found[f"{one}_clearance"], found[f"{one}_time"], found[f"nearest_{one}"] = clearances(
            group, half, times, poses
        )
    return found
