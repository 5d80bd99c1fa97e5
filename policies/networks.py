"""Networks of a policy: from what is seen of N targets to an action, and to its value.

All of them map features (..., N, F) to (..., N, 4): the means of an action's two numbers before
their tanh, and what the softplus makes their standard deviations. They are frozen and hashable,
so that a planner may hold one as a static field.
"""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.policies.observation import PER_TARGET

LEAST_STD = 0.03  # of an action before its tanh: a floor, below which nothing is tried any more
_FIRST_STD = 0.15


def _head(features: Array) -> Array:
    """The last layer: no handicap, no stretch, and a standard deviation to begin with."""
    raw = float(np.log(np.expm1(_FIRST_STD - LEAST_STD)))
    first = lambda *_: jnp.repeat(jnp.array([0.0, raw]), PER_TARGET)  # noqa: E731
    return nn.Dense(2 * PER_TARGET, kernel_init=nn.initializers.zeros, bias_init=first)(features)


class Mlp(nn.Module):
    """The paper's: two hidden layers of 64 with ReLU, for up to `size` targets (IV-B)."""

    size: int = 6
    width: int = 64

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Numbers (..., N, 4) of targets (..., N, F); N is at most `size`."""
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
    """Layers in which targets look at each other: whatever their order and number.

    Absent targets are looked at by none.
    """

    width: int = 64
    heads: int = 4
    layers: int = 2

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Numbers (..., N, 4) of targets (..., N, F)."""
        return _head(_attended(self, seen))


class Value(nn.Module):
    """What is to be expected: a layer of attention, and the mean of the present targets."""

    width: int = 64
    heads: int = 4
    layers: int = 1

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Values (...) of targets (..., N, F)."""
        present = seen[..., -1:]
        num = jnp.maximum(jnp.sum(present, axis=-2), 1.0)
        mean = jnp.sum(present * _attended(self, seen), axis=-2) / num
        hidden = nn.relu(nn.Dense(self.width)(mean))
        return nn.Dense(1)(hidden)[..., 0]


def _attended(module: Any, seen: Array) -> Array:
    """Targets (..., N, width) after the layers of attention of a module."""
    present = seen[..., -1] > 0.5
    # A target without any other looks at itself.
    mask = (present[..., None, :] | jnp.eye(seen.shape[-2], dtype=bool))[..., None, :, :]
    hidden = nn.Dense(module.width)(seen)
    for _ in range(module.layers):
        hidden += _looked(module, nn.LayerNorm()(hidden), mask)
        wide = nn.relu(nn.Dense(2 * module.width)(nn.LayerNorm()(hidden)))
        hidden += nn.Dense(module.width)(wide)
    return nn.LayerNorm()(hidden)


def _looked(module: Any, hidden: Array, mask: Array) -> Array:
    """What targets (..., N, width) see where the mask (..., 1, N, N) lets them look.

    Questions, keys and values come from one product: with few targets the number of products is
    what takes the time.
    """
    width, heads = module.width, module.heads
    every = nn.Dense(3 * width)(hidden).reshape(*hidden.shape[:-1], 3, heads, width // heads)
    asked, keys, values = (every[..., k, :, :] for k in range(3))
    weights = nn.dot_product_attention_weights(asked, keys, mask=mask)
    mixed = jnp.einsum("...hqk,...khd->...qhd", weights, values)
    return nn.Dense(width)(mixed.reshape(hidden.shape))


NETWORKS = {"attention": Attention, "mlp": Mlp}
