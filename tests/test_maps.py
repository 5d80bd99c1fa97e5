"""Occupancy grids: rectangles that cover them, and files of ROS maps."""

import numpy as np
import pytest
from matplotlib.path import Path
from PIL import Image

import planner_jax as pj
from planner_jax.core.errors import ArgumentError
from planner_jax.plane.maps import MapError

FIELDS = {
    "image": "map.pgm",
    "resolution": "0.05",
    "origin": "[-1.0, 2.0, 0.0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}
# Rows of pixels from the top: occupied, unknown and free, as map_server writes them.
PIXELS = np.array([[0, 205, 254], [254, 254, 254]], np.uint8)


def write_map(folder, pixels: np.ndarray = PIXELS, name="map.pgm", **fields):
    """Write a map's YAML file and image into a folder, and return the path of the YAML file."""
    Image.fromarray(pixels).save(folder / name)
    return write_fields(folder / "map.yaml", **{"image": name, **fields})


def write_fields(path, **fields):
    """Write the YAML file of a map, without the fields that are "", and return its path."""
    lines = {**FIELDS, **fields}
    path.write_text("".join(f"{key}: {text}\n" for key, text in lines.items() if text != ""))
    return path


def covered(walls, x, y):
    """Return which points are inside of a wall, with the shape of `x` and `y`."""
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    inside = [Path(wall).contains_points(points) for wall in walls]
    return np.any(inside, axis=0).reshape(x.shape)


@pytest.mark.parametrize("density", [0.2, 0.5, 0.9])
def test_rectangles_cover_occupied_cells_and_no_others(density):
    cells = np.random.default_rng(1).uniform(size=(20, 31)) < density
    walls = pj.intercept.walls_of_grid(cells, 0.5, (3.0, -2.0, 0.4))
    column, row = np.meshgrid(0.5 * (np.arange(31) + 0.5), 0.5 * (np.arange(20) + 0.5))
    x = 3.0 + np.cos(0.4) * column - np.sin(0.4) * row
    y = -2.0 + np.sin(0.4) * column + np.cos(0.4) * row
    np.testing.assert_array_equal(covered(walls, x, y), cells)
    assert len(walls) <= cells.sum() and pj.obstacles(walls).present.sum() == len(walls)


def test_a_room_has_four_rectangles_and_a_coarser_grid_frees_no_cell():
    room = np.ones((40, 60), bool)
    room[1:-1, 1:-1] = False
    assert len(pj.intercept.walls_of_grid(room, 0.1)) == 4
    cells = np.random.default_rng(2).uniform(size=(41, 62)) < 0.05
    fine, coarse = (pj.intercept.walls_of_grid(cells, 0.1, coarsen=k) for k in (1, 4))
    x, y = np.meshgrid(0.1 * (np.arange(62) + 0.5), 0.1 * (np.arange(41) + 0.5))
    assert covered(coarse, x, y)[cells].all() and len(coarse) < len(fine)
    assert np.max(coarse, axis=(0, 1)) == pytest.approx([6.2, 4.1], abs=0.3)
    assert (np.max(coarse, axis=(0, 1)) <= [6.2 + 1e-9, 4.1 + 1e-9]).all()


@pytest.mark.parametrize("name", ["map.pgm", "map.png"])
def test_a_map_of_ros_is_read_with_its_first_row_on_top(tmp_path, name):
    found = pj.intercept.read_map(write_map(tmp_path, name=name))
    np.testing.assert_array_equal(found.occupied, [[False] * 3, [True, True, False]])
    np.testing.assert_allclose(found.upper, [-0.85, 2.1])
    (wall,) = found.walls()
    np.testing.assert_allclose(wall, [(-1, 2.05), (-0.9, 2.05), (-0.9, 2.1), (-1, 2.1)])
    free = pj.intercept.read_map(tmp_path / "map.yaml", unknown_is_free=True)
    assert free.occupied.sum() == 1


def test_text_images_negated_maps_and_transparent_pixels_are_read(tmp_path):
    path = write_map(tmp_path, negate="1")
    assert pj.intercept.read_map(path, unknown_is_free=True).occupied.sum() == 5
    (tmp_path / "map.pgm").write_text("P2\n# a comment\n3 2\n100\n0 80 100\n100 100 100\n")
    assert pj.intercept.read_map(write_fields(path, negate="0")).occupied.sum() == 2
    clear = np.full((2, 3, 4), 255, np.uint8)
    clear[0, 0, 3] = 0
    assert pj.intercept.read_map(write_map(tmp_path, clear, "map.png")).occupied.sum() == 1
    deep = np.array([[0, 65535]], np.uint16)
    assert pj.intercept.read_map(write_map(tmp_path, deep, "map.png")).occupied.tolist() == [
        [True, False]
    ]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"resolution": "-1"}, "resolution must be finite and > 0, got -1"),
        ({"resolution": ""}, "resolution must be a number, got None"),
        ({"origin": "[0, 0]"}, "origin must be a list of x, y and yaw"),
        ({"origin": "[0, 0, .nan]"}, "origin must be finite"),
        ({"mode": "raw"}, "mode must be one of trinary, got 'raw'"),
        ({"image": "gone.pgm"}, "image must be a PGM or PNG file .*: .*No such file"),
        ({"image": "map.yaml"}, "image must be a PGM or PNG file .*: cannot identify"),
        ({"image": "3"}, "image must be the name of a file, got 3"),
        ({"free_thresh": "low"}, "free_thresh must be a number, got 'low'"),
        ({"free_thresh": "0.65"}, "free_thresh must be below occupied_thresh, 0.65, got 0.65"),
        ({"occupied_thresh": "65"}, "occupied_thresh must be finite and from 0 to 1, got 65"),
        ({"occupied_threshold": "0.65"}, "field must be one of .*, got 'occupied_threshold'"),
        ({"negate": "2"}, "negate must be 0 or 1, got 2"),
        ({"resolution": "1:30"}, "resolution must be a number, got '1:30'"),
        ({"resolution": "yes"}, "resolution must be a number, got True"),
        ({"image": "[", "origin": ""}, "must be YAML"),
    ],
)
def test_a_bad_file_is_reported_in_one_line_with_file_and_field(tmp_path, fields, message):
    path = write_map(tmp_path)
    write_fields(path, **fields)
    with pytest.raises(MapError, match=f"map.yaml: {message}") as caught:
        pj.intercept.read_map(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"occupied": np.ones(3, bool)}, r"occupied must be a bool array \(H, W\)"),
        ({"occupied": np.ones((2, 2))}, "occupied must be a bool array"),
        ({"resolution": 0.0}, "resolution must be finite and > 0"),
        ({"origin": (0.0, 0.0)}, r"origin must have the shape \(3,\)"),
        ({"coarsen": 0}, "coarsen must be >= 1"),
    ],
)
def test_grids_are_checked(given, message):
    with pytest.raises(ArgumentError, match=message):
        pj.intercept.walls_of_grid(
            **{"occupied": np.ones((2, 2), bool), "resolution": 1.0, **given}
        )


def test_numbers_of_maps_are_decimal(tmp_path):
    assert pj.intercept.read_map(write_map(tmp_path, resolution="010")).resolution == 10.0


@pytest.mark.parametrize("yaw", [0.785398, -2.0])
def test_walls_of_a_turned_map_cover_all_points_outside_of_its_grid(yaw):
    grid = pj.intercept.OccupancyMap(np.zeros((3, 5), bool), 1.0, (2.0, -1.0, yaw))
    x, y = np.meshgrid(*np.linspace(grid.lower, grid.upper, 40).T)
    cos, sin = np.cos(yaw), np.sin(yaw)
    along, across = cos * (x - 2.0) + sin * (y + 1.0), -sin * (x - 2.0) + cos * (y + 1.0)
    is_inside = (along > 0.0) & (along < 5.0) & (across > 0.0) & (across < 3.0)
    is_clear = np.min(np.abs([along, along - 5.0, across, across - 3.0]), axis=0) > 1e-3
    edge = (x > x.min()) & (x < x.max()) & (y > y.min()) & (y < y.max())
    kept = is_clear & edge
    np.testing.assert_array_equal(covered(grid.walls(), x, y)[kept], ~is_inside[kept])
    assert pj.obstacles(grid.walls()).present.sum() == 4
    upright = pj.intercept.OccupancyMap(np.zeros((3, 5), bool), 1.0, (2.0, -1.0, np.pi / 2))
    assert not upright.walls()


def test_grids_of_too_many_rectangles_are_refused():
    board = np.indices((200, 200)).sum(axis=0) % 2 == 0
    with pytest.raises(ArgumentError, match="at most 5,000 rectangles .a greater coarsen"):
        pj.intercept.walls_of_grid(board, 0.1)
    assert len(pj.intercept.walls_of_grid(board, 0.1, coarsen=2)) == 1


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("map.pgm", b"P5\n4097 4096\n255\n", "it has 4097 x 4096 pixels"),
        ("map.pgm", b"P2\n1025 1024\n255\n", "1,048,576 pixels: it has 1025 x 1024 pixels"),
        ("map.pgm", b"P5\n20000 20000\n255\n", "20000|400000000"),
        ("map.pgm", b"P5\n#" + bytes(5000) + b"\n1 1\n255\n\0", "header is incomplete or longer"),
        ("map.pgm", b"P5\n" + b"# " * 2000 + b"1 1\n255\n\0", "header is incomplete or longer"),
    ],
)
def test_large_images_are_refused_before_they_are_decoded(tmp_path, name, content, message):
    path = write_map(tmp_path, name=name)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MapError, match=message):
        pj.intercept.read_map(path)
