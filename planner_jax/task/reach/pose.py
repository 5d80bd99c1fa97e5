"""Joint states at which an arm's shield has a pose, as goals of a case."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.core.checks import require_kind, require_switch
from planner_jax.core.errors import ArgumentError
from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_ik import inverse_kinematics
from planner_jax.task.arguments import array_of, batch_of


def solve_pose(
    position: ArrayLike,
    rotation: ArrayLike,
    *,
    arm: Arm | None = None,
    is_roll_free: bool = False,
) -> np.ndarray:
    """Return joint states at which the arm's shield has a pose, for `goals=` of `pj.reach.case`.

    Obstacles are not considered.

    Args:
        position: (3,) [m], middle of the shield's front face in the arm's base frame, or (B, 3).
        rotation: (3, 3) or (B, 3, 3), from the shield's frame to the base frame. The columns are
            the shield's outward normal and its edges.
        arm: without batch axes; by default an IRB 1600 with a shield.
        is_roll_free: whether the shield may be rotated about its normal.

    Returns:
        (G, n) or (B, G, n) [rad], within the joint limits. If fewer than G joint states are found,
        the first one is repeated.

    Raises:
        ArgumentError: no joint state is found, or an argument has a wrong shape or type.
    """
    arm = irb1600() if arm is None else arm
    require_kind("arm", arm, Arm)
    require_switch("is_roll_free", is_roll_free)
    batch = max(batch_of("position", position, 3), batch_of("rotation", rotation, 3, 3), key=len)
    array = functools.partial(array_of, batch=batch, dtype=jnp.float32)
    turn, place = (
        np.asarray(each).reshape(-1, *each.shape[len(batch) :])
        for each in (array("rotation", rotation, 3, 3), array("position", position, 3))
    )
    if np.max(np.abs(np.swapaxes(turn, 1, 2) @ turn - np.eye(3))) > 1e-4:
        raise ArgumentError("rotation", "orthonormal", shown="")
    angles, found = map(np.asarray, _solve(arm, turn, place, is_roll_free))
    if not np.all(np.any(found, axis=1)):
        index = int(np.argmin(np.any(found, axis=1))) if batch else None
        raise ArgumentError("position", "within the arm's reach", index=index, shown="")
    chosen = np.where(found, np.arange(found.shape[1]), np.argmax(found, axis=1)[:, None])
    angles = np.take_along_axis(angles, chosen[..., None], axis=1)
    return angles.reshape(*batch, *angles.shape[1:])


@functools.partial(jax.jit, static_argnames="is_roll_free")
def _solve(arm: Arm, rotation: Array, position: Array, is_roll_free: bool) -> tuple[Array, Array]:
    solve = functools.partial(inverse_kinematics, arm, is_roll_free=is_roll_free)
    return jax.vmap(solve)(rotation, position)
