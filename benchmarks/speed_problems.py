"""Random problems of speed planning along a given path, for `benchmarks.intercept_speed`.

They have the setting of [Qu2022, Section V-C], as far as the paper states it.
"""

from typing import Any

import jax
import numpy as np

from planner_jax.baselines.intercept.station_time import Blocked, StationTimeProblem, reference_line

# Weight of the squared error at the end of the speed profile, in units of the weight of the squared
# acceleration: w_2 T^3 / w_1, with the weights w_1 = 10 and w_2 = 3 and the horizon T = 10 s of the
# paper [Qu2022].
SOFT_END = 3.0 * 10.0**3 / 10.0
_BLOCK = 256  # Number of problems that are drawn at once.
_MOST = 3  # Maximum number of polygons in one problem.


def speed_problems(num: int, seed: int = 0, *, dtype: Any = np.float32) -> StationTimeProblem:
    """Draw problems with the setting of [Qu2022, Section V-C] and one to three moving obstacles.

    The car drives 6 m along its path in 10 s, starting at 0.5 m/s with zero acceleration. The paper
    does not state limits and obstacles, which are chosen here. The limits are 1.5 m/s and 2 m/s^2.
    An obstacle is a parallelogram in the graph of station (distance along the path) over time. Its
    centre is at 1 to 5 m and 1.5 to 8.5 s. It covers 0.6 to 1.5 m of the path for 1 to 2.5 s, and
    moves at -0.3 to 0.5 m/s. Only problems are used for which dynamic programming on the default
    grid finds a line between the obstacles. With a greater `num` the first problems stay the same.

    Args:
        num: number of problems.
        seed: seed of NumPy's random generator.
        dtype: type of all floating-point arrays.

    Returns:
        A batch of problems: NumPy arrays with a leading axis of length `num`.
    """
    found = jax.jit(jax.vmap(lambda problem: reference_line(problem).found))
    rng = np.random.default_rng(seed)
    kept, have = [], 0
    while have < num:
        block = _draw_block(rng)
        places = np.flatnonzero(found(_convert_floats(block, np.float32)))
        kept.append(jax.tree.map(lambda leaf, places=places: leaf[places], block))
        have += places.size
    return _convert_floats(jax.tree.map(lambda *parts: np.concatenate(parts)[:num], *kept), dtype)


def _convert_floats(problems: StationTimeProblem, dtype: Any) -> StationTimeProblem:
    return jax.tree.map(
        lambda leaf: leaf.astype(dtype) if leaf.dtype == np.float64 else leaf, problems
    )


def _draw_block(rng: np.random.Generator) -> StationTimeProblem:
    shape = (_BLOCK, _MOST)
    num = rng.integers(1, _MOST + 1, _BLOCK)
    station, time = rng.uniform(1.0, 5.0, shape), rng.uniform(1.5, 8.5, shape)
    height, duration = rng.uniform(0.6, 1.5, shape), rng.uniform(1.0, 2.5, shape)
    rise = rng.uniform(-0.3, 0.5, shape) * duration
    middle = station[..., None] + rise[..., None] * np.array([-0.5, 0.5])
    polygons: dict[str, Any] = {
        "start": time - 0.5 * duration,
        "end": time + 0.5 * duration,
        "lower": middle - 0.5 * height[..., None],
        "upper": middle + 0.5 * height[..., None],
        "present": np.arange(_MOST) < num[:, None],
    }
    others: dict[str, Any] = {
        "end_station": np.full(_BLOCK, 6.0),
        "horizon": np.full(_BLOCK, 10.0),
        "initial_speed": np.full(_BLOCK, 0.5),
        "initial_acceleration": np.zeros(_BLOCK),
        "speed_limit": np.full((_BLOCK, 1), 1.5),
        "acceleration_limit": np.full(_BLOCK, 2.0),
    }
    return StationTimeProblem(blocked=Blocked(**polygons), **others)
