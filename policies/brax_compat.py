"""Gives Brax 0.14's training loops the one function that JAX has dropped since 0.10.

`brax.training` calls `jax.device_put_replicated` when training starts (PPO, SAC and APG alike)
and nothing else that is gone. Call `install()` once, before the first `train`.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec


def device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """One copy of a pytree on each device, stacked along a new leading axis.

    The stack has to be sharded, not merely stacked: Brax reads a replica back as the first
    addressable shard of every leaf.

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
    """Sets `jax.device_put_replicated` where this JAX has none; otherwise changes nothing."""
    if not hasattr(jax, "device_put_replicated"):
        setattr(jax, "device_put_replicated", device_put_replicated)  # noqa: B010
