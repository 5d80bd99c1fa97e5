"""Scenes and shields of blocks from YAML files and short texts."""

import os

import numpy as np
import pytest
import typecheck

from planner_jax.core.errors import ArgumentError
from planner_jax.referee import solids
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_scene import make_scene
from planner_jax.robot.arm_scene_file import read_scene, read_shield, shield_arm
from planner_jax.robot.capsule_fit import directions, measure_excess

SCENE = """
boxes: [{middle: [0.7, -0.8, 1.0], size: [0.2, 0.1, 0.3]}]
spheres: [{middle: [1, 2, 3], radius: 0.1}]
capsules: [{ends: [[0.8, 0, -0.5], [0.8, 0, 2.5]], radius: 0.05}]
cylinders: [{ends: [[0, 1, 0], [0, 1, 1]], radius: 0.2}]
floor: -0.4
outer: [[-1, -1, 0], [1, 1, 2]]
protected_capsule: {ends: [[0, 0, 1.2], [0, 0, 0.3]], radius: 0.3}
"""


SQUARE = "v 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 {}\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"


def test_a_mesh_of_a_scene_file_is_its_hull_and_inside_the_planners_solids(tmp_path):
    path = tmp_path / "scene.yaml"
    (tmp_path / "part.obj").write_text(SQUARE.format(1))
    path.write_text("meshes: [{file: part.obj, scale: 0.5, position: [0, 0, 3]}]")
    meshes = read_scene(path).meshes
    expected = np.array([(0, 0, 3), (0, 0.5, 3.5), (1, 0, 3), (1, 0.5, 3)])
    hull = np.array(sorted(map(tuple, meshes.corners[0])))
    np.testing.assert_allclose(hull, expected, atol=1e-6)
    corners = directions(100) * [1.0, 0.3, 0.2]
    turn = np.array([0.2, 0.4, -0.1, 0.9])
    scene = make_scene(meshes=[(corners, 1.0, (0.5, 0.0, 1.0), turn)])
    points, ends = scene.meshes.corners[0].T, scene.meshes.solids["capsule_ends"]
    inside = np.zeros(points.shape[1], bool)
    for (first, second), radius in zip(ends, scene.meshes.solids["capsule_radius"], strict=True):
        inside |= solids.from_segment(points, first[:, None], second[:, None]) < radius + 1e-6
    assert inside.all() and len(ends) > 0
    most, mean = measure_excess(ends, scene.meshes.solids["capsule_radius"], points.T)
    np.testing.assert_allclose(scene.meshes.excess, [[most, mean]], atol=2e-3)


def test_a_scene_file_lists_obstacles_and_the_protected_body(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    scene = read_scene(path)
    np.testing.assert_allclose(scene.box_half, [[0.1, 0.05, 0.15]])
    np.testing.assert_allclose(scene.box_turn, [[1.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(scene.capsule_radius, np.float32([0.1, 0.05]))
    np.testing.assert_allclose(scene.cylinder_ends[0, 1], [0.0, 1.0, 1.0])
    np.testing.assert_allclose([scene.inner.lower[2], scene.inner.upper[2]], np.float32([0.3, 1.2]))
    assert scene.floor == np.float32(-0.4) and scene.inner_radius == np.float32(0.3)
    assert scene.outer.upper[2] == 2.0 and scene.beam_radius.shape == (0,)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("poles: []", r"a.yaml must have fields of boxes, .*, got 'poles'"),
        ("boxes: 3", r"a.yaml: boxes must be a list of obstacles, got 3"),
        ("spheres: [{middle: [0, 0, 0]}]", r"a.yaml: spheres\[0\].radius must be a finite number"),
        ("spheres: [{radius: 1, size: 2}]", r"a.yaml: spheres\[0\] must have the fields middle, r"),
        ("boxes: [{middle: [0, 0], size: 1}]", r"a.yaml: boxes\[0\].middle must be 3 finite num"),
        (
            "capsules: [{ends: [[0, 0, 0], [0, 0, 1]], radius: 0}]",
            r".*capsules\[0\].radius must",
        ),
        ("cylinders: [{ends: [[0, 0, 1], [0, 0, 1]], radius: 1}]", r".*ends must be two different"),
        (
            "protected_capsule: {ends: [[0, 0, 0], [1, 0, 1]], radius: 0}",
            r"a.yaml: protected_capsule.radius must be > 0, got 0",
        ),
        ("[1]", "a.yaml must be fields with values"),
        ("meshes: [{scale: 2}]", r"a.yaml: meshes\[0\] must have the fields file, scale, pos"),
        ("meshes: [{file: a.stl, scale: 0}]", r"a.yaml: meshes\[0\].scale must be > 0, got 0"),
        (
            "meshes: [{file: b.stl}]",
            r"a.yaml: meshes\[0\] must be a binary STL, .* got b.stl: No such file",
        ),
        ("meshes: [{file: a.yaml}]", r"a.yaml: meshes\[0\] must be .*, got a.yaml: no decoder"),
        ("meshes: [{file: flat.obj}]", r".*\[0\] must be .* with a volume; .*obj: .*coplanar"),
        (
            "meshes: [{file: text.stl}]",
            r"a.yaml: meshes\[0\] must be .*; an STL file of text is not",
        ),
        (
            "meshes: [{file: pipe}]",
            r"a.yaml: meshes\[0\] must be .*, got pipe: it is no plain file",
        ),
        (
            "meshes: [{file: huge.obj}]",
            r"a.yaml: meshes\[0\] must be .*huge.obj: it is larger than",
        ),
        (
            "spheres: [{middle: [0, 0, 0], radius: yes}]",
            r".*spheres\[0\].radius must be a finite num",
        ),
        ("boxes: [{middle: [0, no, 0], size: [1, 1, 1]}]", r".*boxes\[0\].middle must be 3 finite"),
        ("meshes: [{file: flat.obj, turn: [0, 0, 0, 0]}]", r"a.yaml: meshes\[0\].turn must"),
    ],
)
def test_a_wrong_element_of_a_scene_file_is_named(tmp_path, monkeypatch, text, message):
    monkeypatch.setattr(typecheck, "is_on", False)  # for the library's own checks
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.yaml").write_text(text)
    (tmp_path / "flat.obj").write_text(SQUARE.format(0))
    (tmp_path / "text.stl").write_text("solid part\nfacet normal 0 0 1\nendsolid part\n" * 9)
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "huge.obj").open("wb") as file:
        file.truncate(3 << 30)  # sparse
    with pytest.raises(ArgumentError, match=f"^{message}"):
        read_scene("a.yaml")


ZERO, UNIT, TURN = (0, 0, 0), (1, 1, 1), (1, 0, 0, 0)


@pytest.mark.parametrize(
    ("solids", "message"),
    [
        ({"boxes": [(ZERO, UNIT)]}, r"boxes\[0\] must be a tuple of middle, size, turn, got"),
        ({"boxes": (ZERO, UNIT, TURN)}, r"boxes\[0\].middle must be 3 finite numbers, got 0"),
        ({"boxes": [(ZERO, UNIT, (0, 0, 0, 0))]}, r"boxes\[0\].turn must be a quaternion other"),
        ({"boxes": [(ZERO, UNIT, (1e-200, 0, 0, 0))]}, r"boxes\[0\].turn must be a quaternion oth"),
        ({"boxes": [(ZERO, (1, -1, 1), TURN)]}, r"boxes\[0\].size must be > 0, got \[1.0, -1.0"),
        ({"boxes": [(ZERO, (1, np.nan, 1), TURN)]}, r"boxes\[0\].size must be 3 finite numbers"),
        ({"boxes": 3}, "boxes must be a list of obstacles, got 3"),
        ({"spheres": [(0, 0, 0, 0.1)]}, r"spheres\[0\] must be a tuple of middle, radius, got"),
        ({"spheres": [(ZERO, True)]}, r"spheres\[0\].radius must be a finite number, got True"),
        ({"cylinders": [([ZERO, ZERO], 1)]}, r"cylinders\[0\].ends must be two different points"),
        ({"protected_capsule": {}}, "protected_capsule must be a tuple of ends, radius, got {}"),
        ({"protected_capsule": ([ZERO, UNIT], 0)}, "protected_capsule.radius must be > 0, got 0"),
        ({"protected_box": [ZERO]}, "protected_box must be 2 lists of 3 finite numbers"),
        ({"floor": "low"}, "floor must be a finite number, got 'low'"),
        ({"meshes": [(b"x", 1, ZERO, TURN)]}, r"meshes\[0\] must be a binary STL, OBJ or MSH file"),
        ({"meshes": [(np.eye(4, 3), 0, ZERO, TURN)]}, r"meshes\[0\].scale must be > 0, got 0"),
    ],
)
def test_a_wrong_entry_of_a_scene_is_named(monkeypatch, solids, message):
    monkeypatch.setattr(typecheck, "is_on", False)  # for the library's own checks
    with pytest.raises(ArgumentError, match=f"^{message}") as error:
        make_scene(**solids)
    assert "\n" not in str(error.value)


def test_a_shield_is_described_by_its_size_or_by_a_file(tmp_path):
    np.testing.assert_allclose(np.max(read_shield("0.2x0.4").outline, axis=0), [0.1, 0.2])
    assert read_shield("disc:0.18").radius == 0.18
    path = tmp_path / "shield.yaml"
    path.write_text("corners: [[0.2, 0], [-0.1, 0.1], [-0.1, -0.1]]\nmass: 1.5")
    shield = read_shield(str(path))
    assert shield.mass == 1.5 and shield.outline.shape == (3, 2)
    arm = shield_arm(None, None, str(path))
    np.testing.assert_allclose(arm.shield_half, np.float32([0.2, 0.1]))
    np.testing.assert_array_equal(arm.shield_centre, irb1600().shield_centre)
    assert shield_arm(None, None, None) is irb1600()
    path.write_text("corners: [[0.2, 0], [0.1, 0]]")
    with pytest.raises(ArgumentError, match="shield.yaml: shield.corners must be at least three"):
        read_shield(str(path))
    path.write_text("width: 1")
    with pytest.raises(ArgumentError, match="shield.yaml must have fields of corners, .*'width'"):
        read_shield(str(path))
    with pytest.raises(ArgumentError, match="shield must be WIDTHxHEIGHT, disc:RADIUS or a YAML"):
        read_shield("round")
