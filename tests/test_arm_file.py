"""Arms from MJCF and URDF files, compared with MuJoCo's own kinematics of the same files."""

import dataclasses
import functools
import itertools
import os
import re
import warnings

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from planner_jax.core.errors import ArgumentError
from planner_jax.referee.arm_torque import Dynamics
from planner_jax.robot.arm_file import describe_arm, irb1600, read_arm
from planner_jax.robot.arm_shield import Shield
from planner_jax.robot.capsule_fit import cover, measure_excess

mujoco = pytest.importorskip("mujoco")
# Links of `MJCF` have the masses that MuJoCo computes by its own density.
pytestmark = pytest.mark.filterwarnings("ignore:.*no mass is stated")
RATES = {"velocity": 2.0, "acceleration": 9.0}

# Defaults, an include, a mesh, links of several bodies, joints beside the origins of their bodies,
# a joint whose reference is not 0, a wrist whose axes do not meet, and a gripper of two slides.
MJCF = """
<mujoco>
  <compiler angle="degree" meshdir="shapes"/>
  <default>
    <joint axis="0 0 1" range="-170 170"/>
    <geom group="3"/>
    <default class="picture"><geom contype="0" conaffinity="0" group="2" mass="0"/></default>
  </default>
  <asset><mesh name="rock" file="rock.obj"/></asset>
  <worldbody>
    <geom type="plane" size="3 3 1"/>
    <body name="ball" pos="4 0 1"><freejoint/><geom size=".1"/></body>
    <body name="table" pos="1 2 3" euler="0 0 30">
      <geom name="top" type="box" size=".3 .2 .05" pos="0 0 -.05"/>
      <body name="socket" pos="0 0 .1" euler="10 0 0">
        <geom type="cylinder" size=".08 .05"/>
        <body name="one" pos="0 0 .1">
          <joint name="a"/>
          <geom type="capsule" size=".05" fromto="0 0 .05 0 0 .25"/>
          <geom class="picture" type="box" size="1 1 1"/>
          <body name="two" pos="0 .02 .3" euler="90 0 5">
            <joint name="b" ref="20" range="-100 100" actuatorfrcrange="-80 70"/>
            <geom type="mesh" mesh="rock"/>
            <body name="three" pos=".3 0 .01">
              <joint name="c" pos="0 .05 0" axis="0 1 1"/>
              <geom type="box" size=".04 .03 .1" pos="0 0 .1"/>
              <body name="cover" pos="0 .1 0" euler="0 40 0"><geom size=".03"/></body>
              <include file="wrist.xml"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="d" gear="5" forcelimited="true" forcerange="-3 3"/></actuator>
  <keyframe>
    <key name="home" qpos="4 0 1 1 0 0 0 .1 .2 .3 .4 .5 .6 .7 .01 .02"/>
  </keyframe>
</mujoco>
"""
WRIST = """
<mujoco>
  <body name="four" pos="0 0 .3" euler="0 90 0">
    <joint name="d"/><geom type="ellipsoid" size=".05 .04 .08"/>
    <body name="five" pos="0 .05 .1" euler="-90 0 0">
      <joint name="e" armature=".2"/><geom type="cylinder" size=".03 .05"/>
      <body name="six" pos=".02 0 .1" euler="90 10 0">
        <joint name="f"/><geom size=".15"/>
        <body name="seven" pos="0 .04 .1">
          <joint name="g"/><geom size=".02"/>
          <body name="hand" pos="0 0 .1" euler="0 0 45">
            <geom type="box" size=".02 .05 .02"/>
            <site name="tool" pos="0 0 .05" euler="0 20 0"/>
            <body name="left" pos="0 .04 .04">
              <joint name="l" type="slide" range="0 .04"/><geom type="box" size=".005 .005 .02"/>
            </body>
            <body name="right" pos="0 -.04 .04">
              <joint name="r" type="slide" range="0 .04"/><geom type="box" size=".005 .005 .02"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </body>
</mujoco>
"""
LINK = """<link name="{name}">
  <inertial><origin xyz=".01 .02 .05" rpy=".1 0 .2"/><mass value="{mass}"/>
    <inertia ixx=".01" ixy=".001" ixz="0" iyy=".02" iyz="0" izz=".015"/></inertial>
  <collision><origin xyz="0 0 .1"/><geometry>{shape}</geometry></collision></link>"""
JOINT = """<joint name="{name}" type="{kind}"><origin xyz=".02 .01 .2" rpy="{rpy}"/>
  <parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/>
  <limit lower="-2" upper="1.5" velocity="{speed}" effort="{effort}"/></joint>"""


def urdf():
    """Return an arm of six hinges on a fixed base, with a fixed tool flange."""
    shapes = ['<mesh filename="package://maker/meshes/rock.obj"/>', '<box size=".1 .1 .2"/>']
    links = ["base", *(f"l{k}" for k in range(6)), "tool0"]
    parts = [
        LINK.format(name=name, mass=k + 1, shape=shapes[k % 2]) for k, name in enumerate(links[:-1])
    ]
    for k, (parent, child) in enumerate(itertools.pairwise(links)):
        kind, rpy = "fixed" if child == "tool0" else "revolute", f"{1.57 * (k % 3)} .3 {0.1 * k}"
        parts.append(
            JOINT.format(
                name=f"q{k}", kind=kind, rpy=rpy, parent=parent, child=child, speed=k + 1, effort=10
            )
        )
    return f'<robot name="mine">{"".join(parts)}<link name="tool0"/></robot>'


def rock():
    """Return the corners (40, 3) [m] of a convex body."""
    corners = np.random.default_rng(0).normal(size=(40, 3))
    corners /= np.linalg.norm(corners, axis=1)[:, None]
    return corners * [0.2, 0.06, 0.05] + [0.12, 0.01, 0.0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("arms")
    faces = ConvexHull(rock()).simplices + 1
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in rock())
    text += "".join(f"f {a} {b} {c}\n" for a, b, c in faces)
    for name in ("shapes", "maker/meshes", "maker/urdf"):
        (place / name).mkdir(parents=True)
    for name in ("shapes/rock.obj", "maker/meshes/rock.obj"):
        (place / name).write_text(text)
    (place / "seven.xml").write_text(MJCF)
    (place / "wrist.xml").write_text(WRIST)
    (place / "loop.xml").write_text('<mujoco><include file="back.xml"/></mujoco>')
    (place / "back.xml").write_text('<mujoco><include file="loop.xml"/></mujoco>')
    (place / "maker/urdf/six.urdf").write_text(urdf())
    return place


@pytest.fixture(scope="module")
def seven(folder):
    return read_arm(folder / "seven.xml", limits=RATES, dtype=np.float64)


@pytest.fixture(scope="module")
def six(folder):
    limits = {"acceleration": 5}
    return read_arm(folder / "maker/urdf/six.urdf", limits=limits, dtype=np.float64)


def frames(arm, angles):
    """Return the positions and rotations of the links at joint angles (n,) [rad]."""
    place, turn, found = np.zeros(3), np.eye(3), []
    for k in range(arm.num):
        place = place + turn @ arm.origin[k]
        turn = turn @ Rotation.from_quat(arm.turn[k], scalar_first=True).as_matrix()
        turn = turn @ Rotation.from_rotvec(angles[k] * arm.axis[k]).as_matrix()
        found.append((place, turn))
    return found


def mass_matrix(arm, angles):
    """Return the mass matrix (n, n) [kg m^2] from the links' masses and inertias."""
    total, links = np.zeros((arm.num, arm.num)), frames(arm, angles)
    axes = np.array([turn @ axis for (_, turn), axis in zip(links, arm.axis, strict=True)])
    for k, (place, turn) in enumerate(links):
        centre = place + turn @ arm.centre[k]
        off = centre - np.array([each for each, _ in links])
        moves = np.arange(arm.num) <= k
        speed, spin = np.cross(axes, off) * moves[:, None], axes * moves[:, None]
        total += arm.mass[k] * speed @ speed.T
        total += spin @ turn @ arm.inertia[k] @ turn.T @ spin.T
    return total + np.diag(np.zeros(arm.num) if arm.armature is None else arm.armature)


def at_poses(path, arm, root, num):
    """Yield poses of MuJoCo's model of a file: angles, data, joints, and the base frame."""
    model = mujoco.MjModel.from_xml_path(str(path)) if path.suffix == ".xml" else None
    if model is None:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = False
        for mesh in spec.meshes:
            mesh.file = str(path.parents[1] / "meshes/rock.obj")
        model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    joints = [model.joint(name).id for name in arm.joint_names]
    body = model.body(root).id
    for _ in range(num):
        angles = rng.uniform(arm.lower, arm.upper)
        if model.nkey:
            data.qpos[:] = model.key("home").qpos
        data.qpos[model.jnt_qposadr[joints]] = angles
        mujoco.mj_forward(model, data)
        yield angles, model, data, joints, (data.xpos[body], data.xmat[body].reshape(3, 3))


def compare_with_mujoco(path, arm, root):
    rng, torques = np.random.default_rng(2), Dynamics(functools.partial(getattr, arm), 9.81).torques
    for angles, model, data, joints, (origin, base) in at_poses(path, arm, root, 200):
        for (place, turn), joint in zip(frames(arm, angles), joints, strict=True):
            body = model.jnt_bodyid[joint]
            np.testing.assert_allclose(place, base.T @ (data.xanchor[joint] - origin), atol=1e-12)
            if joint + 1 not in joints or model.jnt_bodyid[joint + 1] != body:  # the body's last
                own = base.T @ data.xmat[body].reshape(3, 3)
                np.testing.assert_allclose(turn, own, atol=1e-12)
    whole, rows = np.zeros((model.nv, model.nv)), model.jnt_dofadr[joints]
    mujoco.mj_fullM(model, data, whole)
    np.testing.assert_allclose(mass_matrix(arm, angles), whole[np.ix_(rows, rows)], atol=1e-9)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    rates, rises = rng.normal(scale=(3.0, 20.0), size=(arm.num, 2)).T
    data.qvel[rows], data.qacc[:], data.qacc[rows] = rates, 0.0, rises
    mujoco.mj_inverse(model, data)
    expected = data.qfrc_inverse[rows]
    np.testing.assert_allclose(torques(np.stack([[angles, rates, rises]]))[0], expected, rtol=1e-9)
    return model


def test_links_and_masses_of_an_mjcf_file_are_where_mujoco_has_them(folder, seven):
    model = compare_with_mujoco(folder / "seven.xml", seven, "table")
    assert seven.joint_names == tuple("abcdefg")
    np.testing.assert_allclose(seven.lower[:2], np.deg2rad([-170, -100]))
    np.testing.assert_allclose(seven.home, np.arange(1, 8) / 10)
    moving = [model.body(name).id for name in ("one", "two", "three", "cover", "four", "five")]
    moving += [model.body(name).id for name in ("six", "seven", "hand", "left", "right")]
    assert np.sum(seven.mass) == pytest.approx(np.sum(model.body_mass[moving]))


def test_links_and_masses_of_a_urdf_are_where_mujoco_has_them(folder, six):
    compare_with_mujoco(folder / "maker/urdf/six.urdf", six, "base")
    np.testing.assert_array_equal(six.mass, np.arange(2.0, 8.0))
    np.testing.assert_array_equal(six.limits.velocity, np.arange(1.0, 7.0))
    np.testing.assert_array_equal(six.limits.acceleration, np.full(6, 5.0))
    np.testing.assert_allclose([six.lower, six.upper], [[-2.0] * 6, [1.5] * 6])


def test_attributes_that_mujoco_has_dropped_do_not_matter(folder, seven):
    old = '<option collision="dynamic" timestep="0.1"/><size njmax="500"/><compiler'
    (folder / "old.xml").write_text(MJCF.replace("<compiler", old, 1))
    arm = read_arm(folder / "old.xml", limits=RATES, dtype=np.float64)
    np.testing.assert_array_equal(arm.origin, seven.origin)
    np.testing.assert_array_equal(arm.capsule_ends, seven.capsule_ends)


def test_a_body_with_two_hinges_is_two_links(folder):
    text = MJCF.replace('<joint name="a"/>', '<joint name="a"/><joint name="z" axis="1 0 0"/>')
    text = text.replace(".1 .2 .3", ".1 0 .2 .3")
    (folder / "eight.xml").write_text(text)
    arm = read_arm(folder / "eight.xml", limits=RATES, tip="six", dtype=np.float64)
    assert arm.joint_names == tuple("azbcdef")
    compare_with_mujoco(folder / "eight.xml", arm, "table")
    with pytest.raises(ArgumentError, match="eight.xml: the arm must have 6 or 7 .*got 8: a, z"):
        read_arm(folder / "eight.xml", limits=RATES)


def surface(kind, size, num=4000):
    """Return points on the surface of a geom of MuJoCo, in the frame of the geom."""
    u = np.random.default_rng(2).normal(size=(num, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    if kind == "box":
        return size * u / np.max(np.abs(u), axis=1)[:, None]
    if kind == "cylinder":
        flat = np.hypot(u[:, 0], u[:, 1])[:, None]
        return u / np.maximum(flat / size[0], np.abs(u[:, 2:]) / size[1])
    return u * size if kind == "ellipsoid" else rock()


def nearest(arm, link, points):
    """Return how far points (P, 3) [m] of a link are outside of the nearest of its capsules."""
    gaps = []
    for k in np.flatnonzero(np.equal(arm.capsule_link, link)):
        first, second = arm.capsule_ends[k]
        span = second - first
        share = np.clip((points - first) @ span / max(span @ span, 1e-12), 0.0, 1.0)
        off = points - first - share[:, None] * span
        gaps.append(np.linalg.norm(off, axis=1) - arm.capsule_radius[k])
    return np.min(gaps, axis=0)


def test_capsules_enclose_every_collision_geom_and_no_picture(folder, seven):
    (angles, model, data, joints, _) = next(at_poses(folder / "seven.xml", seven, "table", 1))
    names = {v: k[7:].lower() for k, v in vars(mujoco.mjtGeom).items() if k.startswith("mjGEOM_")}
    links = {"one": 0, "two": 1, "three": 2, "cover": 2, "four": 3, "five": 4, "hand": 6, "left": 6}
    for body, link in links.items():
        for geom in np.flatnonzero(model.geom_bodyid == model.body(body).id):
            kind = names[mujoco.mjtGeom(model.geom_type[geom])]
            if kind in ("sphere", "capsule") or model.geom_group[geom] == 2:
                continue
            points = surface(kind, model.geom_size[geom])
            if kind == "mesh":
                start, num = model.mesh_vertadr[0], model.mesh_vertnum[0]
                points = model.mesh_vert[start : start + num].astype(float)
            inside = data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T
            turn = data.xmat[model.jnt_bodyid[joints[link]]].reshape(3, 3)
            own = (inside - data.xanchor[joints[link]]) @ turn
            assert np.max(nearest(seven, link, own)) < 1e-9, (body, kind)
    assert np.max(seven.capsule_radius) < 0.3  # the picture of link 1 is a box of 2 m
    np.testing.assert_allclose(seven.base_box, [[-0.3, -0.2, -0.1], [0.3, 0.2, 0.0]], atol=1e-12)
    one = seven.capsule_ends[seven.capsule_link.index(0)]
    np.testing.assert_allclose(one[np.argsort(one[:, 2])], [[0, 0, 0.05], [0, 0, 0.25]], atol=1e-12)


def test_the_excess_of_capsules_is_the_closed_form():
    cube = np.array([*itertools.product((-0.1, 0.1), repeat=3)])
    radius = np.array([0.1 * 3**0.5])
    greatest, mean = measure_excess(np.zeros((1, 2, 3)), radius, cube)
    assert greatest == pytest.approx(radius[0] - 0.1, rel=1e-2)
    assert mean == pytest.approx(radius[0] - 0.15, rel=1e-2)  # the cube's mean width is 1.5 edges
    rod = cover(cube * [3.0, 0.2, 0.2])
    assert rod.greatest < 0.025 and rod.mean < 0.006
    plate = cover(cube * [1.0, 1.0, 0.1])
    assert len(plate.radius) == 3 and plate.greatest < 0.04


def test_a_shield_adds_its_mass_and_inertia_to_the_last_link(folder, six):
    shield = Shield(half=(0.2, 0.1), position=(0.0, 0.0, 0.05), mass=1.5)
    path = folder / "maker/urdf/six.urdf"
    settings = {"limits": {"acceleration": 5}, "tip": "tool0", "dtype": np.float64}
    arm = read_arm(path, shield=shield, **settings)
    place, turn = np.array([0.02, 0.01, 0.2]), Rotation.from_euler("xyz", [0.0, 0.3, 0.6])
    np.testing.assert_allclose(arm.shield_centre, place + turn.apply([0.0, 0.0, 0.05]), atol=1e-9)
    columns = Rotation.from_quat(arm.shield_turn, scalar_first=True).as_matrix().T
    np.testing.assert_allclose(columns[0], turn.apply([0.0, 0.0, 1.0]), atol=1e-9)
    np.testing.assert_array_equal(arm.shield_half, [0.2, 0.1])
    centre = arm.shield_centre - 0.005 * columns[0]
    assert arm.mass[5] == pytest.approx(six.mass[5] + 1.5)
    joint = (six.mass[5] * six.centre[5] + 1.5 * centre) / arm.mass[5]
    np.testing.assert_allclose(arm.centre[5], joint)
    own = 1.5 / 12.0 * np.array([0.4**2 + 0.2**2, 0.2**2 + 0.01**2, 0.4**2 + 0.01**2])
    inertia = six.inertia[5] + columns.T @ np.diag(own) @ columns
    for mass, at in ((six.mass[5], six.centre[5]), (1.5, centre)):
        off = at - joint
        inertia = inertia + mass * (off @ off * np.eye(3) - np.outer(off, off))
    np.testing.assert_allclose(arm.inertia[5], inertia)
    assert set(arm.shield_pairs) <= {k for k, link in enumerate(arm.capsule_link) if link < 4}
    assert np.all(six.shield_half == 0.0) and six.shield_pairs == ()


def test_the_tip_may_be_a_site(folder):
    shield = Shield(turn=(1.0, 0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0))
    arm = read_arm(folder / "seven.xml", limits=RATES, tip="tool", shield=shield, dtype=float)
    for angles, _, data, _, (origin, base) in at_poses(folder / "seven.xml", arm, "table", 3):
        place, turn = frames(arm, angles)[-1]
        middle = base.T @ (data.site("tool").xpos - origin)
        np.testing.assert_allclose(place + turn @ arm.shield_centre, middle, atol=1e-12)
        own = turn @ Rotation.from_quat(arm.shield_turn, scalar_first=True).as_matrix()
        site = base.T @ data.site("tool").xmat.reshape(3, 3)
        np.testing.assert_allclose(own, site, atol=1e-12)


def test_bodies_that_touch_at_rest_are_left_out_and_named(folder, seven):
    links = np.array(seven.capsule_link)
    apart = [links[k] - links[j] for k, j in seven.pairs if links[j] >= 0]
    assert min(apart) == 2
    report = describe_arm(folder / "seven.xml", limits=RATES)
    assert "bodies touch at home or at angles 0: " in report and "six and four" in report
    assert not any({links[k], links[j]} == {5, 3} for k, j in seven.pairs)
    assert "Joints that stay there: l, r." in report
    assert "Greatest torques [N m]: inf, 70, inf, 15, inf, inf, inf." in report
    np.testing.assert_array_equal(seven.limits.torque[:4], [np.inf, 70.0, np.inf, 15.0])
    np.testing.assert_array_equal(seven.armature, np.where(np.arange(7) == 4, 0.2, 0.0))
    free = read_arm(folder / "seven.xml", limits=RATES | {"torque": np.inf})
    assert free.limits.torque is None and irb1600().limits.torque is None
    rows = {row.split()[0]: row.split()[1:] for row in report.splitlines()}
    assert rows["one"] == ["1", "0.0", "0.0"] and float(rows["two"][1]) > 1.0


def test_limits_are_read_beside_the_file_and_from_moveit(folder):
    path = folder / "maker/urdf/six.urdf"
    beside = path.with_name("six.limits.yaml")
    beside.write_text("acceleration: {q0: 1, q1: 2, q2: 3, q3: 4, q4: 5, q5: 6}\nvelocity: 7\n")
    arm = read_arm(path)
    np.testing.assert_array_equal(arm.limits.acceleration, np.arange(1, 7))
    np.testing.assert_array_equal(arm.limits.velocity, np.full(6, 7))
    beside.unlink()
    entry = "  q{}: {{has_velocity_limits: {}, max_velocity: 9, max_acceleration: 4, {}}}\n"
    rows = [
        entry.format(k, str(k > 0).lower(), "min_position: -1, max_position: 1") for k in range(6)
    ]
    (folder / "joint_limits.yaml").write_text("joint_limits:\n" + "".join(rows))
    arm = read_arm(path, limits=folder / "joint_limits.yaml")
    np.testing.assert_array_equal(arm.limits.velocity, [1, 9, 9, 9, 9, 9])
    np.testing.assert_array_equal(arm.limits.acceleration, np.full(6, 4))
    np.testing.assert_array_equal([arm.lower, arm.upper], [[-1] * 6, [1] * 6])


def test_the_shipped_arm_is_its_file():
    arm, models = irb1600(np.float64), "planner_jax/robot/models/irb1600.xml"
    whole = read_arm(models, dtype=np.float64)
    names = [field.name for field in dataclasses.fields(arm)]
    for name in set(names) - {"pairs", "shield_pairs", "shield_gap_radius", "limits"}:
        np.testing.assert_array_equal(getattr(arm, name), getattr(whole, name))
    assert set(arm.pairs) < set(whole.pairs)


BAD = [
    ("rock.obj", "gone.obj", 'mesh "rock" must have the file gone.obj; put it at .*gone.obj'),
    ("wrist.xml", "gone.xml", 'include "gone.xml" must have the file .*; put it there'),
    ('name="a"', 'name="a" limited="false"', "joints a must have limits of position; state"),
    ('name="c"', 'type="slide" name="c"', 'joint "c" must be a hinge; weld it, .*got slide'),
    (
        '<body name="cover"',
        '<body name="x"><joint/><geom size=".1"/></body><body name="cover"',
        "body three must carry one chain of hinges; name the end of the arm by tip=, got x, four",
    ),
    ("<geom", "<gem", "the model must be accepted by MuJoCo: .*gem"),
    ('size=".04 .03 .1"', 'size="-1 .03 .1"', "the model must be accepted by MuJoCo: "),
    (".1 .2 .3 .4", "9 .2 .3 .4", "home must have 7 angles within the limits; correct them"),
    (
        '"-3 3"',
        '"0 50"',
        'joint "d" must have a range of forces on both sides of 0; state a torque',
    ),
    (
        '<include file="wrist',
        '<include file="bad',
        "accepted by MuJoCo: .*bad.xml' already included",
    ),
    ('<include file="wrist', '<include file="loop', "accepted by MuJoCo: .* already included"),
    ("<mujoco>", '<!DOCTYPE a [<!ENTITY b "c">]><mujoco>', "must have no <!DOCTYPE>; remove it"),
    ("<mujoco>", "<!-- " * 20_000 + "<mujoco>", "the model must be accepted by MuJoCo: no XML"),
    ("<asset>", "<include " * 10_000 + "<asset>", "the model must be accepted by MuJoCo: no XML"),
    ("<asset>", "<a " + " ".join(f'a{k}="1"' for k in range(300)) + "/><asset>", "200 attributes"),
    (
        "<mujoco>",
        '<?xml version="1.0" encoding="odd"?><mujoco>',
        "encoding must be known, got 'odd",
    ),
]
# Elements that make MuJoCo wait for a pipe's writer, or fill the memory.
HOSTILE = [
    ('<asset><hfield name="h" file="{pipe}" size="1 1 1 1"/>', 'hfield "h" must have a plain file'),
    ('<asset><texture name="t" type="2d" file="{pipe}"/>', 'texture "t" must have a plain file'),
    ('<asset><texture name="t" type="cube" fileup="{pipe}"/>', 'texture "t" must have a plain'),
    ('<asset><mesh name="m" file="../{pipe}"/>', 'mesh "m" must have a plain file'),
    ('<asset><model name="m" file="{pipe}"/>', 'include "pipe" must have the file .*no plain'),
    (
        '<asset><mesh name="m" file="huge.stl"/>',
        'mesh "m" must have a plain file of at most 32 MiB',
    ),
    (
        '<asset><texture name="t" file="huge.png"/>',
        "pixels at .*huge.png, got 30000 x 30000 pixels",
    ),
    ('<asset><hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/>', "element hfield must"),
    ('<custom><numeric name="n" size="2000000000"/></custom><asset>', "element numeric must have"),
    ('<size nkey="2000000000"/><asset>', "element size must have at most .*nkey"),
    (
        '<worldbody><replicate count="2000"><replicate count="2000"><geom size="1"/></replicate>'
        "</replicate></worldbody><asset>",
        "at most 20000 elements, with all copies",
    ),
]


@pytest.mark.parametrize(("element", "message"), HOSTILE)
def test_a_pipe_or_a_huge_element_of_a_file_is_refused(folder, element, message):
    pipe, path = folder / "pipe", folder / "hostile.xml"
    if not pipe.exists():
        os.mkfifo(pipe)
        with (folder / "shapes/huge.stl").open("wb") as file:
            file.truncate(1 << 31)  # sparse
        size = (30_000).to_bytes(4)
        (folder / "huge.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + size + size)
    path.write_text(MJCF.replace("<asset>", element.replace("{pipe}", "pipe"), 1))
    with pytest.raises(ArgumentError, match=message) as error:
        read_arm(path, limits=RATES)
    assert "\n" not in str(error.value) and "hostile.xml" in str(error.value)


def test_a_sparse_arm_file_of_gigabytes_is_refused(tmp_path):
    with (path := tmp_path / "huge.xml").open("wb") as file:
        file.truncate(3 << 30)
    with pytest.raises(ArgumentError, match="arm must be an MJCF or URDF file, .* larger than"):
        read_arm(path)


def boxes_urdf():
    """Return the arm of `urdf` with boxes instead of meshes."""
    return urdf().replace(
        '<mesh filename="package://maker/meshes/rock.obj"/>', '<box size=".1 .1 .2"/>'
    )


@pytest.mark.parametrize("speed", ["3,14", "", "${v}", "inf", "-1", "nan"])
def test_a_speed_of_a_urdf_that_is_no_finite_number_is_named(tmp_path, speed):
    path = tmp_path / "a.urdf"
    path.write_text(boxes_urdf().replace('velocity="3"', f'velocity="{speed}"'))
    with pytest.raises(ArgumentError, match="a.urdf: velocity of q2 must be a finite number > 0"):
        read_arm(path, limits={"acceleration": 5})
    stated = read_arm(path, limits={"acceleration": 5, "velocity": {"q2": 3}})
    np.testing.assert_array_equal(stated.limits.velocity, np.arange(1.0, 7.0))


def test_the_text_of_a_file_has_the_encoding_that_it_declares(tmp_path):
    text = '<?xml version="1.0" encoding="ISO-8859-1"?>' + boxes_urdf()
    text = text.replace('name="q1"', 'name="Gelänk"').replace("<link", "<!-- ä -- -->\n<link", 1)
    (tmp_path / "a.urdf").write_bytes(text.encode("latin-1"))
    assert read_arm(tmp_path / "a.urdf", limits={"acceleration": 5}).joint_names[1] == "Gelänk"
    (tmp_path / "a.urdf").write_bytes(text.replace("ISO-8859-1", "utf-8").encode("latin-1"))
    with pytest.raises(ArgumentError, match="a.urdf: the text must be in the encoding that"):
        read_arm(tmp_path / "a.urdf", limits={"acceleration": 5})


def test_limits_are_numbers_and_arrays_of_numpy_too():
    given = {
        "acceleration": np.full(6, 10.0),
        "velocity": np.float32(2.0),
        "torque": (1, np.int64(2), 3.0, 4, 5, np.inf),
        "position": np.tile([-1.0, 1.0], (6, 1)),
    }
    arm = read_arm(boxes_urdf(), limits=given)
    np.testing.assert_array_equal(arm.limits.acceleration, np.full(6, 10.0))
    np.testing.assert_array_equal(arm.limits.velocity, np.full(6, 2.0))
    np.testing.assert_array_equal(arm.limits.torque, [1, 2, 3, 4, 5, np.inf])
    np.testing.assert_array_equal([arm.lower, arm.upper], [[-1.0] * 6, [1.0] * 6])


MOVEIT = {f"q{k}": {"max_velocity": 1.5, "max_acceleration": 4.0} for k in range(6)}


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (
            MOVEIT | {"J2": {"max_velocity": 0.5}},
            "limits: joint_limits must be of the joints q0, .*J2",
        ),
        ([1], r"limits: joint_limits must be fields with the names of joints, got \[1\]"),
        ({"q1": 3}, "limits: joint_limits of q1 must be fields with values, got 3"),
    ],
)
def test_an_unknown_joint_of_a_moveit_file_is_named(joints, message):
    arm = read_arm(boxes_urdf(), limits={"joint_limits": MOVEIT})
    np.testing.assert_array_equal(arm.limits.velocity, np.full(6, 1.5))
    with pytest.raises(ArgumentError, match=message):
        read_arm(boxes_urdf(), limits={"joint_limits": joints})


def test_invented_masses_and_limits_in_degrees_are_warned_of_and_described():
    limits = {"acceleration": 5}
    bare = re.sub("<inertial>.*?</inertial>", "", boxes_urdf(), count=3, flags=re.DOTALL)
    degrees = boxes_urdf().replace('upper="1.5" velocity="3"', 'upper="170" velocity="3"')
    for text, message in (
        (bare, "no mass is stated for l0, l1; MuJoCo computes it by 1000 kg/m"),
        (degrees, "limits up to 170 rad and 6 rad/s of q2 look like degrees; state radians"),
    ):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_arm(text, limits=limits)
        assert [message in str(each.message) for each in caught] == [True]
        assert message in describe_arm(text, limits=limits)


@pytest.mark.parametrize(("old", "new", "message"), BAD)
def test_an_error_names_file_element_and_remedy(folder, old, new, message):
    path = folder / "bad.xml"
    assert old in MJCF
    path.write_text(MJCF.replace(old, new, 1))
    with pytest.raises(ArgumentError, match=message) as error:
        read_arm(path, limits=RATES)
    assert "\n" not in str(error.value) and "bad.xml" in str(error.value)


CLOSED = [
    ('<connect body1="cover" body2="five" anchor="0 0 0"/>', "cover and five; remove it"),
    ('<weld body1="hand"/>', "connects .*world"),
    ('<joint joint1="a" joint2="b"/>', "must leave independent joints of the arm; remove it"),
    ('<connect body1="left" body2="hand" anchor="0 0 0"/>', None),
]


@pytest.mark.parametrize(("constraint", "message"), CLOSED)
def test_a_closed_chain_is_an_error_except_in_the_gripper(folder, constraint, message):
    path = folder / "closed.xml"
    path.write_text(MJCF.replace("<actuator>", f"<equality>{constraint}</equality><actuator>"))
    if message is None:
        assert read_arm(path, limits=RATES).num == 7
        return
    with pytest.raises(ArgumentError, match=f"closed.xml: equality .*{message}"):
        read_arm(path, limits=RATES)


SETTINGS = [
    (
        {"limits": {"velocity": 1}},
        "joints a, b, c, d, e, f, g must have limits of acceleration; st",
    ),
    ({}, "limits of velocity and acceleration; state them in seven.limits.yaml beside it"),
    ({"limits": {"speed": 1}}, "limits must have fields position, .*, got 'speed'"),
    ({"limits": RATES | {"velocity": [1, 2]}}, "limits: velocity must have one value for each"),
    ({"limits": RATES | {"velocity": {"q": 1}}}, "limits: velocity must be of the joints a, b"),
    ({"limits": RATES | {"torque": 0}}, "torque of a must be a number > 0, got 0"),
    ({"limits": RATES | {"velocity": -1}}, "velocity of a must be a finite number > 0, got -1"),
    ({"limits": RATES | {"position": [[1, 0]] * 7}}, "position of a must be two finite numbers"),
    ({"limits": "gone.yaml"}, "limits must be a YAML file, got 'gone.yaml"),
    ({"limits": RATES, "tip": "nose"}, "tip must be a site, or one of the bodies ball, .*got nose"),
    ({"limits": RATES, "tip": "three"}, r"must have 6 or 7 hinges .*tip=, got 3: a, b, c"),
    ({"limits": RATES, "tip": "left"}, 'joint "l" must be a hinge; weld it, or name the end of'),
    (
        {"limits": RATES, "shield": Shield(half=(0.01, 0.01), position=(0.0, 0.0, -0.1))},
        "the shield must be outside of the links; move it by shield=",
    ),
    ({"limits": RATES, "home": [0.0]}, "home must have 7 angles within the limits"),
]


@pytest.mark.parametrize(("settings", "message"), SETTINGS)
def test_a_wrong_argument_is_named(folder, settings, message):
    with pytest.raises(ArgumentError, match=message) as error:
        read_arm(folder / "seven.xml", **settings)
    assert "\n" not in str(error.value)


def test_a_file_that_is_missing_or_is_no_model_is_named(folder):
    with pytest.raises(ArgumentError, match="arm must be an MJCF or URDF file, got 'nowhere.xml'"):
        read_arm("nowhere.xml")
    (folder / "text.xml").write_text("hello")
    with pytest.raises(ArgumentError, match="text.xml: the model must be accepted by MuJoCo"):
        read_arm(folder / "text.xml")
    with pytest.raises(ArgumentError, match=r"shield.half must be > 0"):
        Shield(half=(0.0, 0.1))


def test_a_disc_and_a_triangle_have_the_inertia_of_their_outlines(folder, six):
    path, turn = folder / "maker/urdf/six.urdf", np.eye(3)
    settings = {"limits": {"acceleration": 5}, "tip": "tool0", "dtype": np.float64}
    radius, num = 0.2, 32
    disc = read_arm(path, shield=Shield(radius=radius, mass=1e6), **settings)
    turn = Rotation.from_quat(disc.shield_turn, scalar_first=True).as_matrix()
    found = turn.T @ disc.inertia[5] @ turn / 1e6
    of_polygon = radius**2 / 6.0 * (2.0 + np.cos(2.0 * np.pi / num))
    flat = 0.5 * of_polygon + 0.01**2 / 12.0
    np.testing.assert_allclose(found, np.diag([of_polygon, flat, flat]), atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(disc.shield_corners, axis=1), radius)
    corners = ((-0.1, -0.1), (-0.1, 0.2), (0.3, -0.1))  # clockwise
    arm = read_arm(path, shield=Shield(corners=corners, mass=1e6), **settings)
    middle = arm.shield_centre + turn @ np.array([-0.005, *np.mean(corners, axis=0)])
    np.testing.assert_allclose(arm.centre[5], middle, atol=1e-5)
    own = np.diag([0.0, 0.4**2 / 18.0, 0.3**2 / 18.0])
    own[1, 2] = own[2, 1] = -0.4 * 0.3 / 36.0
    found = turn.T @ arm.inertia[5] @ turn / 1e6
    expected = np.trace(own) * np.eye(3) - own
    np.testing.assert_allclose(found, expected, atol=2e-5)
    np.testing.assert_allclose(arm.shield_half, [0.3, 0.2])
    np.testing.assert_allclose(arm.shield_corners, corners[::-1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"radius": 0.0}, "shield.radius must be finite and > 0, got 0"),
        (
            {"radius": 0.1, "half": (0.1, 0.1)},
            "the shield must be described by one of half, radius",
        ),
        ({"corners": ((0.0, 1.0), (1.0, 0.0))}, "shield.corners must be at least three corners"),
        (
            {"corners": ((0.1, 0.0), (0.2, 0.1), (0.2, -0.1))},  # not around the middle
            r"shield.corners must be corners of a convex polygon around \(0, 0\), in their order",
        ),
        (
            {"corners": ((0.1, 0.1), (-0.1, 0.1), (0.01, 0.0), (-0.1, -0.1), (0.1, -0.1))},
            "shield.corners must be corners of a convex polygon",
        ),
    ],
)
def test_an_outline_that_is_no_convex_polygon_is_rejected(options, message):
    with pytest.raises(ArgumentError, match=f"^{message}"):
        Shield(**options)
