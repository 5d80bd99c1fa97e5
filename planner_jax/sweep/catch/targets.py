"""Paths of the targets of one row of `plans.parquet`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath, HarmonicPath


def target_paths(row: dict[str, Any]) -> BallPath | HarmonicPath:
    """The targets, leaves with a leading axis N."""

    def leaf(name: str, *trailing: int) -> jax.Array:
        return jnp.asarray(np.reshape(row[name], (-1, *trailing)), jnp.float32)

    if row["swing_pos"] is None:
        ball = BallState(leaf("ball_pos", 3), leaf("ball_vel", 3))
        return BallPath(ball, leaf("drag", 3), leaf("ball_gravity"))
    return HarmonicPath(
        pos=leaf("swing_pos", 3),
        vel=leaf("swing_vel", 3),
        amplitude=leaf("swing_amplitude", 3),
        rate=leaf("swing_rate"),
        phase=leaf("swing_phase"),
    )


def target_positions(row: dict[str, Any], times: np.ndarray) -> np.ndarray:
    """Where all targets are at some times (K,) [s], (N, K, 3) [m]."""
    return np.asarray(_positions(target_paths(row), jnp.asarray(times, jnp.float32)))


@jax.jit
def _positions(paths: BallPath | HarmonicPath, times: jax.Array) -> jax.Array:
    return jax.vmap(lambda path: jax.vmap(lambda time: path.at(time).pos)(times))(paths)
