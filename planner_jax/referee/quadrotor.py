"""Tests of a quadrotor's trajectory in float64 NumPy, for the referees of hits and catches.

Polynomial pieces are sampled. Attitude and body rate follow from differential flatness (Hopf
fibration at zero heading [Watterson2020]). World frame, z up, SI units. Of the planners' code it
runs only limits that a user adds (`referee.extras`).
"""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike

from planner_jax.referee.judging import (
    ABOVE_LIMIT,
    above,
    check_leaf,
    cut,
    derivative,
    flat,
    read_leaves,
)


@dataclasses.dataclass(frozen=True)
class Pieces:
    """Polynomial pieces of B trajectories in float64: M pieces of degree D each.

    Some pieces of a plan may be unused, such as pieces for absent targets. In their place there is
    a copy of the last used piece before them, which does not change the trajectory's extrema.
    """

    coeffs: np.ndarray  # (3, B, M, D + 1)
    durations: np.ndarray  # (B, M) [s]
    starts: np.ndarray  # (B, M) [s]
    flown: np.ndarray  # (B, M) bool, whether a piece is used

    def of(self, lanes: slice, pieces: slice = slice(None)) -> "Pieces":
        """Return some `pieces`, by default all, of some trajectories of the batch."""
        others = (part[lanes, pieces] for part in (self.durations, self.starts, self.flown))
        return Pieces(self.coeffs[:, lanes, pieces], *others)


def pieces_of(coeffs: np.ndarray, durations: np.ndarray, flown: np.ndarray | None = None) -> Pieces:
    """Build the `Pieces` of B trajectories of M polynomials of degree D.

    Coefficients are (B, M, D + 1, 3), durations (B, M) [s]. `flown` (B, M) bool marks the pieces
    that are used, by default all; the others must have zero duration.
    """
    coeffs = np.moveaxis(coeffs, -1, 0)
    starts = np.cumsum(durations, axis=1) - durations
    if flown is None:
        flown = np.ones(durations.shape, bool)
    else:
        last = np.maximum.accumulate(np.where(flown, np.arange(durations.shape[1]), 0), axis=1)
        lanes = np.arange(len(durations))[:, None]
        coeffs = coeffs[:, lanes, last]
        durations, starts = durations[lanes, last], starts[lanes, last]
    return Pieces(np.ascontiguousarray(coeffs), durations, starts, flown)


MOTION_SENTENCES = {
    "head state": "the trajectory starts {excess:.3g} m off the head state",
    "continuity": "the trajectory jumps by {excess:.3g} m at {time:.3f} s",
    **dict.fromkeys(("speed", "acceleration", "body rate"), ABOVE_LIMIT),
    "heading start": "the heading or its rate is {excess:.3g} off its case's, in rad or rad/s",
    "heading jump": "the heading or its rate jumps by {excess:.3g} at {time:.3f} s, rad or rad/s",
    "yaw rate": ABOVE_LIMIT,
    "thrust low": "{excess:.2%} below the least thrust at {time:.3f} s",
    "thrust high": "{excess:.2%} above the greatest thrust at {time:.3f} s",
    "rotor low": "a rotor's thrust is {excess:.2%} of the greatest below the least at {time:.3f} s",
    "rotor high": "{excess:.2%} above the greatest thrust of a rotor at {time:.3f} s",
    "tilt": "sin(tilt / 2) is {excess:.2%} above its limit at {time:.3f} s",
    "ground": "{excess:.2%} below the least height at {time:.3f} s",
    "extra": "{excess:.2%} beyond extras[{worst_extra}] of the case at {time:.3f} s",
    "recovery": "the recovery trajectory does not end at standstill: velocity, acceleration or "
    "jerk make {excess:.3g} m of displacement",
}
MOTION_UNBOUNDED = {"body rate": "no thrust or upside down, so without attitude, at {time:.3f} s"}

# [s] An error e of the n-th derivative of the position counts as the displacement |e| h^n / n!,
# where h is the mean duration of a piece, but at least this number.
SHORTEST_PIECE = 0.1
_INTERVALS = 400  # least number of intervals between samples, from contact to contact
_FEWEST_INTERVALS = 16  # least number of intervals between samples in one polynomial piece
# Greatest number of multiplications in one matrix product, and of plans whose maxima are searched
# together. So few numbers fit the processor's cache, and OpenBLAS starts no threads for them.
_PRODUCT, _SEARCHED = 250_000, 1024


def intervals_of(num_pieces: int) -> int:
    """Return a piece's number of sampling intervals: >= 16, and >= 400 in `num_pieces` pieces."""
    return max(math.ceil(_INTERVALS / num_pieces), _FEWEST_INTERVALS)


def check_coeffs(value: ArrayLike) -> np.ndarray:
    """Convert coefficients to an array; raise a ValueError unless it is (B, pieces, powers, 3)."""
    coeffs = np.asarray(value)
    if coeffs.ndim != 4 or coeffs.shape[-1] != 3 or 0 in coeffs.shape[1:]:
        raise ValueError(f"coeffs must be (B, M, D + 1, 3), got {coeffs.shape}")
    return coeffs


def read_flight(cases, plans) -> dict[str, np.ndarray]:
    """Read trajectories, limits, gravity and recovery as arrays by names like "limits.speed"."""
    coeffs = check_coeffs(plans.trajectory.coeffs)
    num_lanes, num_pieces = coeffs.shape[:2]
    leaves = {"lane": np.arange(num_lanes), "coeffs": coeffs}
    durations = plans.trajectory.durations
    leaves["durations"] = check_leaf("durations", durations, (num_lanes, num_pieces))
    limits = ("speed", "acceleration", "body_rate", "min_thrust", "max_thrust", "min_height")
    shapes = {"gravity": ()} | {f"limits.{name}": () for name in limits}
    shapes |= {f"limits.{name}": () for name in ("max_tilt", "recovery_tilt")}
    leaves |= read_leaves(cases, shapes, num_lanes)
    if (rotors := cases.limits.rotors) is not None:
        shapes = dict.fromkeys(("mass", "min_thrust", "max_thrust"), ())
        shapes |= {"inertia": ((3,), (6,))[np.shape(rotors.inertia)[-1:] == (6,)]}
        shapes |= {"mixer": (*np.shape(rotors.mixer)[-2:-1], 4)}
        leaves |= read_leaves(rotors, shapes, num_lanes, "limits.rotors.")
    if (air := cases.limits.air) is not None:
        shapes = {"drag": (), "thrust_drag": (), "wind": (3,)}
        leaves |= read_leaves(air, shapes, num_lanes, "limits.air.")
    if plans.heading is not None or cases.heading is not None:
        from planner_jax.referee.heading import read_heading  # few plans have a heading

        leaves |= read_heading(cases, plans, num_lanes)
    if plans.recovery is not None:
        coeffs = check_coeffs(plans.recovery.coeffs)
        shapes = {"coeffs": coeffs.shape[1:], "durations": coeffs.shape[1:2]}
        leaves |= read_leaves(plans.recovery, shapes, num_lanes, "recovery.")
    return leaves


def motion_of(pieces: Pieces, u: np.ndarray) -> list:
    """Evaluate position, velocity, acceleration and jerk at the fractions `u` of all pieces."""
    durations, num = pieces.durations, pieces.coeffs.shape[-1]
    spans = np.vander(durations.ravel(), num, increasing=True)
    powers = np.vander(u, num, increasing=True).T
    coeffs = pieces.coeffs.reshape(3, len(spans), num)
    out = []
    for order in range(4):
        factors = np.array([math.perm(k, order) for k in range(order, num)], float)
        left = max(num - order, 0)
        values = (coeffs[..., order:] * (factors * spans[:, :left])) @ powers[:left]
        out.append(values.reshape(3, *durations.shape, len(u)))
    return out


def norm_squared(vector: np.ndarray) -> np.ndarray:
    """Return |v|^2 (...) of vectors (3, ...)."""
    return vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2


def thrust_squared(gravity, acc: np.ndarray) -> np.ndarray:
    """Return the squared thrust per unit mass (...) [m^2/s^4] of accelerations (3, ...)."""
    return acc[0] ** 2 + acc[1] ** 2 + (acc[2] + gravity) ** 2


def body_rate_squared(gravity, acc: np.ndarray, jerk: np.ndarray, yaw_rate=0.0) -> np.ndarray:
    """Return the squared body rate |omega|^2 of the Hopf fibration.

    With the thrust per unit mass tau and c = tau x jerk, the thrust direction z has
    z' = (c / |tau|^2) x z, so |z'| = |c| / |tau|^2. The rate about z is
    (z_y z_x' - z_x z_y') / (1 + z_z) = -c_z / (|tau| (|tau| + tau_z)), plus the derivative of the
    heading. The result is infinite without thrust and upside down, where there is no attitude.
    """
    tau_x, tau_y, tau_z = acc[0], acc[1], acc[2] + gravity
    c_x = tau_y * jerk[2] - tau_z * jerk[1]
    c_y = tau_z * jerk[0] - tau_x * jerk[2]
    c_z = tau_x * jerk[1] - tau_y * jerk[0]
    size_squared = tau_x**2 + tau_y**2 + tau_z**2
    size = np.sqrt(size_squared)
    upright = size + tau_z
    about = c_z / upright - yaw_rate * size
    rate = ((c_x**2 + c_y**2 + c_z**2) / size_squared + about**2) / size_squared
    return np.where(upright > 0.0, rate, np.inf)


# Quantities whose maximum along the trajectory is searched. Each entry has the orders of the
# position's derivatives from which the quantity is computed, and the function that computes it.
# "depth" is minus the height, and "weakness" minus the squared thrust: their maxima are minima of
# height and thrust.
_MEASURES = {
    "speed": ((1,), lambda gravity, vel: norm_squared(vel)),
    "acceleration": ((2,), lambda gravity, acc: norm_squared(acc)),
    "body rate": ((2, 3), body_rate_squared),
    "depth": ((0,), lambda gravity, pos: -pos[2]),
    "thrust": ((2,), thrust_squared),
    "weakness": ((2,), lambda gravity, acc: -thrust_squared(gravity, acc)),
}


def find_tops(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return indices of maxima of samples (N, M, S), the maxima, and indices of vertices (N,)."""
    line, rows = values.ravel(), flat(values)
    top = rows.argmax(axis=1)
    greatest = rows[np.arange(len(rows)), top]
    crest = np.zeros(values.shape, bool)
    crest.ravel()[1:-1] = (line[1:-1] >= line[:-2]) & (line[1:-1] > line[2:])
    crest[..., 0] = crest[..., -1] = False  # a neighbour of an end sample is in another piece
    peak = np.flatnonzero(crest)
    left, middle, right = line[peak - 1], line[peak], line[peak + 1]
    line[peak] += (right - left) ** 2 / (8.0 * (2.0 * middle - left - right))
    return top, greatest, rows.argmax(axis=1)


def peaks(pieces: Pieces, gravity: np.ndarray, intervals: int) -> dict[str, tuple]:
    """Find the maxima of speed, acceleration, thrust and other quantities, by name.

    Each result has two arrays: the maximum of each plan, and its time. Every piece is sampled at
    both ends and inside. The search then starts at the highest vertex of a parabola through three
    samples, and evaluates the polynomial itself at ever closer times.
    """
    u = np.linspace(0.0, 1.0, intervals + 1)
    parts = [_peaks(pieces.of(lanes), gravity[lanes], u) for lanes in cut(len(gravity), _SEARCHED)]
    return {
        name: tuple(
            np.concatenate(found) for found in zip(*(part[name] for part in parts), strict=True)
        )
        for name in _MEASURES
    }


def _peaks(pieces: Pieces, gravity: np.ndarray, u: np.ndarray) -> dict[str, tuple]:
    num_lanes, num_pieces = pieces.durations.shape
    tiles = cut(num_lanes, max(_PRODUCT // (num_pieces * pieces.coeffs.shape[-1] * len(u)), 1))
    sampled = [_sample(pieces.of(tile), gravity[tile], u) for tile in tiles]
    top, greatest, likeliest, sharpest, turn = (
        np.concatenate(parts, axis=-1) for parts in zip(*sampled, strict=True)
    )
    peaks = {
        name: select_greater(
            search_peak(measure, pieces, gravity, likeliest[i], u),
            (greatest[i], time_of(pieces, top[i], u)),
        )
        for i, (name, measure) in enumerate(_MEASURES.items())
    }
    peaks["body rate"] = select_greater(peaks["body rate"], (turn, time_of(pieces, sharpest, u)))
    return peaks


def _sample(pieces: Pieces, gravity: np.ndarray, u: np.ndarray) -> tuple:
    motion = motion_of(pieces, u)
    gravity = gravity[:, None, None]
    values = np.empty((len(_MEASURES), *motion[0].shape[1:]))
    for i, (orders, measure) in enumerate(_MEASURES.values()):
        values[i] = measure(gravity, *[motion[order] for order in orders])
    tops = find_tops(values.reshape(-1, *values.shape[2:]))
    turn = _fastest_turn(motion[2], gravity, pieces, u)
    return *(found.reshape(values.shape[:2]) for found in tops), *turn


def time_of(pieces: Pieces, index: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return times (B,) [s] of the samples with these indices among all samples of B plans."""
    piece, sample = np.divmod(index, len(u))
    lanes = np.arange(len(index))
    return pieces.starts[lanes, piece] + pieces.durations[lanes, piece] * u[sample]


def search_peak(measured: tuple, pieces: Pieces, gravity, likeliest, u: np.ndarray) -> tuple:
    """Return the greatest value of a measure near the sample `likeliest`, and its time."""
    orders, measure = measured
    piece, sample = np.divmod(likeliest, len(u))
    lanes = np.arange(len(piece))
    coeffs = np.ascontiguousarray(pieces.coeffs[:, lanes, piece].transpose(2, 0, 1))[:, :, None]
    span = pieces.durations[lanes, piece]
    value, centre, half = np.empty(len(piece)), u[sample], u[1]
    for _ in range(3):
        near = np.clip(centre + half * np.linspace(-1.0, 1.0, 9)[:, None], 0.0, 1.0)
        found = measure(gravity, *[derivative(coeffs, near * span, order) for order in orders])
        best = found.argmax(axis=0)
        value, centre, half = found[best, lanes], near[best, lanes], half / 4.0
    return value, pieces.starts[lanes, piece] + centre * span


def select_greater(first: tuple, second: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Return the greater of two values (B,), and its time."""
    better = second[0] > first[0]
    return np.where(better, second[0], first[0]), np.where(better, second[1], first[1])


def _fastest_turn(acc, gravity, pieces: Pieces, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the fastest rotation of each plan's thrust between two neighbouring samples.

    Returns the index of the first sample, and the squared mean rate [rad^2/s^2] between the two.
    """
    tau = acc.copy()
    tau[2] += gravity
    tau = tau.reshape(3, -1)
    size = np.sqrt(norm_squared(tau))
    along = tau[:, 1:] * tau[:, :-1]
    cosine = np.ones(acc.shape[1:])
    cosine.ravel()[:-1] = (along[0] + along[1] + along[2]) / (size[1:] * size[:-1])
    cosine[..., -1] = 1.0  # the next sample belongs to another piece
    sharpest = np.fmin.reduce(cosine, axis=2)
    step = np.maximum(pieces.durations * (u[1] - u[0]), np.finfo(float).tiny)
    rate = np.where(pieces.flown, np.arccos(np.clip(sharpest, -1.0, 1.0)) / step, 0.0)
    piece, lanes = rate.argmax(axis=1), np.arange(len(rate))
    return piece * len(u) + cosine[lanes, piece].argmin(axis=1), rate[lanes, piece] ** 2


def joint_errors(pieces: Pieces, head_state: np.ndarray) -> tuple:
    """Measure how far B trajectories are off their states at time 0, and jumps between pieces.

    Returns arrays (B,): error at time 0 [m], greatest jump [m], time of this jump [s], and a scale
    [m]. An error e_n of the n-th derivative (n = 0..3) counts as the displacement |e_n| h^n / n!
    over the mean duration h of a piece, at least `SHORTEST_PIECE`. The scale is the largest
    coordinate at the ends of the pieces, at least 1 m. `head_state` (B, 4, 3) is the required
    position, velocity, acceleration and jerk at time 0.
    """
    durations, flown = pieces.durations, pieces.flown
    coeffs = np.moveaxis(pieces.coeffs, -1, 0)
    starts, ends = (
        np.stack([derivative(coeffs, times, order) for order in range(4)])
        for times in (np.zeros_like(durations), durations)
    )
    total = np.where(flown, durations, 0.0).sum(axis=1)
    period = np.maximum(total / np.maximum(flown.sum(axis=1), 1), SHORTEST_PIECE)
    weights = np.stack([period**n / math.factorial(n) for n in range(4)])
    head_error = np.linalg.norm(starts[..., 0] - np.moveaxis(head_state, 0, -1), axis=1) * weights
    jumps = np.linalg.norm(starts[..., 1:] - ends[..., :-1], axis=1)
    jump = np.zeros_like(durations)
    jump[:, 1:] = np.where(flown[:, 1:], (jumps * weights[:, :, None]).max(axis=0), 0.0)
    worst = jump.argmax(axis=1)
    scale = np.maximum(np.abs([starts[0], ends[0]]).max(axis=(0, 1, 3)), 1.0)
    lanes = np.arange(len(worst))
    return head_error.max(axis=0), jump.max(axis=1), pieces.starts[lanes, worst], scale


def judge_motion(
    pieces: Pieces, case: dict, extras: tuple, intervals: int, relative: float, continuity: float
) -> tuple[dict, dict]:
    """Test a flight against its case's limits, start state and continuity.

    Args:
        pieces: polynomial pieces of B plans.
        case: arrays by name, such as the start state "head_state" and "limits.speed".
        extras: the user's extra limits.
        intervals: number of sampling intervals of each piece.
        relative: relative tolerance of each limit.
        continuity: tolerance of the start state and of jumps between pieces, relative to the
            largest coordinate at ends of pieces (at least 1 m).

    Returns:
        The measurements of `FlightVerdict`, and tests (failed, excess, time), by name.
    """
    found, load = peaks(pieces, case["gravity"], intervals), pieces
    u = np.linspace(0.0, 1.0, intervals + 1)
    if "limits.air.drag" in case:
        from planner_jax.referee.air import load_pieces, thrust_along  # few cases have drag

        load = load_pieces(pieces, case)
        found["body rate"] = peaks(load, case["gravity"], intervals)["body rate"]
        thrust = thrust_along(pieces, case, u)
        for name, sign in (("thrust", 1.0), ("weakness", -1.0)):
            top, greatest, _ = find_tops(sign * thrust**2)
            found[name] = greatest, time_of(pieces, top, u)
    turned: dict = {}
    if "heading.coeffs" in case:
        from planner_jax.referee.heading import judge_heading  # few plans have a heading

        turns, rates, turned = judge_heading(load, case, u, relative, continuity)
        pairs = zip(rates, found["body rate"], strict=True)
        found["body rate"] = tuple(np.where(turns, *pair) for pair in pairs)
    head, jump, jump_time, scale = joint_errors(pieces, case["head_state"])
    measured = {
        "max_speed": np.sqrt(found["speed"][0]),
        "max_acceleration": np.sqrt(found["acceleration"][0]),
        "max_body_rate": np.sqrt(found["body rate"][0]),
        "min_height": -found["depth"][0],
        "min_thrust": np.sqrt(-found["weakness"][0]),
        "max_thrust": np.sqrt(found["thrust"][0]),
        "continuity_error": jump,
        "head_error": head,
    }
    num = len(head)
    beyond, at, measured["worst_extra"] = np.full(num, -1.0), np.zeros(num), np.full(num, -1)
    if extras:
        from planner_jax.referee.extras import worst_extras  # few cases have extra limits

        beyond, at, measured["worst_extra"] = worst_extras(pieces, case["lane"], extras, u)
    allowed = continuity * scale
    tests = {
        "head state": (head > allowed, head, np.zeros_like(head)),
        "continuity": (jump > allowed, jump, jump_time),
        "extra": (beyond > relative, beyond, at),
        **turned,
    }
    # For each test by name: the quantity in `found`, the name of the measurement, the field of the
    # case that holds the limit, and 1 for an upper limit or -1 for a lower limit.
    bounds = {
        "speed": ("speed", "max_speed", "speed", 1.0),
        "acceleration": ("acceleration", "max_acceleration", "acceleration", 1.0),
        "body rate": ("body rate", "max_body_rate", "body_rate", 1.0),
        "thrust low": ("weakness", "min_thrust", "min_thrust", -1.0),
        "thrust high": ("thrust", "max_thrust", "max_thrust", 1.0),
        "ground": ("depth", "min_height", "min_height", -1.0),
    }
    for name, (peak, field, bound, sign) in bounds.items():
        limit = case.get(f"limits.{bound}")
        if limit is not None:
            tests[name] = above(sign * measured[field], sign * limit, relative, found[peak][1])
    if "limits.rotors.mass" in case:
        from planner_jax.referee.rotors import judge_rotors  # few cases limit rotors

        of_rotors, rotor_tests = judge_rotors(pieces, case, u, relative)
        measured, tests = measured | of_rotors, tests | rotor_tests
    else:
        measured |= dict.fromkeys(("min_rotor_thrust", "max_rotor_thrust"), np.full(num, np.nan))
    measured["max_tilt"] = np.full(num, np.nan)
    if "recovery.coeffs" in case or "limits.max_tilt" in case:
        from planner_jax.referee.recovery import judge_rest, judge_tilt  # few flights have them

        measured["max_tilt"], of_tilt = judge_tilt(case, load, u, relative)
        tests |= of_tilt | judge_rest(case, pieces, continuity)
    return measured, tests
