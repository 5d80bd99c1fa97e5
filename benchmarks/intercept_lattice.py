"""Compute which states a car can reach at each time, by exhaustive search on a lattice.

`benchmarks.intercept_oracle` uses the lattice, a grid of states, to tell infeasible interceptions
from failures of a planner. A state has the position of the rear axle, as the cell of a grid, one of
64 headings, and one of several speed levels. All reached cells with one heading and one speed are
the bits of one Python integer. A motion is then a shift of the bits, and a check for obstacles is a
bit mask. No code is shared with the planners. Positions are in the plane of the world frame, in SI
units.

Time is divided into layers of length `dt`. In each layer a car first moves straight for half of the
layer. Then its speed changes by at most one level, as the acceleration limit permits. Its heading
changes by at most the number of steps that the limits of curvature and lateral acceleration permit
at the new speed. Finally the car moves straight for the other half. Displacements are rounded to
whole cells. Rounding each displacement would accumulate errors. Instead the total displacement
since time 0 along a heading is rounded, and a shift is the difference of two totals. The start is
exactly the middle of a cell and has one of the headings. Its speed is rounded to the nearest level.
Obstacles are checked after every half layer, with positions rounded to 1/8 of a cell's side.
"""

import dataclasses
import functools
from collections.abc import Iterator

import numpy as np

CELL = 0.05  # [m] Side of a square cell of the lattice.
HEADINGS = 64  # Number of headings, equally spaced over a full turn.
LAYER = 0.25  # [s] Greatest length of a layer of time.
FINER = 4  # Side of a lattice cell, divided by the side of a cell of the grid for obstacles.
_FINE = CELL / FINER  # [m] Side of a cell of the grid for obstacles.


@dataclasses.dataclass(frozen=True)
class Scene:
    """One interception problem as plain numbers, with the target's position at each time step."""

    start: np.ndarray  # (3,) x [m], y [m] of the rear axle's middle and heading [rad]
    initial_speed: float  # [m/s]
    initial_curvature: float  # [1/m]
    dt: float  # [s], length of a layer (time step); the last of L layers ends at the case's time
    target: np.ndarray  # (L + 1, 2) [m], positions of the target at time 0 and after each layer
    tolerance: float  # [m], greatest distance of the body's middle from the target at the meeting
    end_heading: float  # [rad], required heading at the meeting
    heading_tolerance: float  # [rad], greatest deviation from this heading
    walls: tuple[np.ndarray, ...]  # corners (V, 2) [m] of each wall, counter-clockwise
    movers: tuple[np.ndarray, ...]  # corners (V, 2) [m] of each moving obstacle at time 0
    velocities: np.ndarray  # (M, 2) [m/s], constant velocities of the moving obstacles
    lower: np.ndarray  # (2,) [m], lower corner of the map, which the body's middle must not leave
    upper: np.ndarray  # (2,) [m], upper corner of the map
    length: float  # [m], length of the body
    width: float  # [m], width of the body
    middle: float  # [m], distance from the rear axle to the body's middle
    wheelbase: float  # [m]
    speed: float  # [m/s], limit
    acceleration: float  # [m/s^2], limit
    lateral_acceleration: float  # [m/s^2], limit
    curvature: float  # [1/m], limit
    steering_rate: float  # [rad/s], limit, which lattices ignore


@dataclasses.dataclass(frozen=True)
class Reach:
    """Result of a search on the grid of states: whether and when a car can meet the target."""

    at_end: bool  # whether the target can be met at the time that the case prescribes
    earliest: float  # [s], time of the first layer at which the target can be met, or infinity


def footprint(scene: Scene) -> tuple[list[float], float]:
    """Return two discs that cover the body: distances ahead of the rear axle, and radius [m]."""
    part = 0.25 * scene.length
    return [scene.middle - part, scene.middle + part], float(np.hypot(part, 0.5 * scene.width))


def near(x: np.ndarray, y: np.ndarray, corners: np.ndarray, radius: float) -> np.ndarray:
    """Return which points of a grid, (Y, X) bool, are within a radius of a convex polygon.

    Args:
        x: (X,) [m], x coordinates of the grid's columns.
        y: (Y,) [m], y coordinates of the grid's rows.
        corners: (V, 2) [m], corners of the polygon, counter-clockwise; they may be repeated.
        radius: [m], greatest distance from the polygon.
    """
    inside = np.ones((len(y), len(x)), bool)
    close = np.zeros_like(inside)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        ex, ey = bx - ax, by - ay
        square = ex**2 + ey**2
        from_x, from_y = x - ax, (y - ay)[:, None]
        inside &= ex * from_y >= ey * from_x
        along = ex * from_x + ey * from_y
        share = np.clip(along / square, 0.0, 1.0) if square > 1e-12 else 0.0 * along
        close |= (from_x - share * ex) ** 2 + (from_y - share * ey) ** 2 <= radius**2
    return inside | close


def _round(value: np.ndarray) -> np.ndarray:
    """Round numbers to integers; halves are rounded up, also for negative numbers."""
    return np.floor(value + 0.5).astype(int)


class Lattice:
    """Search of all states (position, heading and speed) that a car can reach in one scene.

    Two discs that cover the car's body replace it. Its heading changes by a fractional number of
    headings in a time step; fractions add up until they permit a whole heading. Methods represent a
    set of cells as an integer, with one bit for each cell.
    """

    def __init__(self, scene: Scene):
        if not np.isfinite([*scene.lower, *scene.upper, scene.speed, scene.acceleration]).all():
            raise ValueError("the map, the speed and the acceleration must be finite")
        self.scene = scene
        self.layers = len(scene.target) - 1
        self.ahead, self.radius = footprint(scene)
        angle = scene.start[2] + 2.0 * np.pi * np.arange(HEADINGS) / HEADINGS
        self.direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # (HEADINGS, 2)
        self._lay_grid()
        self._draw_movers()
        self.walls = self._draw_walls()
        self.placed = self._place_movers()
        self.levels, self.shifts, self.turns = self._list_moves()
        self.free = functools.cache(self._free)

    def _lay_grid(self) -> None:
        scene = self.scene
        first = np.ceil((scene.start[:2] - scene.lower + scene.middle) / CELL).astype(int)
        last = np.ceil((scene.upper + scene.middle - scene.start[:2]) / CELL).astype(int)
        self.first, self.count = first, first + last + 1
        self.origin = scene.start[:2] - first * CELL

    def _draw_movers(self) -> None:
        drawn = []
        for corners in self.scene.movers:
            low = np.floor((corners.min(axis=0) - self.radius) / _FINE).astype(int)
            high = np.ceil((corners.max(axis=0) + self.radius) / _FINE).astype(int)
            x, y = (_FINE * np.arange(low[k], high[k] + 1) for k in (0, 1))
            drawn.append((low, near(x, y, corners, self.radius)))
        # Empty columns separate the rows of cells, so that a shifted bit never enters another row.
        farthest = int(np.ceil(self.scene.speed * self.scene.dt / CELL)) + 2
        guard = max([farthest, *(-(-cells.shape[1] // FINER) for _, cells in drawn)])
        self.stride = int(self.count[0]) + guard
        parts = range(FINER)
        self.stencils = [
            (
                low,
                -(-np.array(cells.shape[::-1]) // FINER),
                [
                    [as_integer(cells[i::FINER, j::FINER], self.stride) for j in parts]
                    for i in parts
                ],
            )
            for low, cells in drawn
        ]

    def _draw_walls(self) -> list[int]:
        """Return for each heading the cells in which the car is on the map and touches no wall."""
        scene, pad = self.scene, int(np.ceil(max(self.ahead) / _FINE)) + 1
        fine = [
            self.origin[k] + _FINE * np.arange(-pad, FINER * self.count[k] + pad) for k in (0, 1)
        ]
        blocked = np.zeros((len(fine[1]), len(fine[0])), bool)
        for corners in scene.walls:
            reach = self.radius + _FINE
            box = [
                slice(*np.searchsorted(axis, [low - reach, high + reach]))
                for axis, low, high in zip(fine, corners.min(0), corners.max(0), strict=True)
            ]
            blocked[box[1], box[0]] |= near(fine[0][box[0]], fine[1][box[1]], corners, self.radius)
        free = []
        columns, rows = (self.origin[k] + CELL * np.arange(self.count[k]) for k in (0, 1))
        for x, y in self.direction:
            at_x, at_y = columns + scene.middle * x, rows + scene.middle * y
            is_free = ((at_y >= scene.lower[1]) & (at_y <= scene.upper[1]))[:, None] & (
                (at_x >= scene.lower[0]) & (at_x <= scene.upper[0])
            )
            for ahead in self.ahead:
                j, i = pad + _round(ahead * np.array([x, y]) / _FINE)
                is_free &= ~blocked[i::FINER, j::FINER][: self.count[1], : self.count[0]]
            free.append(as_integer(is_free, self.stride))
        return free

    def _list_moves(self) -> tuple[np.ndarray, list, list]:
        """Compute the speed levels of the grid of states, and all moves between its states.

        A set of cells is an integer with one bit for each cell, so a move shifts the bits.

        Returns:
            levels: (S,) [m/s], the S speed levels.
            shifts: number of bits of the shift in a straight move, indexed by half of a time step,
                speed and heading.
            turns: greatest change of the heading in a time step, in multiples of 1/64 turn, indexed
                by time step and speed.
        """
        scene = self.scene
        level = scene.acceleration * scene.dt
        levels = level * np.arange(int(scene.speed / level + 1e-6) + 1)
        half = 0.5 * scene.dt * levels[:, None, None] * self.direction / CELL  # (S, HEADINGS, 2)
        passed = _round(half * np.arange(2 * self.layers + 1)[:, None, None, None])
        steps = np.diff(passed, axis=0)
        shifts = (steps[..., 1] * self.stride + steps[..., 0]).tolist()
        rate = np.minimum(
            scene.curvature * levels, scene.lateral_acceleration / np.maximum(levels, 1e-9)
        )
        turn = rate * scene.dt * HEADINGS / (2.0 * np.pi)
        added = np.floor(turn * np.arange(self.layers + 1)[:, None] + 1e-6)
        return levels, shifts, np.diff(added, axis=0).astype(int).tolist()

    def _place_movers(self) -> list:
        scene, num = self.scene, 2 * self.layers + 1
        times = 0.5 * scene.dt * np.arange(num)
        drawn: list[list[list]] = [[[] for _ in range(HEADINGS)] for _ in range(num)]
        for velocity, (low, size, stencil) in zip(scene.velocities, self.stencils, strict=True):
            for ahead in self.ahead:
                place = (velocity * times[:, None] - self.origin)[:, None] - ahead * self.direction
                place = _round(place / _FINE) + low
                cell = -(-place // FINER)
                within = FINER * cell - place
                shift = cell[..., 1] * self.stride + cell[..., 0]
                seen = ((cell < self.count) & (cell + size > 0)).all(axis=2)
                for half, heading in np.argwhere(seen).tolist():
                    j, i = within[half, heading]
                    drawn[half][heading].append((stencil[i][j], int(shift[half, heading])))
        return drawn

    def _free(self, half: int, heading: int) -> int:
        blocked = 0
        for stencil, shift in self.placed[half][heading]:
            blocked |= shift_bits(stencil, shift)
        walls = self.walls[heading]
        return walls ^ (walls & blocked)

    def goal(self, layer: int) -> list[int]:
        scene = self.scene
        reach = scene.tolerance + CELL * np.sqrt(0.5)
        place = (scene.target[layer] - self.origin - scene.middle * self.direction) / CELL
        side = np.arange(-int(reach / CELL) - 1, int(reach / CELL) + 2)
        cells = np.stack(np.meshgrid(side, side), axis=2).reshape(-1, 2) + _round(place)[:, None]
        meets = np.linalg.norm(cells - place[:, None], axis=2) * CELL <= reach
        meets &= ((cells >= 0) & (cells < self.count)).all(axis=2)
        angle = scene.start[2] - scene.end_heading + 2.0 * np.pi * np.arange(HEADINGS) / HEADINGS
        off = np.abs(np.arctan2(np.sin(angle), np.cos(angle)))
        meets &= (off <= scene.heading_tolerance + np.pi / HEADINGS)[:, None]
        bits = cells[..., 1] * self.stride + cells[..., 0]
        return [
            sum(1 << int(bit) for bit in row[hits]) for row, hits in zip(bits, meets, strict=True)
        ]

    def sets(self) -> Iterator[list[list[int]]]:
        """Yield the reached cells after 0, 1, ... L layers (time steps).

        Each item is indexed by speed level and heading. The cells are the bits of an integer.
        """
        num, start = len(self.levels), int(self.first[1] * self.stride + self.first[0])
        planes = [[0] * HEADINGS for _ in range(num)]
        rise = self.scene.acceleration * self.scene.dt
        level = min(int(self.scene.initial_speed / rise + 0.5), num - 1)
        planes[level][0] = (1 << start) & self.free(0, 0)
        yield planes
        for layer in range(self.layers):
            planes = self._move(planes, 2 * layer)
            planes = [
                [a | b | c for a, b, c in zip(*self.neighbours(planes, k), strict=True)]
                for k in range(num)
            ]
            turns = self.turns[layer]
            planes = [spread(row, turn) for row, turn in zip(planes, turns, strict=True)]
            planes = self._move(planes, 2 * layer + 1)
            yield planes

    def neighbours(self, planes: list[list[int]], k: int) -> list[list[int]]:
        last = len(planes) - 1
        return [planes[max(k - 1, 0)], planes[k], planes[min(k + 1, last)]]

    def _move(self, planes: list[list[int]], half: int) -> list[list[int]]:
        """Move all reached states straight ahead for half a layer, and remove those that collide.

        `planes` has the reached cells by speed level and heading, as bits of integers. `half` is
        the number of half layers (half time steps) since time 0.
        """
        return [
            [
                shift_bits(plane, shift) & self.free(half + 1, heading) if plane else 0
                for heading, (plane, shift) in enumerate(zip(row, shifts, strict=True))
            ]
            for row, shifts in zip(planes, self.shifts[half], strict=True)
        ]

    def meets(self, planes: list[list[int]], layer: int) -> bool:
        """Return whether a reached state meets the target after `layer` time steps."""
        goal = self.goal(layer)
        return any(plane & goal[heading] for row in planes for heading, plane in enumerate(row))

    def reach(self) -> Reach:
        """Search for meetings with the target at all time steps."""
        earliest, at_end = np.inf, False
        for layer, planes in enumerate(self.sets()):
            at_end = layer > 0 and self.meets(planes, layer)
            if at_end:
                earliest = min(earliest, layer * self.scene.dt)
        return Reach(at_end=at_end, earliest=earliest)


def as_integer(cells: np.ndarray, stride: int) -> int:
    """Pack a mask of cells (Y, X) into the bits of an integer, with rows `stride` bits apart."""
    padded = np.zeros((len(cells), stride), bool)
    padded[:, : cells.shape[1]] = cells
    return int.from_bytes(np.packbits(padded, bitorder="little").tobytes(), "little")


def shift_bits(plane: int, shift: int) -> int:
    """Shift the bits of an integer to higher positions, or to lower ones if `shift` is negative."""
    return plane << shift if shift >= 0 else plane >> -shift


def spread(row: list[int], turn: int) -> list[int]:
    # row[h] is the set of cells with heading h; spread[h] unites row[h] to row[h + width - 1].
    target, width, spread = 2 * turn + 1, 1, row
    while width < target:
        step = min(width, target - width)
        spread = [spread[h] | spread[(h + step) % HEADINGS] for h in range(HEADINGS)]
        width += step
    return spread[-turn:] + spread[:-turn] if turn else spread
