"""Arms whose wrist axes do not meet, arms of seven joints, and inverse kinematics of all arms."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arms import KINDS, mjcf_of
from jaxpr import assert_full_precision

import planner_jax as pj
from planner_jax.robot.arm import link_frames, shield_jacobian, shield_pose
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_ik import choose_ik, inverse_kinematics
from planner_jax.robot.arm_ik_numerical import STARTS

float64 = pytest.mark.usefixtures("float64")
of_each_kind = pytest.mark.parametrize("arm", KINDS.values(), ids=KINDS)
IRB1600 = jax.tree.map(lambda leaf: leaf.astype(float), irb1600())


def some_angles(arm, num, seed=0):
    """Draw joint angles (num, n) [rad] within the limits."""
    share = np.random.default_rng(seed).uniform(0.01, 0.99, size=(num, arm.num))
    return (arm.lower + share * (arm.upper - arm.lower)).astype(arm.lower.dtype)


def simulate(arm):
    mujoco = pytest.importorskip("mujoco", reason="the extra `sims` is not installed")
    model = mujoco.MjModel.from_xml_string(mjcf_of(arm))
    return mujoco, model, mujoco.MjData(model)


@float64
@of_each_kind
def test_links_shield_and_jacobian_are_where_mujoco_has_them(arm):
    mujoco, model, data = simulate(arm)
    jacobian, angles = np.zeros((2, 3, arm.num)), some_angles(arm, 5)
    frames = jax.jit(jax.vmap(lambda q: (*link_frames(arm, q), *shield_pose(arm, q))))(angles)
    slopes = jax.jit(jax.vmap(lambda q: shield_jacobian(arm, q)))(angles)
    rotations, positions, turn, middle = map(np.asarray, frames)
    for k, data.qpos[:] in enumerate(angles):
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(rotations[k].reshape(-1, 9), data.xmat[1:], atol=1e-13)
        np.testing.assert_allclose(positions[k], data.xpos[1:], atol=1e-13)
        np.testing.assert_allclose(turn[k].ravel(), data.site("shield").xmat, atol=1e-13)
        np.testing.assert_allclose(middle[k], data.site("shield").xpos, atol=1e-13)
        mujoco.mj_jacSite(model, data, jacobian[0], jacobian[1], model.site("shield").id)
        np.testing.assert_allclose(slopes[k], jacobian.reshape(6, -1), atol=1e-13)


def test_the_method_is_chosen_by_the_geometry():
    chosen = {name: arm.ik for name, arm in KINDS.items()} | {"irb 1600": choose_ik(IRB1600)}
    assert chosen == {
        "ur": "parallel",
        "askew ur": "parallel",
        "offset wrist": "numerical",
        "seven joints": "numerical",
        "irb 1600": "spherical",
    }


@pytest.mark.parametrize(
    ("kind", "leaf", "joint", "value"),
    [
        ("irb 1600", "axis", 1, (0.0, 0.8, 0.6)),  # axis 2 not at right angles to axis 1
        ("irb 1600", "axis", 2, (1.0, 0.0, 0.0)),  # axis 3 not parallel to axis 2
        ("irb 1600", "origin", 4, (0.3, 0.0, 0.1)),  # axes 4 and 5 do not meet
        ("irb 1600", "origin", 2, (0.0, 1.0, 0.0)),  # axes 2 and 3 coincide
        ("ur", "axis", 2, (0.0, 0.6, 0.8)),  # axis 3 not parallel to axis 2
        ("ur", "axis", 3, (0.0, 0.6, 0.8)),  # axis 4 not parallel to axis 3
        ("ur", "axis", 5, (0.0, 0.6, 0.8)),  # axis 6 not at right angles to axis 5
        ("ur", "origin", 5, (0.01, 0.0996, 0.0997)),  # axes 5 and 6 do not meet
        ("ur", "origin", 3, (0.0, 0.0, 0.1)),  # axes 3 and 4 coincide
    ],
)
def test_an_arm_that_misses_one_condition_of_a_closed_form_has_the_numerical_method(
    kind, leaf, joint, value
):
    arm = IRB1600 if kind == "irb 1600" else KINDS[kind]
    changed = np.array(getattr(arm, leaf))
    changed[joint] = value
    assert choose_ik(dataclasses.replace(arm, **{leaf: changed})) == "numerical"


@functools.partial(jax.jit, static_argnames="is_roll_free")
def invert(arm, angles, is_roll_free=False):
    """Return solutions for the poses of joint angles, which were found, and the poses' errors."""

    def of_one(angles):
        turn, middle = shield_pose(arm, angles)
        solutions, found = inverse_kinematics(arm, turn, middle, is_roll_free=is_roll_free)
        turns, middles = jax.vmap(lambda each: shield_pose(arm, each))(solutions)
        off = jnp.max(jnp.abs(turns - turn[None])[:, :, : 1 if is_roll_free else 3], axis=(1, 2))
        return solutions, found, jnp.maximum(off, jnp.max(jnp.abs(middles - middle[None]), axis=1))

    return jax.vmap(of_one)(angles)


def within(arm, angles):
    return np.all((angles >= arm.lower) & (angles <= arm.upper), axis=-1)


@float64
@pytest.mark.parametrize("kind", ["irb 1600", "ur", "askew ur"])
def test_closed_forms_recover_ten_thousand_poses_and_their_branches_differ(kind):
    arm = IRB1600 if kind == "irb 1600" else KINDS[kind]
    angles = some_angles(arm, 10_000)
    solutions, found, off = map(np.asarray, invert(arm, angles))
    assert np.all(np.isfinite(solutions))
    np.testing.assert_array_equal(found, within(arm, solutions) & (off < 1e-9))
    turns = 2.0 * np.pi * np.round((solutions - angles[:, None]) / (2.0 * np.pi))
    apart = np.max(np.abs(solutions - turns - angles[:, None]), axis=2)
    # Where a wrist is straight or an arm stretched, square roots magnify rounding errors.
    assert np.max(np.min(np.where(found, apart, np.inf), axis=1)) < 1e-5
    distance = np.max(np.abs(solutions[:, :, None] - solutions[:, None]), axis=3)
    distance[~(found[:, None] & found[:, :, None])] = np.inf
    closest = np.min(distance + np.where(np.eye(8), np.inf, 0.0), axis=(1, 2))
    assert np.mean(closest > 1e-3) > 0.999
    assert_mujoco_agrees(arm, angles, solutions, found)


def assert_mujoco_agrees(arm, angles, solutions, found):
    """Compare the shield's pose at one solution for each pose with MuJoCo's pose."""
    mujoco, model, data = simulate(arm)
    site, places = data.site("shield"), []
    one = np.argmax(np.random.default_rng(1).uniform(size=found.shape) * found, axis=1)
    is_any = np.any(found, axis=1)
    for both in zip(angles[is_any], solutions[is_any, one[is_any]], strict=True):
        for data.qpos[:] in both:
            mujoco.mj_kinematics(model, data)
            places.append(np.append(site.xpos, site.xmat))
    error = np.abs(np.subtract(places[::2], places[1::2]))
    assert np.max(error[:, :3]) < 1e-5 and np.max(error[:, 3:]) < 1e-4


def assert_recovers(arm, num, is_roll_free, share=0.995):
    angles = some_angles(arm, num)
    solutions, found, off = map(np.asarray, invert(arm, angles, is_roll_free))
    assert np.all(within(arm, solutions)) and np.max(off[found]) < 1.1e-4
    assert np.mean(np.any(found, axis=1)) >= share
    distance = np.max(np.abs(solutions[:, :, None] - solutions[:, None]), axis=3)
    pairs = found[:, None] & found[:, :, None] & ~np.eye(STARTS, dtype=bool)
    assert np.all(distance[pairs] >= 1e-3)
    if not is_roll_free:
        assert_mujoco_agrees(arm, angles, solutions, found)


single = functools.partial(jax.tree.map, lambda leaf: leaf.astype(np.float32))


@pytest.mark.parametrize("kind", ["offset wrist", "seven joints"])
def test_the_search_recovers_three_hundred_poses_in_float32(kind):
    assert_recovers(single(KINDS[kind]), 300, is_roll_free=False)


def test_the_search_recovers_directions_of_the_shield_by_any_roll():
    assert_recovers(single(KINDS["offset wrist"]), 300, is_roll_free=True)


@pytest.mark.slow
@float64
@pytest.mark.parametrize("is_roll_free", [False, True])
@pytest.mark.parametrize("kind", [*KINDS, "irb 1600"])
def test_the_search_recovers_ten_thousand_poses_of_every_arm(kind, is_roll_free):
    arm = IRB1600 if kind == "irb 1600" else KINDS[kind]
    assert_recovers(dataclasses.replace(arm, ik="numerical"), 10_000, is_roll_free)


@float64
def test_closed_forms_try_four_rolls_unless_the_last_joint_rolls_the_shield():
    arm = KINDS["ur"]
    angles = some_angles(arm, 10_000)
    (_, found, _), (_, every, off) = (
        map(np.asarray, invert(arm, angles, k)) for k in (False, True)
    )
    assert every.shape == (10_000, 32) and np.max(off[every]) < 1e-9
    np.testing.assert_array_equal(every[:, :8], found)
    assert np.sum(every) > 3 * np.sum(found)
    held = dataclasses.replace(arm, turns_in_plane=True)
    assert jax.eval_shape(lambda q: invert(held, q, True), angles)[1].shape == (10_000, 8)


@float64
def test_the_solutions_of_the_search_move_as_the_jacobian_says():
    arm = KINDS["offset wrist"]
    velocity, spin = np.random.default_rng(2).normal(size=(2, 3))
    turn, middle = jax.jit(shield_pose)(arm, some_angles(arm, 1)[0])

    def solve(time):
        turning = jnp.cross(spin[None], turn.T).T
        return inverse_kinematics(arm, turn + time * turning, middle + time * velocity)

    (solutions, found), (rates, _) = jax.jit(lambda: jax.jvp(solve, (0.0,), (1.0,)))()
    slopes = jax.jit(jax.vmap(lambda q: shield_jacobian(arm, q)))(solutions)
    solutions, found = np.asarray(solutions), np.asarray(found)
    inside = found & within(arm, solutions + 1e-6) & within(arm, solutions - 1e-6)
    driven = np.einsum("kij,kj->ki", slopes, rates)[inside]
    assert len(driven)
    np.testing.assert_allclose(driven, [np.append(velocity, spin)] * len(driven), atol=1e-3)


def test_out_of_reach_the_search_finds_nothing_and_stays_finite():
    arm = single(KINDS["seven joints"])
    middle = np.array([3.0, 0.0, 0.5], np.float32)
    solve = jax.jit(lambda: inverse_kinematics(arm, jnp.eye(3), middle))
    solutions, found = map(np.asarray, solve())
    assert np.all(within(arm, solutions)) and not np.any(found)


def test_goals_of_a_pose_hold_the_shield_in_the_pose():
    arm = irb1600()
    angles = np.stack([arm.home, arm.home + np.float32(0.1)])
    poses = jax.jit(jax.vmap(lambda q: shield_pose(arm, q)))
    turn, middle = map(np.asarray, poses(angles))
    goals = pj.reach.solve_pose(middle, turn)
    assert goals.shape == (2, 8, 6) and np.all(within(arm, goals))
    assert np.min(np.max(np.abs(goals[1] - angles[1]), axis=1)) < 1e-3
    turns, middles = poses(goals.reshape(-1, 6))
    np.testing.assert_allclose(middles, np.repeat(middle, 8, axis=0), atol=1e-5)
    np.testing.assert_allclose(turns, np.repeat(turn, 8, axis=0), atol=1e-5)
    with pytest.raises(pj.ArgumentError, match="position must be within the arm's reach"):
        pj.reach.solve_pose([middle[0], (9.0, 0.0, 0.0)], turn)
    with pytest.raises(pj.ArgumentError, match="rotation must be orthonormal"):
        pj.reach.solve_pose(middle, 2.0 * turn)


@of_each_kind
def test_every_product_asks_for_full_precision(arm):
    arm = single(arm)
    assert assert_full_precision(invert, arm, arm.home[None]) > 0
