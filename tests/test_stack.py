"""The compatibility layer between the pinned versions of Brax and JAX."""

import jax
import numpy as np

from planner_jax.policies import brax_compat


def test_replicas_are_rows_on_their_devices():
    tree = {"gain": np.arange(3.0, dtype=np.float32), "count": 2}
    replicas = brax_compat.device_put_replicated(tree, jax.local_devices())
    num_devices = jax.local_device_count()
    assert replicas["gain"].shape == (num_devices, 3) and replicas["count"].shape == (num_devices,)
    for shard, device in zip(replicas["gain"].addressable_shards, jax.local_devices(), strict=True):
        assert shard.device == device
        np.testing.assert_array_equal(shard.data[0], tree["gain"])
