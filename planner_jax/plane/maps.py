"""Occupancy grids, which are maps of square cells, and rectangles that cover occupied cells."""

import dataclasses
import math
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from planner_jax.core.checks import (
    numbers_of,
    numeric,
    require_number,
    require_path_name,
    require_switch,
)
from planner_jax.core.choices import require, require_one_of, require_size
from planner_jax.core.errors import ArgumentError, ArgumentTypeError, PlannerJaxError
from planner_jax.core.rules import FINITE, POSITIVE, Rule, within
from planner_jax.host.files import open_plain
from planner_jax.host.yaml_files import read_fields

_FIELDS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode")
_SHARE = within(0.0, 1.0, "from 0 to 1")
_MOST_PIXELS = 1 << 24  # greatest number of pixels of a map, as 4096 x 4096
_MOST_NUMBERS = 1 << 20  # greatest number of pixels of a PGM file in text (P2)
_HEADER = 1 << 12  # [B] in which the header of a PGM file ends, with its comments
_NUMBER = rb"\s+(?:#[^\r\n]*[\r\n]\s*)*\d+"  # of the header, after comments
_PGM = re.compile(rb"P(?:[14](?:%b){2}|[2356](?:%b){3})\s" % (_NUMBER, _NUMBER))
MOST_WALLS = 5_000  # greatest number of rectangles that cover a grid


class MapError(PlannerJaxError, ValueError):
    """Error: a file of a map is invalid. The message names file and field."""


@dataclasses.dataclass(frozen=True)
class OccupancyMap:
    """A map of H x W square cells. The car must not touch occupied cells.

    Attributes:
        occupied: (H, W) bool, whether each cell is occupied; the row index rises with y, the column
            index with x.
        resolution: [m], length of a cell's side.
        origin: x, y [m] and yaw [rad] of the corner of cell (0, 0) in the world.
    """

    occupied: np.ndarray
    resolution: float
    origin: tuple[float, float, float]

    def walls(self, coarsen: int = 1) -> list[np.ndarray]:
        """Return polygons (V, 2) [m] that cover the occupied cells, and what no cell covers.

        The rectangles of `walls_of_grid` come first. If the grid is turned, four triangles follow.
        They cover the area from `lower` to `upper` that lies outside of the grid.
        """
        walls = walls_of_grid(self.occupied, self.resolution, self.origin, coarsen=coarsen)
        corners = self._corners()
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            along, across = b - a
            if min(abs(along), abs(across)) > 1e-3 * self.resolution:
                right = (b[0], a[1]) if along * across > 0.0 else (a[0], b[1])
                walls.append(np.array([a, right, b]))
        return walls

    @property
    def lower(self) -> np.ndarray:
        """Corner (2,) [m] of least x and y of the smallest upright rectangle with all cells."""
        return self._corners().min(axis=0)

    @property
    def upper(self) -> np.ndarray:
        """Corner (2,) [m] of greatest x and y of the smallest upright rectangle with all cells."""
        return self._corners().max(axis=0)

    def _corners(self) -> np.ndarray:
        height, width = self.occupied.shape
        return _rectangle((0, height, 0, width), self.resolution, np.asarray(self.origin))


def walls_of_grid(
    occupied: np.ndarray,
    resolution: float,
    origin: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    *,
    coarsen: int = 1,
) -> list[np.ndarray]:
    """Cover the occupied cells of a grid with few rectangles, for `walls` of a case.

    The rectangles may overlap. With `coarsen` = 1 they cover the occupied cells and no others.

    Args:
        occupied: (H, W) bool, whether each cell is occupied. The row index rises with y, and the
            column index with x.
        resolution: [m], length of a cell's side.
        origin: (3,), x and y [m] of the outer corner of cell (0, 0), and yaw [rad], by which the
            grid is turned about this corner.
        coarsen: >= 1. Blocks of `coarsen` x `coarsen` cells are occupied if one of their cells is.
            A greater number makes fewer rectangles and narrower passages; it never frees a cell.

    Returns:
        Rectangles with the corners (4, 2) [m], counter-clockwise.

    Raises:
        ArgumentTypeError: `occupied` is not a bool array with two axes.
        ArgumentError: a number is out of its range, `origin` has another shape, or more than 5,000
            rectangles would be needed.
    """
    cells = numeric(occupied)
    if cells is None or cells.dtype != np.bool_ or cells.ndim != 2:
        raise ArgumentTypeError("occupied", "a bool array (H, W)", occupied)
    require_number("resolution", resolution, POSITIVE)
    place = np.asarray(numbers_of("origin", origin, (), (3,)), float)
    for each in place:
        require_number("origin", each)
    require_size("coarsen", coarsen)
    height, width = cells.shape
    blocks = np.pad(np.asarray(cells), [(0, -height % coarsen), (0, -width % coarsen)])
    rows, columns = blocks.shape[0] // coarsen, blocks.shape[1] // coarsen
    blocks = np.any(blocks.reshape(rows, coarsen, columns, coarsen), axis=(1, 3))
    # The last row and column of blocks end where the grid ends.
    y, x = (
        np.minimum(coarsen * np.arange(num + 1), most)
        for num, most in ((rows, height), (columns, width))
    )
    return [
        _rectangle((y[top], y[bottom], x[left], x[right]), resolution, place)
        for top, bottom, left, right in _cover(np.asarray(blocks))
    ]


def _rectangle(
    cells: tuple[int, int, int, int], resolution: float, origin: np.ndarray
) -> np.ndarray:
    low, high, left, right = cells
    corners = resolution * np.array([(left, low), (right, low), (right, high), (left, high)], float)
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    return origin[:2] + corners @ np.array([[cos, sin], [-sin, cos]])


def _cover(cells: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Return rectangles of cells, as first and next row, first and next column, that cover `cells`.

    Each rectangle begins at the first cell that no rectangle covers. It is grown along its row and
    then across, or along its column and then across, whichever covers more new cells.
    """
    # Numbers of occupied cells before each cell in its row, and in its column.
    left = np.cumsum(np.pad(cells, [(0, 0), (1, 0)]), axis=1, dtype=np.int32)
    below = np.cumsum(np.pad(cells, [(1, 0), (0, 0)]), axis=0, dtype=np.int32)
    free, found = cells.copy(), []
    for row, line in enumerate(free):
        while line.any():
            column = int(line.argmax())
            low, high = _grow(cells[row], column)
            one = (*_grow(left[:, high] - left[:, low] == high - low, row), low, high)
            low, high = _grow(cells[:, column], row)
            two = (low, high, *_grow(below[high] - below[low] == high - low, column))
            best = max((one, two), key=lambda r: free[r[0] : r[1], r[2] : r[3]].sum())
            free[best[0] : best[1], best[2] : best[3]] = False
            found.append(best)
            if len(found) > MOST_WALLS:
                rule = (
                    f"covered by at most {MOST_WALLS:,} rectangles (a greater coarsen needs fewer)"
                )
                raise ArgumentError("occupied", rule, shown=f"{cells.sum():,} occupied cells")
    return found


def _grow(line: np.ndarray, at: int) -> tuple[int, int]:
    """Return first and next index of the run of true entries that contains the index `at`."""
    before, after = np.flatnonzero(~line[:at]), np.flatnonzero(~line[at:])
    return (before[-1] + 1 if len(before) else 0), (at + after[0] if len(after) else len(line))


def read_map(path: str | os.PathLike, *, unknown_is_free: bool = False) -> OccupancyMap:
    """Read a map that the `map_server` of ROS or ROS 2 saved: a YAML file and its image.

    The YAML file has the fields `image`, `resolution`, `origin` and optionally `negate`,
    `occupied_thresh`, `free_thresh` and `mode`, which must be `trinary`. A cell is occupied if the
    darkness of its pixel, from 0 for white to 1 for black, is above `occupied_thresh`. It is free
    if the darkness is below `free_thresh`, and unknown otherwise, or if its pixel is transparent.

    Args:
        path: path of the YAML file. The image is a PGM or PNG file of at most 2^24 pixels, or
            2^20 if it is a text (P2).
        unknown_is_free: whether unknown cells are free; by default they count as occupied.

    Raises:
        MapError: a field is missing, unknown or invalid, or the image cannot be read.
        OSError: the YAML file cannot be read.
    """
    require_path_name("path", path)
    require_switch("unknown_is_free", unknown_is_free)
    place = Path(path)
    try:
        return _read_map(place, read_fields(place), unknown_is_free)
    except ValueError as error:
        raise MapError(f"{place}: {error}") from None


def _read_map(place: Path, fields: Mapping, unknown_is_free: bool) -> OccupancyMap:
    for name in fields:
        require_one_of(_FIELDS, "field", name)
    resolution = _number("resolution", fields.get("resolution"), POSITIVE)
    origin = fields.get("origin")
    if not isinstance(origin, list) or len(origin) != 3:
        raise ArgumentError("origin", "a list of x, y and yaw", origin)
    x, y, yaw = (_number("origin", value) for value in origin)
    require_one_of(("trinary",), "mode", fields.get("mode", "trinary"))
    if not isinstance(image := fields.get("image"), str):
        raise ArgumentError("image", "the name of a file", image)
    require((negate := fields.get("negate", 0)) in (0, 1), "negate", "0 or 1", negate)
    occupied_thresh = _number("occupied_thresh", fields.get("occupied_thresh", 0.65), _SHARE)
    free_thresh = _number("free_thresh", fields.get("free_thresh", 0.196), _SHARE)
    rule = f"below occupied_thresh, {occupied_thresh:g}"
    require(free_thresh < occupied_thresh, "free_thresh", rule, free_thresh)
    level, lightness, is_opaque = _read_image(place.parent / image)
    darkness = lightness if negate else 1.0 - lightness
    occupied = (darkness > occupied_thresh)[level]
    if not unknown_is_free:
        occupied |= (darkness >= free_thresh)[level]
        occupied |= ~is_opaque
    return OccupancyMap(occupied[::-1], resolution, (x, y, yaw))  # the image's first row is on top


def _number(name: str, value: object, rule: Rule = FINITE) -> float:
    require_number(name, value, rule)
    return float(value)  # type: ignore[arg-type]


def _read_image(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return levels (H, W), lightness (L,) of each level, and which pixels (H, W) are opaque.

    The lightness is 0 for black and 1 for white.
    """
    from PIL import Image

    most, bombs = _MOST_PIXELS, (Image.DecompressionBombError, Image.DecompressionBombWarning)
    try:
        with open_plain(path) as file, warnings.catch_warnings(action="error", category=bombs[1]):
            # Pillow skips comments byte by byte, and reads texts (P1 to P3) slowly.
            start = file.read(_HEADER)
            if start.startswith(b"P"):
                if not _PGM.match(start):
                    raise ValueError(f"its header is incomplete or longer than {_HEADER} bytes")
                most = _MOST_NUMBERS if start[1:2] in b"123" else most
            file.seek(0)
            with Image.open(file, formats=("PPM", "PNG")) as image:
                if math.prod(image.size) > most:
                    raise ValueError(f"it has {image.size[0]} x {image.size[1]} pixels")
                if image.mode.startswith("I"):  # 16 bits
                    level = np.asarray(image).astype(np.uint16)
                    return level, np.arange(65536) / 65535.0, np.ones(level.shape, bool)
                pixels = np.asarray(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, *bombs) as error:
        problem = " ".join(str(error).split())[:120]
        rule = f"a PGM or PNG file of at most {most:,} pixels: {problem}"
        raise ArgumentError("image", rule, shown="") from None
    level = pixels[..., :3].sum(axis=2, dtype=np.uint16)
    return level, np.arange(766) / 3.0 / 255.0, pixels[..., 3] == 255
