"""Occupancy grids, which are maps of square cells, and rectangles that cover occupied cells."""

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from planner_jax.core.checks import numbers_of, numeric, require_number
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentTypeError, PlannerJaxError
from planner_jax.core.rules import POSITIVE
from planner_jax.host.files import open_plain
from planner_jax.host.yaml_files import read_fields


class MapError(PlannerJaxError, ValueError):
    """Error: a file of a map is invalid. The message names file and field."""


@dataclasses.dataclass(frozen=True)
class OccupancyMap:
    """A map of H x W square cells. The car must not touch occupied cells."""

    occupied: np.ndarray  # (H, W) bool; the row index rises with y, the column index with x
    resolution: float  # [m], length of a cell's side
    origin: tuple[float, float, float]  # x, y [m] of the map's corner of cell (0, 0), yaw [rad]

    def walls(self, coarsen: int = 1) -> list[np.ndarray]:
        """Return few rectangles (4, 2) [m] that cover the occupied cells; see `walls_of_grid`."""
        return walls_of_grid(self.occupied, self.resolution, self.origin, coarsen=coarsen)

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
        ArgumentError: a number is out of its range, or `origin` has another shape.
    """
    cells = numeric(occupied)
    if cells is None or cells.dtype != np.bool_ or cells.ndim != 2:
        raise ArgumentTypeError("occupied", "a bool array (H, W)", occupied)
    require_number("resolution", resolution, POSITIVE)
    place = numbers_of("origin", origin, (), (3,)).astype(float)
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
    free, found = cells.copy(), []
    for row, column in np.argwhere(cells):
        if not free[row, column]:
            continue
        low, high = _grow(cells[row], column)
        one = (*_grow(np.asarray(cells[:, low:high].all(axis=1)), row), low, high)
        low, high = _grow(cells[:, column], row)
        two = (low, high, *_grow(np.asarray(cells[low:high].all(axis=0)), column))
        best = max((one, two), key=lambda r: free[r[0] : r[1], r[2] : r[3]].sum())
        free[best[0] : best[1], best[2] : best[3]] = False
        found.append(best)
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
        path: path of the YAML file. The image is a PGM (P2, P5) or PNG file.
        unknown_is_free: whether unknown cells are free; by default they count as occupied.

    Raises:
        MapError: a field is missing or invalid, or the image cannot be read.
        OSError: the YAML file cannot be read.
    """
    place = Path(path)
    try:
        fields = read_fields(place)
    except ValueError as error:
        raise MapError(f"{place}: {error}") from None
    resolution = _number(place, fields, "resolution")
    if resolution <= 0.0:
        raise MapError(f"{place}: resolution must be > 0, got {resolution:g}")
    origin = fields.get("origin")
    if not isinstance(origin, list) or len(origin) != 3:
        raise MapError(f"{place}: origin must be a list of x, y and yaw, got {origin!r:.60}")
    x, y, yaw = (_number(place, dict(enumerate(origin)), k, "origin") for k in range(3))
    if (mode := fields.get("mode", "trinary")) != "trinary":
        raise MapError(f"{place}: mode must be trinary, got {mode!r:.60}")
    image = fields.get("image")
    if not isinstance(image, str):
        raise MapError(f"{place}: image must name a file, got {image!r:.60}")
    lightness, is_opaque = _read_image(place, place.parent / image)
    darkness = lightness if _number(place, fields, "negate", usual=0.0) else 1.0 - lightness
    occupied = darkness > _number(place, fields, "occupied_thresh", usual=0.65)
    if not unknown_is_free:
        occupied |= ~(darkness < _number(place, fields, "free_thresh", usual=0.196))
        occupied |= ~is_opaque
    return OccupancyMap(occupied[::-1], resolution, (x, y, yaw))  # the image's first row is on top


def _number(
    place: Path, fields: Mapping, key: object, name: str = "", usual: float | None = None
) -> float:
    value = fields.get(key, usual)
    number = float(value) if isinstance(value, int | float) else math.nan
    if not math.isfinite(number):
        raise MapError(f"{place}: {name or key} must be a finite number, got {value!r:.60}")
    return number


def _read_image(place: Path, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return lightness (H, W), from 0 for black to 1 for white, and which pixels are opaque."""
    from PIL import Image

    try:
        with open_plain(path) as file, Image.open(file, formats=("PPM", "PNG")) as image:
            if image.mode.startswith("I"):  # 16 bits
                lightness = np.asarray(image, float) / 65535.0
                return lightness, np.ones(lightness.shape, bool)
            pixels = np.asarray(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        problem = " ".join(str(error).split())[:120]
        raise MapError(f"{place}: image must be a PGM or PNG file: {problem}") from None
    return pixels[..., :3].mean(axis=2) / 255.0, pixels[..., 3] == 255
