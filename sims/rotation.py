"""Attitudes as matrices, inside compiled programs and on the host."""

from typing import Any

import jax.numpy as jnp


def rotation(quat_wxyz: Any, array_library: Any = jnp) -> Any:
    """Rotation matrix (3, 3), body to world, of a unit quaternion (4,).

    Args:
        quat_wxyz: w x y z.
        array_library: `jax.numpy`, or `numpy` for a result in the precision of the host.
    """
    w, x, y, z = quat_wxyz
    return array_library.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )
