"""The measured metric of the variables of two hits, stored with the task.

`python -m benchmarks.measure_scales --tasks rally` measures it. In the metric the search runs in
linear combinations of variables that have few mixed second derivatives.
"""

import functools
import importlib.resources
import io

import numpy as np
from flax import struct


@struct.dataclass
class Metric:
    """A measured linear map to n variables in their units, and a typical change of the guess."""

    factor: np.ndarray  # (n, n), symmetric; variables = factor @ point of the search
    inverse: np.ndarray  # (n, n), of the factor
    shift: np.ndarray  # (n,), median over cases of the optimum minus the guess


@functools.cache
def load_metric(package: str, name: str) -> Metric:
    """Load the metric `name` of the variables from a task's package."""
    path = importlib.resources.files(package) / f"metric_{name}.npz"
    with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
        factor, shift = (file[key].astype(np.float64) for key in ("factor", "shift"))
    return Metric(factor=factor, inverse=np.linalg.inv(factor), shift=shift)
