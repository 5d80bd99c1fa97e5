"""Measured scales of `ExactCatch`'s variables, of one segment.

`python -m benchmarks.measure_scales --write` makes the file again.
"""

import functools
import importlib.resources
import json


@functools.cache
def shipped_scale(name: str) -> tuple[float, ...]:
    """Scale of a planner's variables, from `measured_scales.json`; ValueError if none is."""
    path = importlib.resources.files("planner_jax.task.catch") / "measured_scales.json"
    scales = json.loads(path.read_text("utf-8"))
    if name not in scales:
        raise ValueError(
            f"no measured scale for {name!r}: give `scale`, or one of {', '.join(scales)}"
        )
    return tuple(scales[name])
