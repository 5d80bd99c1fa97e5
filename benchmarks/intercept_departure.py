"""Check by sampling whether a car can leave the neighbourhood of its start without a collision.

`benchmarks.intercept_oracle` uses this check. A car that starts with a speed can neither turn on
the spot nor reverse. If an obstacle is close ahead, all of its motions may collide. The search of
`intercept_lattice` may find a motion in spite of this, because its cars turn instantly and its
positions are rounded. This search does not round states. It only merges states that lie in the same
small cell. It shares no code with the planners. Positions are in the plane of the world frame, in
SI units.

In each time step the steering angle changes at one of five rates, and the speed at one of three
accelerations. Steering that would exceed a limit of curvature or lateral acceleration is clipped,
even if real wheels could not turn back in time. So the search may accept an infeasible motion.
Because states are merged and discarded, it may also miss a feasible motion. Obstacles are checked
every 0.02 s.
"""

import numpy as np

from planner_jax.benchmarks.intercept_lattice import Scene

STEP = 0.1  # [s] Time step with constant steering rate and acceleration.
_PARTS = 5  # Number of parts of a step; obstacles are checked after each part.
# Sizes of a cell, within which states are merged: x [m], y [m], heading [rad], speed [m/s] and
# steering angle [rad].
_CELL = np.array([0.015, 0.015, 0.03, 0.08, 0.15])
_MOST = 20_000  # Maximum number of states. Of more states a random subset is kept.
_RATES = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])  # Steering rates, relative to their limit.
_PEDALS = np.array([-1.0, 0.0, 1.0])  # Accelerations, relative to their limit.


def departs(scene: Scene, far: float = 1.5, until: float = 6.0, alive: float = 2.0) -> bool:
    """Return whether a collision-free motion gets `far` [m] away from the start within `until` [s].

    If the target is met so near to the start or so early that the car need not get that far, a
    motion suffices that is free of collisions for `alive` [s] or until the meeting.
    """
    random = np.random.default_rng(0)
    steering = np.arctan(scene.wheelbase * scene.initial_curvature)
    states = np.array([[*scene.start, scene.initial_speed, steering]])
    end = scene.dt * (len(scene.target) - 1)
    must_leave = np.linalg.norm(scene.target[-1] - scene.start[:2]) >= far + scene.length
    must_leave &= end >= until
    for number in range(int((until if must_leave else min(alive, end)) / STEP + 1e-6)):
        states = _advance(scene, states, number * STEP)
        if not len(states):
            return False
        if must_leave and np.linalg.norm(states[:, :2] - scene.start[:2], axis=1).max() >= far:
            return True
        cells = np.round((states - states[0]) / _CELL).astype(np.int64)
        states = states[np.unique(cells, axis=0, return_index=True)[1]]
        if len(states) > _MOST:
            states = states[random.choice(len(states), _MOST, replace=False)]
    return not must_leave


def _advance(scene: Scene, states: np.ndarray, time: float) -> np.ndarray:
    """Return all collision-free states (M, 5) that are reached from N states (N, 5) in 0.1 s.

    A state has x [m], y [m], heading [rad], speed [m/s] and steering angle [rad].
    """
    x, y, heading, speed, steering = (
        np.repeat(column, len(_RATES) * len(_PEDALS)) for column in states.T
    )
    rates = scene.steering_rate * np.tile(np.repeat(_RATES, len(_PEDALS)), len(states))
    pedals = scene.acceleration * np.tile(_PEDALS, len(_RATES) * len(states))
    span = STEP / _PARTS
    for part in range(_PARTS):
        faster = np.clip(speed + span * pedals, 0.0, scene.speed)
        square = np.maximum(faster**2, 1e-9)
        most = np.minimum(scene.curvature, scene.lateral_acceleration / square)
        most = np.arctan(scene.wheelbase * most)
        turned = np.clip(steering + span * rates, -most, most)
        curvature = np.tan(0.5 * (steering + turned)) / scene.wheelbase
        distance = 0.5 * span * (speed + faster)
        middle = heading + 0.5 * distance * curvature
        x, y = x + distance * np.cos(middle), y + distance * np.sin(middle)
        heading, speed, steering = heading + distance * curvature, faster, turned
        free = is_free(scene, x, y, heading, time + (part + 1) * span)
        x, y, heading, speed, steering, rates, pedals = (
            each[free] for each in (x, y, heading, speed, steering, rates, pedals)
        )
    return np.stack([x, y, heading, speed, steering], axis=1)


def is_free(
    scene: Scene, x: np.ndarray, y: np.ndarray, heading: np.ndarray, time: float
) -> np.ndarray:
    """Return which of N cars are on the map and touch nothing at `time` [s], (N,) bool.

    The rear axles are at `x`, `y` [m], with the headings `heading` [rad], all (N,).
    """
    cos, sin = np.cos(heading), np.sin(heading)
    x, y = x + scene.middle * cos, y + scene.middle * sin
    free = (x >= scene.lower[0]) & (x <= scene.upper[0])
    free &= (y >= scene.lower[1]) & (y <= scene.upper[1])
    around = 0.5 * np.hypot(scene.length, scene.width)
    placed = [(corners, np.zeros(2)) for corners in scene.walls]
    placed += [
        (corners, velocity * time)
        for corners, velocity in zip(scene.movers, scene.velocities, strict=True)
    ]
    for corners, moved in placed:
        corners = corners + moved
        middle = corners.mean(axis=0)
        size = np.linalg.norm(corners - middle, axis=1).max()
        near = np.flatnonzero(free & (np.hypot(x - middle[0], y - middle[1]) < size + around))
        free[near] = _is_apart(scene, corners, x[near], y[near], cos[near], sin[near])
    return free


def _is_apart(scene: Scene, corners, x, y, cos, sin) -> np.ndarray:
    """Return for N cars whether the body does not overlap a convex polygon (V, 2) [m], (N,) bool.

    The rear axles are at `x`, `y` [m], and `cos`, `sin` belong to the headings, all (N,). The test
    searches a separating axis.
    """
    half = 0.5 * np.array([scene.length, scene.width])
    from_x, from_y = corners[:, 0, None] - x, corners[:, 1, None] - y  # (V, N) [m]
    along, across = cos * from_x + sin * from_y, cos * from_y - sin * from_x
    gap = np.maximum(along.min(axis=0), -along.max(axis=0)) - half[0]
    gap = np.maximum(gap, np.maximum(across.min(axis=0), -across.max(axis=0)) - half[1])
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        out = np.array([by - ay, ax - bx])
        length = np.hypot(*out)
        if length < 1e-9:
            continue
        out /= length
        height = out[0] * (x - ax) + out[1] * (y - ay)
        reach = half[0] * np.abs(out[0] * cos + out[1] * sin)
        reach = reach + half[1] * np.abs(out[1] * cos - out[0] * sin)
        gap = np.maximum(gap, height - reach)
    return gap > 0.0
