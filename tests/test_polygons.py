"""Cutting polygons and geometries into convex parts."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.path import Path

import planner_jax as pj
from planner_jax.core.errors import ArgumentError
from planner_jax.plane.polygons import convex_parts

L_SHAPE = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)
SQUARE = np.array([(0, 0), (3, 0), (3, 3), (0, 3)], float)
STILL = pj.TurningPath(jnp.ones(2), jnp.zeros(2), jnp.zeros(()))
HOLE = [(1.0, 1.0), (2.0, 1.0), (2.0, 2.0), (1.0, 2.0), (1.0, 1.0)]


class Shape:
    """A geometry, such as one of Shapely, that offers its GeoJSON mapping."""

    def __init__(self, kind: str, coordinates: object):
        self.mapping = {"type": kind, "coordinates": coordinates}

    @property
    def __geo_interface__(self) -> Mapping[str, object]:
        """The mapping."""
        return self.mapping


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


def is_convex(part: np.ndarray) -> bool:
    edges = np.roll(part, -1, axis=0) - part
    after = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    return bool((turns >= -1e-7 * np.ptp(part, axis=0).max() ** 2).all())


def cover(parts: list[np.ndarray], points: np.ndarray) -> np.ndarray:
    """Return how many parts contain each of P points (P, 2)."""
    return np.sum([Path(part).contains_points(points) for part in parts], axis=0)


@pytest.mark.parametrize("offset", [0.0, 4.5e6])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2])
def test_an_l_shape_has_two_parts_in_any_unit_place_and_direction(offset, unit, angle):
    corners = offset + unit * turned(L_SHAPE, angle)
    between = 0.5 * (corners + np.roll(corners, -1, axis=0))
    dense = np.stack([corners, between], axis=1).reshape(-1, 2)  # with nearly collinear corners
    for given in (corners, corners[::-1], np.repeat(corners, 2, axis=0), dense):
        parts = convex_parts("walls", given)
        assert [len(part) for part in parts] == [4, 4] and all(map(is_convex, parts))


def test_a_convex_polygon_keeps_its_corners():
    (part,) = convex_parts("walls", SQUARE[::-1])
    np.testing.assert_array_equal(part, SQUARE)
    (closed,) = convex_parts("walls", [*SQUARE, SQUARE[0]])
    np.testing.assert_array_equal(closed, SQUARE)


def test_parts_of_random_stars_cover_each_point_inside_once():
    rng = np.random.default_rng(3)
    for _ in range(20):
        angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, 15))
        star = rng.uniform(0.3, 1.0, (15, 1)) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        parts, points = convex_parts("walls", star), rng.uniform(-1.0, 1.0, (500, 2))
        assert all(map(is_convex, parts)) and len(parts) < len(star)
        np.testing.assert_array_equal(cover(parts, points), Path(star).contains_points(points))


def test_holes_stay_free_and_parts_of_a_multipolygon_are_one_obstacle():
    ring = [SQUARE.tolist(), HOLE]
    parts = convex_parts("walls", Shape("Polygon", ring))
    points = np.random.default_rng(4).uniform(-0.5, 3.5, (500, 2))
    away = np.abs(points - 1.5).max(axis=1)
    np.testing.assert_array_equal(cover(parts, points), (away < 1.5) & (away > 0.5))
    assert len(parts) == 4
    both = Shape("MultiPolygon", [ring, [(L_SHAPE + 5.0).tolist()]])
    movers = pj.obstacles([SQUARE + 20.0, both], [(1.0, 0.0), (0.0, 2.0)])
    assert movers.present.sum() == 7
    np.testing.assert_array_equal(movers.velocity[:7], [[1.0, 0.0]] + 6 * [[0.0, 2.0]])
    assert pj.obstacles(both).present.sum() == 6


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([(0, 0), (1, 1), (1, 0), (0, 1)], r"a crossing near \(0.5, 0.5\) at index 1$"),
        ([(0, 0), (2, 0), (2, 2), (1, 2), (1, -1), (0, -1)], r"a crossing near \(1, 0\)"),
        (SQUARE[[0, 2, 1, 3]], "a crossing near"),
        ([(np.cos(a), np.sin(a)) for a in 0.8 * np.pi * np.arange(5)], "a crossing near"),
        ([(0, 0), (1, 0), (2, 0), (1, 0)], "have an area"),
        (Shape("Polygon", [SQUARE.tolist(), (SQUARE + 5.0).tolist()]), "holes must be inside"),
        (Shape("LineString", SQUARE.tolist()), "a Polygon or a MultiPolygon.*got LineString"),
        (Shape("Polygon", []), "a Polygon or a MultiPolygon with an area"),
    ],
)
def test_polygons_whose_edges_cross_are_rejected_by_argument_and_index(corners, message):
    with pytest.raises(ArgumentError, match=f"^walls must .*{message}") as caught:
        pj.intercept.case(STILL, walls=[SQUARE, corners])
    assert "\n" not in str(caught.value) and str(caught.value).endswith("at index 1")


def test_geometries_of_shapely_are_walls():
    geometry = pytest.importorskip("shapely").box(0.0, 0.0, 3.0, 2.0)
    (part,) = convex_parts("walls", geometry)
    assert len(part) == 4
