"""Arms whose wrist axes do not meet, and arms of seven joints."""

import jax
import numpy as np
import pytest
from arms import KINDS, mjcf_of

from planner_jax.robot.arm import link_frames, shield_jacobian, shield_pose

float64 = pytest.mark.usefixtures("float64")
of_each_kind = pytest.mark.parametrize("arm", KINDS.values(), ids=KINDS)


def some_angles(arm, num, seed=0):
    """Draw joint angles (num, n) [rad] within the limits."""
    share = np.random.default_rng(seed).uniform(0.01, 0.99, size=(num, arm.num))
    return arm.lower + share * (arm.upper - arm.lower)


@float64
@of_each_kind
def test_links_shield_and_jacobian_are_where_mujoco_has_them(arm):
    mujoco = pytest.importorskip("mujoco", reason="the extra `sims` is not installed")
    model = mujoco.MjModel.from_xml_string(mjcf_of(arm))
    data, jacobian, angles = mujoco.MjData(model), np.zeros((2, 3, arm.num)), some_angles(arm, 5)
    places = jax.jit(jax.vmap(lambda q: (*link_frames(arm, q), shield_pose(arm, q)[1])))(angles)
    slopes = jax.jit(jax.vmap(lambda q: shield_jacobian(arm, q)))(angles)
    rotations, positions, middle = map(np.asarray, places)
    for k, data.qpos[:] in enumerate(angles):
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(rotations[k].reshape(-1, 9), data.xmat[1:], atol=1e-13)
        np.testing.assert_allclose(positions[k], data.xpos[1:], atol=1e-13)
        np.testing.assert_allclose(middle[k], data.site("shield").xpos, atol=1e-13)
        mujoco.mj_jacSite(model, data, jacobian[0], jacobian[1], model.site("shield").id)
        np.testing.assert_allclose(slopes[k], jacobian.reshape(6, -1), atol=1e-13)
