"""Neural networks of a policy: the distribution of its actions, and the value of an observation.

A policy network maps features (..., N, F) of N targets to (..., N, 4): the means of the two action
components before tanh, and two numbers whose softplus gives the standard deviations. The modules
are frozen and hashable, so that a planner can hold one as a static field.
"""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.policies.observation import PER_TARGET

LEAST_STD = 0.03  # least standard deviation before tanh, which keeps the policy exploring
_FIRST_STD = 0.15


def _head(features: Array) -> Array:
    """Apply the last layer, which starts at zero means and the standard deviation `_FIRST_STD`."""
    raw = float(np.log(np.expm1(_FIRST_STD - LEAST_STD)))
    first = lambda *_: jnp.repeat(jnp.array([0.0, raw]), PER_TARGET)  # noqa: E731
    return nn.Dense(2 * PER_TARGET, kernel_init=nn.initializers.zeros, bias_init=first)(features)


class Mlp(nn.Module):
    """Two hidden layers of 64 with ReLU, for up to `size` targets [Yu2023catch, Section IV-B]."""

    size: int = 6
    width: int = 64

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Map targets (..., N, F) to parameters (..., N, 4) of actions; N is at most `size`."""
        num = seen.shape[-2]
        if num > self.size:
            raise ValueError(f"this network takes up to {self.size} targets, got {num}")
        width = [(0, 0)] * (seen.ndim - 2) + [(0, self.size - num), (0, 0)]
        hidden = jnp.pad(seen, width).reshape(*seen.shape[:-2], -1)
        for _ in range(2):
            hidden = nn.relu(nn.Dense(self.width)(hidden))
        places = nn.Dense(self.size * self.width)(hidden)
        each = places.reshape(*hidden.shape[:-1], self.size, self.width)
        return _head(nn.relu(each[..., :num, :]))


class Attention(nn.Module):
    """Self-attention over the targets, for any number of targets in any order.

    Absent targets are masked.
    """

    width: int = 64
    heads: int = 4
    layers: int = 2

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Map targets (..., N, F) to parameters (..., N, 4) of actions."""
        return _head(_apply_attention(self, seen))


class Value(nn.Module):
    """The value network: one layer of self-attention, and a mean over the present targets."""

    width: int = 64
    heads: int = 4
    layers: int = 1

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Return the expected rewards (...) of targets (..., N, F)."""
        present = seen[..., -1:]
        num = jnp.maximum(jnp.sum(present, axis=-2), 1.0)
        mean = jnp.sum(present * _apply_attention(self, seen), axis=-2) / num
        hidden = nn.relu(nn.Dense(self.width)(mean))
        return nn.Dense(1)(hidden)[..., 0]


def _apply_attention(module: Any, seen: Array) -> Array:
    """Apply the attention layers of a module; return targets (..., N, width)."""
    present = seen[..., -1] > 0.5
    # The diagonal gives a row something to attend to if no target is present.
    mask = (present[..., None, :] | jnp.eye(seen.shape[-2], dtype=bool))[..., None, :, :]
    hidden = nn.Dense(module.width)(seen)
    for _ in range(module.layers):
        hidden += _attend(module, nn.LayerNorm()(hidden), mask)
        wide = nn.relu(nn.Dense(2 * module.width)(nn.LayerNorm()(hidden)))
        hidden += nn.Dense(module.width)(wide)
    return nn.LayerNorm()(hidden)


def _attend(module: Any, hidden: Array, mask: Array) -> Array:
    """Return the attention output for targets (..., N, width) under a mask (..., 1, N, N).

    One matrix product computes queries, keys and values. With few targets the number of products
    determines the run time.
    """
    width, heads = module.width, module.heads
    every = nn.Dense(3 * width)(hidden).reshape(*hidden.shape[:-1], 3, heads, width // heads)
    queries, keys, values = (every[..., k, :, :] for k in range(3))
    weights = nn.dot_product_attention_weights(queries, keys, mask=mask)
    mixed = jnp.einsum("...hqk,...khd->...qhd", weights, values)
    return nn.Dense(width)(mixed.reshape(hidden.shape))


NETWORKS = {"attention": Attention, "mlp": Mlp}
