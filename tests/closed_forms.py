"""Closed forms that tests hold the library against."""

import numpy as np

from planner_jax.task.hit import court


def region_of(x, y):
    """Code of the region that points (...) [m] of the court's floor lie in, whichever the half.

    1 to 4 for N, F, L, R; 0 in the dead zone, outside the court, or for NaN.
    """
    depth, aside = np.abs(x), np.abs(y)
    inside = (depth >= court.DEAD_ZONE) & (depth <= court.HALF_LENGTH) & (aside <= court.HALF_WIDTH)
    middle = np.where(depth < court.NEAR_LINE, 1, 2)
    side = np.where(np.asarray(y) > 0.0, 3, 4)
    return np.where(inside, np.where(aside < court.LANE_LINE, middle, side), 0)
