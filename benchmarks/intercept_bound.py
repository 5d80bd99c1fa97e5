"""When a car can meet its target at the very earliest: a bound that no car beats.

The body's middle is taken for a point that may go in any direction at once, no faster than a car
that gives all it has from the start, and that keeps half the body's width from everything. Cells
here hold every such point: one that is reached in part counts in full, and one that is blocked in
part is free. So a target that they do not meet at a layer's time cannot be met at that time.
Obstacles are looked at after every half layer; a car's way in one is less than what half its width
on both sides makes of the thinnest wall.
"""

import numpy as np

from planner_jax.benchmarks.intercept_lattice import Scene, as_integer, near, shifted

CELL = 0.0125  # [m], side of a cell
_SLACK = CELL * np.sqrt(0.5)  # [m], from a cell's middle to its farthest point


def earliest_bound(scene: Scene) -> tuple[bool, float]:
    """Whether the bound allows a meeting at the case's time, and its first layer [s], or inf."""
    middle = scene.start[:2] + scene.middle * np.array(
        [np.cos(scene.start[2]), np.sin(scene.start[2])]
    )
    first = np.floor((middle - scene.lower) / CELL + 0.5).astype(int)
    count = first + np.floor((scene.upper - middle) / CELL + 0.5).astype(int) + 1
    origin = middle - first * CELL
    radius = 0.5 * scene.width - _SLACK
    columns, rows = (origin[k] + CELL * np.arange(count[k]) for k in (0, 1))
    # Where a mover is drawn is rounded to whole cells, for which it gives way by as much again.
    movers = [_drawn(corners, radius - _SLACK) for corners in scene.movers]
    ways = _ways(scene)
    guard = max([int(ways.max() / CELL) + 2, *(drawn.shape[1] for _, drawn in movers)])
    stride = int(count[0]) + guard
    blocked = np.zeros((count[1], count[0]), bool)
    for corners in scene.walls:
        blocked |= near(columns, rows, corners, radius)
    free = as_integer(~blocked, stride)
    stencils = [(low, drawn.shape[::-1], as_integer(drawn, stride)) for low, drawn in movers]
    plane, earliest, meets = 1 << int(first[1] * stride + first[0]), np.inf, False
    for half, way in enumerate(ways, 1):
        plane = _grown(plane, way / CELL, stride) & free
        for velocity, (low, size, stencil) in zip(scene.velocities, stencils, strict=True):
            moved = (0.5 * velocity * half * scene.dt - origin) / CELL
            cell = np.floor(moved + 0.5).astype(int) + low
            if (cell < count).all() and (cell + size > 0).all():
                plane ^= plane & shifted(stencil, int(cell[1] * stride + cell[0]))
        if half % 2 == 0:
            meets = bool(plane & _goal(scene, half // 2, origin, count, stride))
            earliest = min(earliest, 0.5 * half * scene.dt) if meets else earliest
    return meets, earliest


def _ways(scene: Scene) -> np.ndarray:
    """How far (2 L,) [m] the body's middle comes in each half layer at most.

    Its speed is sqrt(v^2 + (b v kappa)^2), b ahead of the rear axle; (v kappa)^2 is the product
    of kappa and v^2 kappa, both of which have limits. It is convex in v, so that the trapezoid
    of an even rise is no less than the integral.
    """
    step = 0.5 * scene.dt
    times = step * np.arange(2 * len(scene.target) - 1)
    v = np.minimum(scene.speed, scene.initial_speed + scene.acceleration * times)
    aside = scene.middle**2 * scene.curvature * scene.lateral_acceleration
    speed = np.sqrt(v**2 + aside)
    rising = 0.5 * step * (speed[:-1] + speed[1:])
    return np.where(v[1:] < scene.speed, rising, step * speed[1:])


def _drawn(corners: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """First cell (2,) and cells (Y, X) around a polygon where the body's middle may not be."""
    low = np.floor((corners.min(axis=0) - radius) / CELL).astype(int)
    high = np.ceil((corners.max(axis=0) + radius) / CELL).astype(int)
    x, y = (CELL * np.arange(low[k], high[k] + 1) for k in (0, 1))
    return low, near(x, y, corners, radius)


def _grown(plane: int, way: float, stride: int) -> int:
    """Cells that hold a point no farther than so many cells from a point of a cell of a plane."""
    grown, wide, width = 0, plane, 0
    for row in range(int(way) + 1, -1, -1):
        reach = int(np.sqrt(way**2 - max(row - 1, 0) ** 2)) + 1
        for by in range(width + 1, reach + 1):
            wide |= plane << by | plane >> by
        width = reach
        grown |= wide << row * stride | wide >> row * stride
    return grown


def _goal(scene: Scene, layer: int, origin: np.ndarray, count: np.ndarray, stride: int) -> int:
    """Cells that hold a point within the tolerance of the target."""
    place = (scene.target[layer] - origin) / CELL
    reach = scene.tolerance / CELL
    side = np.arange(-int(reach) - 2, int(reach) + 3)
    cells = np.stack(np.meshgrid(side, side), axis=2).reshape(-1, 2)
    cells = cells + np.floor(place + 0.5).astype(int)
    away = np.maximum(np.abs(cells - place) - 0.5, 0.0)
    meets = (np.linalg.norm(away, axis=1) <= reach) & ((cells >= 0) & (cells < count)).all(axis=1)
    return sum(1 << int(bit) for bit in cells[meets] @ np.array([1, stride]))
