"""Measured units of variables, and trained networks for starting points, stored with each task.

A quasi-Newton method converges faster if all variables have second derivatives of similar size. So
each planner uses units of variables that `python -m benchmarks.measure_scales` measured.

The networks predict starting points. `python -m benchmarks.learn_starts --train MINUTES` trains
them to lower the planner's own objective, without solved examples. A search starts at a network's
point only if it costs less than the planner's own guess, so a poor prediction does no harm.
"""

import functools
import importlib.resources
import io
import json

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.errors import ArgumentError

REACH = 4.0  # number of standard deviations at which features are clipped


@struct.dataclass
class StartNetwork:
    """A network that corrects a guessed starting point: weights, and statistics of the inputs."""

    mean: Array | np.ndarray  # (F,), mean of each of F features in the training data
    deviation: Array | np.ndarray  # (F,), standard deviation of each feature
    weights: tuple[Array | np.ndarray, ...]  # (inputs, outputs) of each layer
    biases: tuple[Array | np.ndarray, ...]  # (outputs,)

    def __call__(self, features: Array) -> Array:
        """Return the correction (n,) of a guessed starting point, from F numbers about its case."""
        cast = functools.partial(jnp.asarray, dtype=features.dtype)
        values = (features - cast(self.mean)) / cast(self.deviation)
        values = jnp.clip(values, -REACH, REACH)
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = jnp.matmul(values, cast(weight), precision=lax.Precision.HIGHEST) + cast(bias)
            if k + 1 < len(self.weights):
                values = jnp.tanh(values)
        return values


@functools.cache
def load_scale(package: str, name: str) -> tuple[float, ...]:
    """Load measured units of variables from the `measured_scales.json` of a task's package."""
    path = importlib.resources.files(package) / "measured_scales.json"
    scales = json.loads(path.read_text("utf-8"))
    if name not in scales:
        raise ArgumentError("scale", f"passed, except for {', '.join(scales)}", shown=name)
    return tuple(scales[name])


@functools.cache
def load_network(package: str, name: str) -> StartNetwork:
    """Load the network `name` for starting points from a task's package."""
    path = importlib.resources.files(package) / f"start_{name}.npz"
    with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
        arrays = {key: file[key].astype(np.float32) for key in file.files}
    num = sum(key.startswith("weight") for key in arrays)
    return StartNetwork(
        mean=arrays["mean"],
        deviation=arrays["deviation"],
        weights=tuple(arrays[f"weight{k}"] for k in range(num)),
        biases=tuple(arrays[f"bias{k}"] for k in range(num)),
    )
