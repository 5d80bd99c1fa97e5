"""A replacement for `jax.device_put_replicated`, which JAX 0.10 removed and Brax 0.14 calls.

Brax calls this function once when a training starts. `training.train` calls `install()` first, so
that Brax finds the replacement.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec


def device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Copy a pytree to each device, and stack the copies along a new leading axis.

    Each device holds one copy as its shard, because Brax reads a copy back as the first addressable
    shard of every leaf.

    Args:
        tree: pytree of array-likes; a leaf has any shape `(...)`.
        devices: JAX devices in the order of the new axis; at least one.

    Returns:
        The pytree with leaves `(len(devices), ...)`, row i on `devices[i]`.
    """
    sharding = NamedSharding(Mesh(np.asarray(devices), ("replica",)), PartitionSpec("replica"))

    def replicate(leaf):
        leaf = jnp.asarray(leaf)
        return jax.device_put(jnp.broadcast_to(leaf, (len(devices), *leaf.shape)), sharding)

    return jax.tree.map(replicate, tree)


def install() -> None:
    """Set `jax.device_put_replicated` to this replacement if the installed JAX lacks it."""
    if not hasattr(jax, "device_put_replicated"):
        setattr(jax, "device_put_replicated", device_put_replicated)  # noqa: B010
