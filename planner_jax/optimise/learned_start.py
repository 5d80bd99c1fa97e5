"""Starting points by a small network that has learnt where searches end.

The network is trained on the planner's own objective (amortised optimisation), without solved
examples, by `python -m benchmarks.learn_starts --train MINUTES`. A search goes on from its point
only where that costs less than the guess without it, so that nothing is lost far from what it has
seen.
"""

import functools
import importlib.resources
import io
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

REACH = 4.0  # standard deviations beyond which features are taken as that far


@struct.dataclass
class StartNetwork:
    """Weights and biases of layers, and what features are like; NumPy arrays or jax ones."""

    mean: Array | np.ndarray  # (F,), of the features
    deviation: Array | np.ndarray  # (F,)
    weights: tuple[Array | np.ndarray, ...]  # (inputs, outputs) of each layer
    biases: tuple[Array | np.ndarray, ...]  # (outputs,)

    def __call__(self, features: Array) -> Array:
        """What is to be added to a guess, (n,), from features (F,)."""
        cast = functools.partial(jnp.asarray, dtype=features.dtype)
        values = (features - cast(self.mean)) / cast(self.deviation)
        values = jnp.clip(values, -REACH, REACH)
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = jnp.matmul(values, cast(weight), precision=lax.Precision.HIGHEST) + cast(bias)
            if k + 1 < len(self.weights):
                values = jnp.tanh(values)
        return values


def cheaper_start(cost: Callable[[Array], Array], guess: Array, learned: Array) -> Array:
    """A start (n,) that was learnt, or a guess where that costs less."""
    costs = jax.vmap(cost)(jnp.stack([guess, learned]))  # at once, in one program
    return jnp.where(costs[1] < costs[0], learned, guess)


def untrained(
    features: np.ndarray, outputs: int, hidden: tuple[int, ...], seed: int = 0
) -> StartNetwork:
    """A network that adds nothing yet, for features (B, F) of a batch of cases."""
    random = np.random.default_rng(seed)
    sizes = (features.shape[-1], *hidden, outputs)
    weights = [
        random.normal(size=(a, b)) / math.sqrt(a) for a, b in zip(sizes, sizes[1:], strict=False)
    ]
    weights[-1] *= 0.0
    return StartNetwork(
        mean=features.mean(axis=0),
        deviation=np.maximum(features.std(axis=0), 1e-3),
        weights=tuple(each.astype(np.float32) for each in weights),
        biases=tuple(np.zeros(size, np.float32) for size in sizes[1:]),
    )


def to_bytes(network: StartNetwork) -> bytes:
    """A network as an archive of arrays in half precision, which is more than it knows."""
    arrays = {"mean": network.mean, "deviation": network.deviation}
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        arrays |= {f"weight{k}": weight, f"bias{k}": bias}
    file = io.BytesIO()
    rounded: Any = {
        name: np.asarray(array).astype(np.float32 if array.ndim == 1 else np.float16)
        for name, array in arrays.items()
    }
    np.savez_compressed(file, **rounded)
    return file.getvalue()


@functools.cache
def shipped_network(package: str, name: str) -> StartNetwork:
    """The network `name` of a task's package."""
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
