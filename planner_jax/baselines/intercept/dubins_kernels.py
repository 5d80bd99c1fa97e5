"""Closed forms of Dubins paths, compiled by numba; importing this module requires numba.

A Dubins word is a sequence of left turns L, right turns R and straight lines S, such as LSL. The
unit of length is the least turning radius, and the start is the origin, with heading 0. All code is
scalar and runs on the host in float64.
"""

import math

import numpy as np
from numba import njit

TURN = 2.0 * math.pi


@njit(cache=True)
def _positive(angle):
    """Return an angle modulo 2 pi in [0, 2 pi); values within 1e-9 of 2 pi become 0."""
    turned = angle % TURN
    return 0.0 if turned > TURN - 1e-9 else turned


@njit(cache=True)
def words_to_pose(x, y, heading, lengths):
    """Compute the Dubins paths from the origin to the pose (x, y, heading).

    Row k of `lengths` (6, 3) receives the lengths of the three parts of path k, with the words LSL,
    LSR, LRL, RSR, RSL and RLR. A row is infinite if no path of this word exists.
    """
    lengths[:, :] = np.inf
    sin, cos = math.sin(heading), math.cos(heading)
    for side in range(2):
        if side == 1:
            y, sin, heading = -y, -sin, -heading
        row = 3 * side
        # Vector between the centres of the first and last turning circle, with equal directions.
        across, up = x - sin, y + cos - 1.0
        far = math.sqrt(across**2 + up**2)
        if far < 1e-9:
            lengths[row, 0], lengths[row, 1], lengths[row, 2] = _positive(heading), 0.0, 0.0
        else:
            angle = math.atan2(up, across)
            lengths[row, 0], lengths[row, 1] = _positive(angle), far
            lengths[row, 2] = _positive(heading - angle)
            if far < 4.0:
                middle = TURN - math.acos(1.0 - far**2 / 8.0)
                first = _positive(angle + 0.5 * middle)
                lengths[row + 2, 0], lengths[row + 2, 1] = first, middle
                lengths[row + 2, 2] = _positive(heading - first + middle)
        across, up = x + sin, y - cos - 1.0
        square = across**2 + up**2 - 4.0
        if square >= 0.0:
            straight = math.sqrt(square)
            angle = math.atan2(up, across) + math.atan2(2.0, straight)
            lengths[row + 1, 0], lengths[row + 1, 1] = _positive(angle), straight
            lengths[row + 1, 2] = _positive(angle - heading)


# Turning directions of the three parts of LSL, LSR, LRL, RSR, RSL and RLR: 1 left, -1 right.
SENSES = np.array(
    [[1, 0, 1], [1, 0, -1], [1, -1, 1], [-1, 0, -1], [-1, 0, 1], [-1, 1, -1]], np.float64
)


@njit(cache=True)
def words_to_point(x, y, lengths):
    """Compute the two paths of a turn, then a straight line, from the origin to a point (x, y).

    Row 0 of `lengths` (6, 3) receives the path that starts with a left turn, row 3 the path with a
    right turn: length of turn, length of line, 0. All other rows become infinite.
    """
    lengths[:] = np.inf
    for side in range(2):
        up = (y if side == 0 else -y) - 1.0
        square = x**2 + up**2 - 1.0
        if square >= 0.0:
            straight = math.sqrt(square)
            angle = math.atan2(up, x) + math.atan2(1.0, straight)
            row = 3 * side
            lengths[row, 0], lengths[row, 1], lengths[row, 2] = _positive(angle), straight, 0.0


@njit(cache=True)
def length_to_point(x, y):
    """Return the length of the shortest path from the origin to a point, with any final heading.

    The shortest path is a turn and a straight line or, if the point is inside a turning circle, two
    turns [Bui1994].
    """
    y = abs(y)
    best = np.inf
    for side in (1.0, -1.0):
        up = side * y - 1.0
        square = x**2 + up**2 - 1.0
        if square >= 0.0:
            straight = math.sqrt(square)
            angle = math.atan2(up, x) + math.atan2(1.0, straight)
            best = min(best, _positive(angle) + straight)
        else:  # inside this circle: turn away from it first, then towards it
            far = math.sqrt(x**2 + (y + 1.0) ** 2)
            half = math.acos(min(max((far**2 + 3.0) / (4.0 * far), -1.0), 1.0))
            for sign in (1.0, -1.0):
                touch = math.atan2(y + 1.0, x) + sign * half
                end_x, end_y = x - 2.0 * math.cos(touch), y + 1.0 - 2.0 * math.sin(touch)
                first = _positive(0.5 * math.pi - touch)
                best = min(best, first + _positive(math.atan2(end_y, end_x) - touch - math.pi))
    return best


@njit(cache=True)
def in_frame(pose, goal, curvature):
    """Return how far ahead and to the left of a pose a goal is, in units of 1 / curvature."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    east, north = goal.pose[0] - pose[0], goal.pose[1] - pose[1]
    return (cos * east + sin * north) * curvature, (cos * north - sin * east) * curvature


@njit(cache=True)
def least_length(pose, goal, middle, curvature, lengths):
    """Return the length [m] of the shortest path from a pose to a goal without obstacles.

    If the heading at the goal is free, the result is a lower bound of this length.

    Args:
        pose: (3,) x, y [m] of the rear axle and heading [rad].
        goal: pose of the rear axle, or point for the body's centre if its heading is free.
        middle: [m], distance of the body's centre ahead of the rear axle.
        curvature: [1/m], greatest curvature.
        lengths: (6, 3), workspace.
    """
    x, y = in_frame(pose, goal, curvature)
    if goal.has_heading:
        words_to_pose(x, y, goal.pose[2] - pose[2], lengths)
        best = np.inf
        for row in range(6):
            best = min(best, lengths[row, 0] + lengths[row, 1] + lengths[row, 2])
        return best / curvature
    # The body's centre reaches the goal when the rear axle is `middle` [m] short of it.
    return max(length_to_point(x, y) / curvature - middle, 0.0)
