"""Compute a lower bound on the time at which any car can meet its target.

`benchmarks.intercept_oracle` uses this bound to prove that cases are infeasible. The car is
replaced by a point at the middle of its body, which may change its direction instantly. The point's
speed at each time is the greatest that a car can have by then. The point keeps only half the body's
width from all obstacles. So the point reaches every position that the middle of a car can reach.

The plane is divided into square cells, and time into layers (time steps). A cell counts as reached
if the point can be anywhere in it, and as free of obstacles if any part of it is free. Hence, if no
reached cell contains the target at the time of a layer, no car meets the target then. Obstacles are
checked twice per layer. Between two checks a car moves less than the thickness of the thinnest wall
plus the body's width, so that the point cannot jump over a wall.
"""

import numpy as np

from planner_jax.benchmarks.intercept_lattice import Scene, as_integer, near, shift_bits

CELL = 0.0125  # [m] Side of a square cell.
_SLACK = CELL * np.sqrt(0.5)  # [m] Distance from the middle of a cell to its corners.


def earliest_bound(scene: Scene) -> tuple[bool, float]:
    """Return whether a car may meet the target at the prescribed time, and the earliest time [s].

    False proves that a meeting at the time which the case prescribes is impossible. The earliest
    time is the time of a layer (time step): at every earlier layer a meeting is impossible. It is
    infinite if no layer permits a meeting.
    """
    middle = scene.start[:2] + scene.middle * np.array(
        [np.cos(scene.start[2]), np.sin(scene.start[2])]
    )
    first = np.floor((middle - scene.lower) / CELL + 0.5).astype(int)
    count = first + np.floor((scene.upper - middle) / CELL + 0.5).astype(int) + 1
    origin = middle - first * CELL
    radius = 0.5 * scene.width - _SLACK
    columns, rows = (origin[k] + CELL * np.arange(count[k]) for k in (0, 1))
    # Positions of moving obstacles are rounded to whole cells. The distance by which obstacles are
    # enlarged is therefore reduced by the greatest rounding error, so that no free cell is blocked.
    movers = [_draw_polygon(corners, radius - _SLACK) for corners in scene.movers]
    steps = _limit_steps(scene)
    guard = max([int(steps.max() / CELL) + 2, *(drawn.shape[1] for _, drawn in movers)])
    stride = int(count[0]) + guard
    blocked = np.zeros((count[1], count[0]), bool)
    for corners in scene.walls:
        blocked |= near(columns, rows, corners, radius)
    free = as_integer(~blocked, stride)
    stencils = [(low, drawn.shape[::-1], as_integer(drawn, stride)) for low, drawn in movers]
    plane, earliest, meets = 1 << int(first[1] * stride + first[0]), np.inf, False
    for half, distance in enumerate(steps, 1):
        plane = _grow(plane, distance / CELL, stride) & free
        for velocity, (low, size, stencil) in zip(scene.velocities, stencils, strict=True):
            moved = (0.5 * velocity * half * scene.dt - origin) / CELL
            cell = np.floor(moved + 0.5).astype(int) + low
            if (cell < count).all() and (cell + size > 0).all():
                plane ^= plane & shift_bits(stencil, int(cell[1] * stride + cell[0]))
        if half % 2 == 0:
            meets = bool(plane & _draw_goal(scene, half // 2, origin, count, stride))
            earliest = min(earliest, 0.5 * half * scene.dt) if meets else earliest
    return meets, earliest


def _limit_steps(scene: Scene) -> np.ndarray:
    """Return upper bounds (2 L,) [m] on the distance covered in each half of L time steps.

    The bounds are for the body's middle, which is b ahead of the rear axle. On a path of curvature
    kappa, its speed is sqrt(v^2 + (b v kappa)^2), where v is the speed of the rear axle. The term
    (v kappa)^2 is the curvature kappa times the lateral acceleration v^2 kappa, and both are
    limited. The speed is convex in v, so for linearly increasing v the trapezoid rule is an upper
    bound.
    """
    step = 0.5 * scene.dt
    times = step * np.arange(2 * len(scene.target) - 1)
    v = np.minimum(scene.speed, scene.initial_speed + scene.acceleration * times)
    aside = scene.middle**2 * scene.curvature * scene.lateral_acceleration
    speed = np.sqrt(v**2 + aside)
    rising = 0.5 * step * (speed[:-1] + speed[1:])
    return np.where(v[1:] < scene.speed, rising, step * speed[1:])


def _draw_polygon(corners: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    low = np.floor((corners.min(axis=0) - radius) / CELL).astype(int)
    high = np.ceil((corners.max(axis=0) + radius) / CELL).astype(int)
    x, y = (CELL * np.arange(low[k], high[k] + 1) for k in (0, 1))
    return low, near(x, y, corners, radius)


def _grow(plane: int, distance: float, stride: int) -> int:
    """Return all cells that a point can reach from a set of cells by moving `distance` cells.

    A set of cells is an integer with one bit for each cell, and `stride` bits for each row of
    cells.
    """
    grown, wide, width = 0, plane, 0
    for row in range(int(distance) + 1, -1, -1):
        reach = int(np.sqrt(distance**2 - max(row - 1, 0) ** 2)) + 1
        for by in range(width + 1, reach + 1):
            wide |= plane << by | plane >> by
        width = reach
        grown |= wide << row * stride | wide >> row * stride
    return grown


def _draw_goal(scene: Scene, layer: int, origin: np.ndarray, count: np.ndarray, stride: int) -> int:
    """Return the cells that are near enough to the target after `layer` time steps to meet it.

    The result is an integer with one bit for each cell.
    """
    place = (scene.target[layer] - origin) / CELL
    reach = scene.tolerance / CELL
    side = np.arange(-int(reach) - 2, int(reach) + 3)
    cells = np.stack(np.meshgrid(side, side), axis=2).reshape(-1, 2)
    cells = cells + np.floor(place + 0.5).astype(int)
    away = np.maximum(np.abs(cells - place) - 0.5, 0.0)
    meets = (np.linalg.norm(away, axis=1) <= reach) & ((cells >= 0) & (cells < count)).all(axis=1)
    return sum(1 << int(bit) for bit in cells[meets] @ np.array([1, stride]))
