"""One hit as every planner of the task looks at it: the incoming ball's path, and an impact."""

import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.ball.flight import drag_free_fall_time
from planner_jax.ball.prediction import PathTable, predict_path
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.plan import Stroke


@struct.dataclass
class HitContext:
    """One case with what every evaluation reuses."""

    case: HitCase
    path: PathTable  # of the incoming ball
    landing_time: Array  # () [s], when the ball would land if nobody hit it


def prepare_hit(case: HitCase, num_nodes: int) -> HitContext:
    """Integrate the incoming ball once; shared by all hit planners.

    The table's horizon follows the drag-free fall, which drag changes by a few per cent.
    """
    fall, _ = drag_free_fall_time(case.ball, jnp.zeros_like(case.drag), case.gravity)
    horizon = lax.stop_gradient(1.1 * fall)
    path = predict_path(case.ball, horizon, case.drag, case.gravity, num_nodes=num_nodes)
    node = jnp.maximum(jnp.sum(path.pos[1:, 2] > 0.0), 1)
    # From the last node above the ground, down at that node's speed.
    sinking = jnp.maximum(-path.vel[node, 2], 0.1)
    landing = (node - 1) * path.resolution + path.pos[node, 2] / sinking
    return HitContext(case=case, path=path, landing_time=lax.stop_gradient(landing))


@struct.dataclass
class Impact:
    """A stroke with the quadrotor states at both ends of its trajectory."""

    stroke: Stroke
    tail_state: Array  # (4, 3) of the quadrotor at the impact
    apex: Array  # () [m], of the returned ball
