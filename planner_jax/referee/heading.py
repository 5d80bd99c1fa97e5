"""Headings of quadrotors' plans over time, for the referee, in float64 NumPy.

The attitude at a heading psi is  R_tilt R_z(psi) , where R_tilt is the attitude at zero heading.
With the thrust direction z and the rate r about z at zero heading, the body rate is
sqrt(|z'|^2 + (r + psi')^2) . After its end a heading is constant.
"""

from collections.abc import Callable

import numpy as np

from planner_jax.referee.judging import above, check_leaf, cut, derivative, read_leaves
from planner_jax.referee.quadrotor import Pieces, body_rate_squared, motion_of

_LANES = 64  # greatest number of plans that are sampled together
_END = 1e-4  # relative tolerance of the time at which a heading ends


def read_heading(cases, plans, num_lanes: int) -> dict[str, np.ndarray]:
    """Read the headings over time of B plans, zero where there is none, and their limits."""
    shapes = {"coeffs": (1, 1, 1), "durations": (1,), "start": (2,)}
    leaves = {f"heading.{name}": np.zeros((num_lanes, *own)) for name, own in shapes.items()}
    leaves["limits.yaw_rate"] = np.full(num_lanes, np.inf)
    if (heading := plans.heading) is not None:
        shape = num_lanes, *np.shape(heading.coeffs)[1:3]
        leaves["heading.coeffs"] = check_leaf("heading.coeffs", heading.coeffs, (*shape, 1))
        durations = check_leaf("heading.durations", heading.durations, shape[:2])
        leaves["heading.durations"] = durations
    if cases.heading is not None:
        shapes = {"start": (2,), "max_yaw_rate": ()}
        leaves |= read_leaves(cases.heading, shapes, num_lanes, "heading.")
        leaves["limits.yaw_rate"] = leaves.pop("heading.max_yaw_rate")
    return leaves


def headings_of(case: dict, lanes: slice = slice(None)) -> Callable:
    """Return a function of times (B, ...) [s]: the headings (B, ...) [rad] and derivatives then."""
    coeffs, durations = case["heading.coeffs"][lanes, ..., 0], case["heading.durations"][lanes]
    ends = durations.cumsum(axis=1)
    rows = np.arange(len(ends))[:, None]

    def at(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        line = times.reshape(len(times), -1)
        piece = (line[..., None] >= ends[:, None, :-1]).sum(axis=-1)
        since = np.minimum(line, ends[:, -1:]) - (ends - durations)[rows, piece]
        powers = np.moveaxis(coeffs[rows, piece], -1, 0)
        angle, rate = (derivative(powers, since, order) for order in range(2))
        rate = np.where(line <= ends[:, -1:] * (1.0 + _END), rate, 0.0)
        return angle.reshape(times.shape), rate.reshape(times.shape)

    return at


def turn_axes(axes: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Return attitudes (..., 3, 3) at headings (...) [rad] for attitudes `axes` at zero heading."""
    cosine, sine = np.cos(heading)[..., None], np.sin(heading)[..., None]
    x, y, z = np.moveaxis(axes, -1, 0)
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1)


def judge_heading(
    pieces: Pieces, case: dict, u: np.ndarray, relative: float, continuity: float
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], dict]:
    """Test the headings of B plans, and measure their body rates.

    `pieces` need the plans' thrust directions without drag; they are sampled at fractions twice as
    close as `u`.

    Returns:
        Whether the heading changes (B,); the greatest squared body rate [rad^2/s^2] and its time
        [s], each (B,); and tests (failed, excess, time) by name.
    """
    durations, lanes = case["heading.durations"], np.arange(len(case["gravity"]))
    powers, ends = np.moveaxis(case["heading.coeffs"][..., 0], -1, 0), durations.cumsum(axis=1)
    first, last = (
        np.stack([derivative(powers, times, order) for order in range(2)])
        for times in (np.zeros_like(durations), durations)
    )
    off = np.abs(first[..., 0] - case["heading.start"].T).max(axis=0)
    jumps = np.zeros_like(durations)  # at the end of each piece
    jumps[:, :-1] = np.abs(first[..., 1:] - last[..., :-1]).max(axis=0)
    until = pieces.starts[:, -1] + pieces.durations[:, -1]
    jumps[:, -1] = np.where(ends[:, -1] < until * (1.0 - _END), np.abs(last[1][:, -1]), 0.0)
    jump, worst = jumps.max(axis=1), jumps.argmax(axis=1)
    allowed = continuity * np.maximum(np.abs(first[0]).max(axis=1), 1.0)
    fastest = np.abs(derivative(powers[..., None], durations[..., None] * u, 1)).max(axis=2)
    most, at = fastest.max(axis=1), ends[lanes, fastest.argmax(axis=1)]
    tests = {
        "heading start": (off > allowed, off, np.zeros_like(off)),
        "heading jump": (jump > allowed, jump, ends[lanes, worst]),
        "yaw rate": above(most, case["limits.yaw_rate"], relative, at),
    }
    fine = np.linspace(0.0, 1.0, 2 * len(u) - 1)
    times = pieces.starts[..., None] + pieces.durations[..., None] * fine
    found = []
    for some in cut(len(lanes), _LANES):
        acc, jerk = motion_of(pieces.of(some), fine)[2:]
        yaw_rate = headings_of(case, some)(times[some])[1]
        squared = body_rate_squared(case["gravity"][some, None, None], acc, jerk, yaw_rate)
        found.append(squared.reshape(len(squared), -1))
    squared = np.concatenate(found)
    top, line = squared.argmax(axis=1), times.reshape(squared.shape)
    return most > 0.0, (squared[lanes, top], line[lanes, top]), tests
