"""Closed forms of court regions and turning paths, with which tests compare the library."""

import numpy as np

from planner_jax.task.hit import court


def region_of(x, y):
    """Return the court region (...) at x, y [m]: 1 near, 2 far, 3 left, 4 right, or 0 outside."""
    depth, aside = np.abs(x), np.abs(y)
    inside = (depth >= court.DEAD_ZONE) & (depth <= court.HALF_LENGTH) & (aside <= court.HALF_WIDTH)
    middle = np.where(depth < court.NEAR_LINE, 1, 2)
    side = np.where(np.asarray(y) > 0.0, 3, 4)
    return np.where(inside, np.where(aside < court.LANE_LINE, middle, side), 0)


def positions_on(path, times):
    times = np.asarray(times, float)
    pos, vel = (np.asarray(leaf, float) @ [1.0, 1.0j] for leaf in (path.pos, path.vel))
    rate = np.asarray(path.turn_rate, float)
    if times.ndim:
        pos, vel, rate = pos[..., None], vel[..., None], rate[..., None]
    angle = rate * times
    safe = np.where(angle == 0.0, 1.0, angle)
    point = pos + vel * times * np.where(angle == 0.0, 1.0, np.expm1(1j * safe) / (1j * safe))
    return np.stack([point.real, point.imag], axis=-1)
