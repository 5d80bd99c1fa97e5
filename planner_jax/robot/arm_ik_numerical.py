"""Numerical inverse kinematics by damped least squares, for arms without a closed form.

Levenberg-Marquardt steps, whose damping is half of the squared error [Sugihara2011], lead from
several starts to the pose. Joint angles that would leave their limits are projected onto them. A
search that is still far from the pose after some steps continues from another start.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.scipy.linalg import cho_factor, cho_solve

from planner_jax.robot.arm import Arm, product, shield_jacobian, shield_pose

STARTS = 16  # number of searches, and so of candidates
_POOL = 2048  # number of joint positions among which the starts are selected
_PERIODS, _STEPS = 3, 9  # A search may have a new start in each of the periods of 9 steps.
_HOPELESS = 0.03  # [m and rad], error at a period's end with which a search has a new start
# Greatest errors of position [m] and angle [rad] of a solution.
_POSITION, _ANGLE = 1e-5, 1e-4
_APART = 1e-3  # [rad], least difference of two solutions in a joint angle
_LEAST_DAMPING = 32.0  # in units of the rounding error of 1


def search_poses(
    arm: Arm, rotation: Array, middle: Array, is_roll_free: bool
) -> tuple[Array, Array]:
    """Return candidates for the joint angles that bring the shield to a pose.

    The starts are the joint positions whose poses are nearest to the target, among the home and
    low-discrepancy samples within the joint limits. Of an arm with seven joints the candidates
    differ in the arm's self-motion too.

    Args:
        arm: one arm.
        rotation: (3, 3), from shield to base frame; columns are the outward normal and the edges.
        middle: (3,) [m], middle of the shield's front face in the base frame.
        is_roll_free: whether the shield may be rotated about its normal.

    Returns:
        angles: (STARTS, n) [rad], within the joint limits.
        found: (STARTS,) bool, whether the pose is reached, by no previous candidate with the same
            angles.
    """
    dtype = middle.dtype
    lower, upper = jnp.asarray(arm.lower), jnp.asarray(arm.upper)
    pool = lower[None] + jnp.asarray(_samples(arm.num), dtype) * (upper - lower)[None]
    pool = jnp.concatenate([jnp.asarray(arm.home)[None], pool])
    axes = slice(0, 1) if is_roll_free else slice(0, 3)
    turns, middles = jax.vmap(lambda angles: shield_pose(arm, angles))(pool)
    aligned = jnp.mean(jnp.sum((turns * rotation[None])[:, :, axes], axis=1), axis=1)
    _, nearest = lax.top_k(
        aligned - jnp.sum((middles - middle[None]) ** 2, axis=1), _PERIODS * STARTS
    )

    def error(turn: Array, place: Array) -> Array:
        """Return the error (6,) of a pose: of the position [m], and the rotation vector [rad]."""
        axis = jnp.sum(jnp.cross(turn[:, axes], rotation[:, axes], axis=0), axis=1)
        trace = jnp.sum(turn[:, axes] * rotation[:, axes])
        axis, cosine = (axis, trace) if is_roll_free else (0.5 * axis, 0.5 * (trace - 1.0))
        sine = jnp.sqrt(jnp.maximum(jnp.sum(axis**2), 1e-12))
        return jnp.concatenate([middle - place, axis * jnp.arctan2(sine, cosine) / sine])

    def step(angles: Array) -> tuple[Array, Array]:
        """Return the error (6,) at joint angles, and the next joint angles."""
        off, slope = error(*shield_pose(arm, angles)), shield_jacobian(arm, angles)
        if is_roll_free:
            normal = jnp.concatenate([jnp.zeros(3, dtype), rotation[:, 0]])
            slope = slope - normal[:, None] * product(normal, slope)[None]
        pull = product(off, slope)
        is_blocked = jnp.where(pull < 0.0, angles <= lower, angles >= upper)
        slope = jnp.where(is_blocked[None], 0.0, slope)
        damping = 0.5 * jnp.sum(off**2) + _LEAST_DAMPING * jnp.finfo(dtype).eps
        factor = cho_factor(product(slope, slope.T) + damping * jnp.eye(6, dtype=dtype))
        change = product(cho_solve(factor, off), slope)
        change = jnp.where(jnp.isfinite(change), change, 0.0)
        return off, jnp.clip(angles + change, lower, upper)

    def search(starts: Array) -> tuple[Array, Array]:
        """Return the last angles of a search with starts (_PERIODS, n), and whether they solve."""

        def advance(k: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            angles = state[2]
            off, following = step(angles)
            is_hopeless = (k % _STEPS == _STEPS - 1) & (jnp.sum(off**2) > _HOPELESS**2)
            renewed = starts[jnp.minimum(k // _STEPS + 1, _PERIODS - 1)]
            return angles, off, jnp.where(is_hopeless, renewed, following)

        state = starts[0], jnp.zeros(6, dtype), starts[0]
        angles, off, _ = lax.fori_loop(0, _PERIODS * _STEPS, advance, state)
        squares = jnp.sum(off.reshape(2, 3) ** 2, axis=1)
        return angles, jnp.all(squares < jnp.array([_POSITION**2, _ANGLE**2], dtype))

    angles, found = jax.vmap(search, 1)(pool[nearest].reshape(_PERIODS, STARTS, -1))
    is_same = jnp.max(jnp.abs(angles[:, None] - angles[None]), axis=2) < _APART
    is_before = np.tri(STARTS, k=-1, dtype=bool)
    return angles, found & ~jnp.any(is_same & is_before & found[None], axis=1)


def _samples(num: int) -> np.ndarray:
    """Return points (_POOL, num) of the unit cube: a low-discrepancy sequence [Roberts2018]."""
    ratio = 2.0
    for _ in range(64):  # to the root of ratio^(num + 1) = ratio + 1
        ratio = (1.0 + ratio) ** (1.0 / (num + 1))
    return (0.5 + np.outer(np.arange(_POOL), ratio ** -np.arange(1.0, num + 1.0))) % 1.0
