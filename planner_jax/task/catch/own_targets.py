"""Where targets of a user's own class are, for the referee: as their `at` says, in float64."""

from typing import Any

import jax
import numpy as np

from planner_jax.ball.prediction import PathTable
from planner_jax.ball.target import BallPath, HarmonicPath

_HALF_STEP = 1e-4  # [s], of the central difference


def is_own(targets: Any) -> bool:
    """Whether targets have an `at` and are of no class that the referee follows by itself."""
    return hasattr(targets, "at") and type(targets) not in (BallPath, HarmonicPath, PathTable)


def states_by_class(
    targets: Any, order: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (B, N, 3) of the targets `order` at `times`, both (B, N).

    A velocity that the class itself may give is not asked for: it is what the planner has used.

    Args:
        targets: leaves (B, N, ...).
        order: places of the targets.
        times: [s].
    """
    lanes = np.arange(len(order))[:, None]
    with jax.enable_x64(True):
        ordered = jax.tree.map(lambda leaf: _double(leaf)[lanes, order], targets)
        before, at, after = (
            np.asarray(_positions(ordered, times + step)) for step in (-_HALF_STEP, 0.0, _HALF_STEP)
        )
    return at, (after - before) / (2.0 * _HALF_STEP)


def _double(leaf: Any) -> np.ndarray:
    leaf = np.asarray(leaf)
    return leaf.astype(np.float64) if leaf.dtype.kind == "f" else leaf


@jax.jit
def _positions(targets: Any, times: Any) -> Any:
    def position(target: Any, time: Any) -> Any:
        state = target.at(time)
        return getattr(state, "pos", state)

    return jax.vmap(jax.vmap(position))(targets, times)
