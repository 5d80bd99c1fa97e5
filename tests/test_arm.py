import dataclasses
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from jaxpr import assert_full_precision

import planner_jax.robot
from planner_jax.robot.arm import REGIMES, capsules, link_frames, shield_jacobian, shield_pose
from planner_jax.robot.arm_dynamics import inverse_dynamics
from planner_jax.robot.arm_file import irb1600, read_arm
from planner_jax.robot.arm_ik import inverse_kinematics

FILE = Path(planner_jax.robot.__file__).parent / "models" / "irb1600.xml"
IRB1600 = FILE.read_text("utf-8")
ASKEW = (Path(__file__).parent / "data" / "askew_arm.xml").read_text("utf-8")
MODELS = {"irb1600": IRB1600, "askew": ASKEW}
LIMITS = {"velocity": 3.0, "acceleration": 30.0}
NUM = 200  # Number of joint positions in the one compiled program that most tests use.
CHAIN = np.array([[0.15, 0, 0.4865], [0, 0, 0.475], [0.3, 0, 0], [0.3, 0, 0], [0.065, 0, 0]])

float64 = pytest.mark.usefixtures("float64")
of_each_arm = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)


def some_angles(arm, num, seed=0):
    """Draw joint angles (num, 6) [rad] within the limits and at most pi from their middle."""
    share = np.random.default_rng(seed).uniform(0.01, 0.99, size=(num, 6))
    middle = 0.5 * (arm.lower + arm.upper)
    half = np.minimum(0.5 * (arm.upper - arm.lower), np.pi)
    return (middle + (2.0 * share - 1.0) * half).astype(arm.home.dtype)


def without_capsules(arm):
    """Return the arm without collision capsules, so that all arms use the same programs."""
    none = {"capsule_ends": arm.capsule_ends[:0], "capsule_radius": arm.capsule_radius[:0]}
    none["shield_gap_radius"] = arm.shield_gap_radius[:0]
    pairs = {"capsule_link": (), "pairs": (), "shield_pairs": (), "base_pairs": ()}
    return dataclasses.replace(arm, **none, **pairs)


@struct.dataclass
class Everything:
    frames: tuple
    pose: tuple
    jacobian: jax.Array
    torques: jax.Array
    branches: jax.Array
    found: jax.Array
    off: jax.Array  # largest deviation of the poses of all inverse solutions from the given pose


def everything_at(arm, angles, velocity, acceleration):
    rotation, middle = shield_pose(arm, angles)
    branches, found = inverse_kinematics(arm, rotation, middle)
    turned, place = jax.vmap(lambda q: shield_pose(arm, q))(branches)
    turned_off, place_off = jnp.abs(turned - rotation[None]), jnp.abs(place - middle[None])
    off = jnp.maximum(jnp.max(turned_off, axis=(1, 2)), jnp.max(place_off, axis=1))
    torques = inverse_dynamics(arm, angles, velocity, acceleration)
    frames, pose = link_frames(arm, angles), (rotation, middle)
    return Everything(frames, pose, shield_jacobian(arm, angles), torques, branches, found, off)


one_at = jax.jit(everything_at)
many_at = jax.jit(jax.vmap(everything_at, in_axes=(None, 0, 0, 0)))


def everything(arm, angles, velocity=0.0, acceleration=0.0):
    motion = np.broadcast_arrays(angles, velocity, acceleration)
    rows = (np.resize(each, (NUM, 6)).astype(angles.dtype) for each in motion)
    found = many_at(without_capsules(arm), *rows)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(angles)], found)


@jax.jit
def move_branches(arm, rotation, middle, velocity, spin):
    def move(rotation, middle, velocity, spin):
        solve = lambda rotation, middle: inverse_kinematics(arm, rotation, middle)  # noqa: E731
        turning = jnp.cross(spin, rotation.T).T
        return jax.jvp(solve, (rotation, middle), (turning, velocity))

    (branches, found), (rates, _) = jax.vmap(move)(rotation, middle, velocity, spin)
    return branches, found, rates


@float64
def test_at_angle_zero_the_arm_stands_upright_with_its_forearm_forward():
    rotations, positions = everything(
        read_arm(IRB1600, limits=LIMITS, dtype=np.float64), np.zeros((1, 6))
    ).frames
    np.testing.assert_array_equal(rotations[0], np.tile(np.eye(3), (6, 1, 1)))
    np.testing.assert_array_equal(positions[0, 0], np.zeros(3))
    np.testing.assert_allclose(positions[0, 1:], np.cumsum(CHAIN, axis=0), rtol=1e-15)


def test_at_home_the_shield_is_low_in_front_and_the_motors_hold_the_weight():
    arm = irb1600()
    at = everything(arm, arm.home[None])
    (rotation,), (middle,) = at.pose
    np.testing.assert_allclose(rotation[:, 0], [0.62, 0.17, -0.77], atol=5e-3)
    front = middle - 0.01 * rotation[:, 0]
    np.testing.assert_allclose(front, [1.091, 0.281, 0.190], atol=5e-4)
    np.testing.assert_allclose(at.torques[0, :3], [0.0, -117.0, -13.8], atol=0.5)


@float64
@of_each_arm
def test_the_jacobian_is_that_of_the_moving_shield(model):
    """Compare with the skew matrix dR/dq R^T of the angular velocity that each joint causes."""
    arm, step = read_arm(model, limits=LIMITS, dtype=np.float64), 1e-6
    angles = some_angles(arm, 1)[0]
    steps = step * np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)])
    at = everything(arm, angles + steps)
    rotation, middle = at.pose
    rates = (rotation[1:7] - rotation[7:]) / (2.0 * step) @ rotation[0].T
    turning = np.stack([rates[:, 2, 1], rates[:, 0, 2], rates[:, 1, 0]])
    moving = (middle[1:7] - middle[7:]).T / (2.0 * step)
    np.testing.assert_allclose(at.jacobian[0], np.concatenate([moving, turning]), atol=1e-9)


@pytest.fixture(scope="module", params=MODELS.values(), ids=MODELS)
def simulated(request):
    mujoco = pytest.importorskip("mujoco", reason="the extra `sims` is not installed")
    arm, rng = read_arm(request.param, limits=LIMITS, dtype=np.float64), np.random.default_rng(1)
    motion = some_angles(arm, 9), *rng.normal(scale=(3.0, 20.0), size=(9, 6, 2)).transpose(2, 0, 1)
    return mujoco, mujoco.MjModel.from_xml_string(request.param), arm, motion


@float64
def test_links_capsules_and_jacobian_are_where_mujoco_has_them(simulated):
    mujoco, model, arm, (angles, _, _) = simulated
    data, jacobian = mujoco.MjData(model), np.zeros((2, 3, 6))
    at = everything(arm, angles)
    rotations, positions = at.frames
    ends = np.asarray(jax.jit(jax.vmap(lambda q: capsules(arm, q)))(angles))
    geoms = [k for k in range(model.ngeom) if model.geom_type[k] != mujoco.mjtGeom.mjGEOM_BOX]
    for k, each in enumerate(angles):
        data.qpos[:] = each
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(rotations[k], data.xmat[2:].reshape(6, 3, 3), atol=1e-13)
        np.testing.assert_allclose(positions[k], data.xpos[2:], atol=1e-13)
        np.testing.assert_allclose(ends[k].mean(axis=1), data.geom_xpos[geoms], atol=1e-13)
        along = 2.0 * model.geom_size[geoms, 1:2] * data.geom_xmat[geoms][:, 2::3]
        np.testing.assert_allclose(np.abs(ends[k, :, 1] - ends[k, :, 0]), np.abs(along), atol=1e-13)
        mujoco.mj_jacSite(model, data, jacobian[0], jacobian[1], model.site("shield").id)
        np.testing.assert_allclose(at.pose[1][k], data.site("shield").xpos, atol=1e-13)
        np.testing.assert_allclose(at.jacobian[k], jacobian.reshape(6, 6), atol=1e-13)
    np.testing.assert_array_equal(arm.capsule_link, model.geom_bodyid[geoms] - 2)
    np.testing.assert_allclose(arm.capsule_radius, model.geom_size[geoms, 0], rtol=1e-15)
    np.testing.assert_allclose(arm.shield_half, model.geom("shield").size[1:], rtol=1e-15)
    np.testing.assert_allclose(np.stack([arm.lower, arm.upper], axis=1), model.jnt_range)
    np.testing.assert_array_equal(arm.home, model.key("home").qpos)


@float64
def test_the_torques_of_a_motion_are_those_of_mujoco(simulated):
    mujoco, model, arm, motion = simulated
    data = mujoco.MjData(model)
    ours = everything(arm, *motion).torques
    for k in range(len(ours)):
        data.qpos[:], data.qvel[:], data.qacc[:] = (each[k] for each in motion)
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(ours[k], data.qfrc_inverse, rtol=1e-10, atol=1e-10)


def from_the_nearest(at, angles):
    distance = np.max(np.abs(at.branches - angles[:, None]), axis=2)
    return np.min(np.where(at.found, distance, np.inf), axis=1)


@float64
@of_each_arm
def test_every_branch_reaches_the_pose_and_one_is_the_original(model):
    arm = read_arm(model, limits=LIMITS, dtype=np.float64)
    angles = some_angles(arm, NUM)
    at = everything(arm, angles)
    assert np.all(np.isfinite(at.branches)) and np.max(from_the_nearest(at, angles)) < 1e-7
    within = np.all((at.branches >= arm.lower) & (at.branches <= arm.upper), axis=2)
    np.testing.assert_array_equal(at.found, within & (at.off < 1e-9))
    assert np.max(np.sum(at.found, axis=1)) == 8
    for every, good in zip(at.branches, at.found, strict=True):
        apart = np.max(np.abs(every[good][:, None] - every[good][None]), axis=2)
        assert np.all(apart + np.eye(len(apart)) > 1e-3)


def test_inverse_kinematics_is_right_to_rounding_in_float32():
    arm = irb1600()
    angles = some_angles(arm, NUM)
    at = everything(arm, angles)
    assert at.branches.dtype == np.float32 and np.max(at.off[at.found]) < 2e-6
    # Where the arm is stretched or the wrist straight, joint angles depend on square roots of
    # numbers near 0, which magnify rounding errors.
    assert np.max(from_the_nearest(at, angles)) < 1e-2


def test_the_branches_move_as_the_jacobian_says():
    arm = without_capsules(irb1600())
    rotation, middle = everything(arm, some_angles(arm, len(EDGES))).pose
    velocity, spin = np.random.default_rng(2).normal(size=(2, *middle.shape)).astype(np.float32)
    branches, found, rates = map(np.asarray, move_branches(arm, rotation, middle, velocity, spin))
    driven = np.einsum("nij,nj->ni", everything(arm, branches[found]).jacobian, rates[found])
    expected = np.concatenate([velocity, spin], axis=1)
    np.testing.assert_allclose(driven, expected[np.nonzero(found)[0]], atol=1e-3)


# Positions [m] of the wrist centre of the IRB 1600 at singularities and at the edge of its
# workspace, with the shield facing +x, and whether the arm reaches the position.
EDGES = {
    "straight wrist": ((0.75, 0.0, 0.9615), True),
    "straight arm": ((1.225, 0.0, 0.4865), True),
    "wrist on axis 1": ((0.0, 0.0, 1.3), True),
    "wrist on axis 2": ((0.15, 0.0, 0.4865), False),
    "just too far": ((1.2252, 0.0, 0.4865), False),
    "far away": ((7.0, -2.0, 0.3), False),
    "too near": ((0.2, 0.0, 0.5), False),
}


def test_at_the_edges_of_the_workspace_angles_and_rates_are_finite():
    arm = without_capsules(irb1600())
    places, reached = (np.array(each) for each in zip(*EDGES.values(), strict=True))
    middle = (places + [0.075, 0.0, 0.0]).astype(np.float32)
    rotation = np.tile(np.eye(3, dtype=np.float32), (len(EDGES), 1, 1))
    velocity, spin = np.random.default_rng(3).normal(size=(2, len(EDGES), 3)).astype(np.float32)
    branches, found, rates = map(np.asarray, move_branches(arm, rotation, middle, velocity, spin))
    assert np.all(np.isfinite(branches)) and np.all(np.isfinite(rates))
    np.testing.assert_array_equal(np.any(found, axis=1), reached, str(list(EDGES)))


def test_a_batch_is_a_loop():
    arm = irb1600()
    angles = some_angles(arm, 4, seed=5)
    motion = angles, 0.5 * angles, 2.0 * angles
    batch = everything(arm, *motion)
    for k in range(len(angles)):
        alone = one_at(without_capsules(arm), *(each[k] for each in motion))
        of_batch = jax.tree.map(lambda leaf, k=k: leaf[k], batch)
        chex.assert_trees_all_close(alone, of_batch, rtol=1e-7, atol=2e-4)


def test_every_product_asks_for_full_precision():
    arm = irb1600()
    assert assert_full_precision(everything_at, arm, *[arm.home] * 3) > 0
    assert assert_full_precision(capsules, arm, arm.home) > 0


def test_the_regimes_differ_in_speed_acceleration_and_end():
    speeds = [150.0, 160.0, 170.0, 320.0, 400.0, 450.0]  # [deg/s], from the data sheet
    regimes = {"R1": (2.0, 60.0, False), "R2": (1.0, 30.0, True), "R3": (2.0, 60.0, True)}
    for name, (factor, acceleration, ends_at_rest) in regimes.items():
        limits = REGIMES[name].limits
        np.testing.assert_allclose(np.rad2deg(limits.velocity) / factor, speeds, rtol=1e-6)
        np.testing.assert_array_equal(limits.acceleration, np.full(6, acceleration))
        assert REGIMES[name].ends_at_rest is ends_at_rest


def test_a_file_is_read_as_its_text_wherever_its_base_stands_and_packaged_once(tmp_path):
    assert irb1600() is irb1600()
    assert {(type(x), x.dtype.name) for x in jax.tree.leaves(irb1600())} == {
        (np.ndarray, "float32")
    }
    place = tmp_path / "arm.xml"
    place.write_text(IRB1600.replace('<body name="base">', '<body name="base" pos="1 2 3">'))
    moved, alike = read_arm(place, limits=LIMITS), read_arm(IRB1600, limits=LIMITS)
    assert jax.tree.all(jax.tree.map(np.array_equal, moved, alike))
