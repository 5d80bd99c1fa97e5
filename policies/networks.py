"""Neural networks for decisions about catches: policy networks and a value network, in Flax.

A policy network maps features (..., N, F), F for each of N targets, to the parameters (..., N, 4)
of a normal distribution of actions. An action is the tanh of a sample, and has two components per
target. The first two parameters are means, and the softplus of the other two gives standard
deviations. `PublishedMlp` has another observation and action. The networks are immutable and
hashable, so that a JAX pytree can hold one as a static field.
"""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.policies.observation import FEATURES, PER_TARGET
from planner_jax.policies.settings import PUBLISHED

LEAST_STD = 0.03  # least standard deviation of actions before tanh; it ensures exploration
_FIRST_STD = 0.15  # standard deviation of actions before tanh at the start of training


def _head(features: Array) -> Array:
    raw = float(np.log(np.expm1(_FIRST_STD - LEAST_STD)))
    first = lambda *_: jnp.repeat(jnp.array([0.0, raw]), PER_TARGET)  # noqa: E731
    return nn.Dense(2 * PER_TARGET, kernel_init=nn.initializers.zeros, bias_init=first)(features)


class Mlp(nn.Module):
    """A policy network of dense layers, for at most `size` targets [Yu2023catch, Section IV-B]."""

    size: int = 6  # greatest number of targets
    width: int = 64  # number of units in each hidden layer

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Map F features of each of N targets to distribution parameters (..., N, 4) of actions.

        Raises:
            ValueError: there are more than `size` targets.
        """
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
    """A policy network of self-attention over any number of targets; absent targets are masked."""

    width: int = 64  # number of features of each target within the network
    heads: int = 4  # number of attention heads
    layers: int = 2

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Map F features of each of N targets to distribution parameters (..., N, 4) of actions."""
        return _head(_apply_attention(self, seen))


class PublishedMlp(nn.Module):
    """The policy network of [Yu2023catch, Section IV-B]: two layers of 64 units with ReLU.

    The action has a normal distribution [Yu2023catch, eq. 7b], whose standard deviation does not
    depend on the observation.
    """

    size: int = 1  # number N of targets
    width: int = 64  # number of units in each hidden layer

    @property
    def features(self) -> int:
        """Number of features of a case: the length of its observation."""
        return 10 + 6 * self.size

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Map observations (..., 10 + 6 N) to mean (N) and logarithm (N) of the deviation."""
        mean = nn.Dense(self.size)(_apply_relu_layers(self.width, seen))
        log_std = self.param("log_std", nn.initializers.constant(np.log(0.5)), (self.size,))
        return jnp.concatenate([mean, jnp.broadcast_to(log_std, mean.shape)], axis=-1)


class PublishedValue(nn.Module):
    """The value network of the published policy, with hidden layers like `PublishedMlp`."""

    width: int = 64  # number of units in each hidden layer

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Return the expected reward (...) of each case, from observations (..., 10 + 6 N)."""
        return nn.Dense(1)(_apply_relu_layers(self.width, seen))[..., 0]


def _apply_relu_layers(width: int, hidden: Array) -> Array:
    for _ in range(2):
        hidden = nn.relu(nn.Dense(width)(hidden))
    return hidden


class Value(nn.Module):
    """The value network of PPO: self-attention over targets, then a mean over present targets."""

    width: int = 64  # number of features of each target within the network
    heads: int = 4  # number of attention heads
    layers: int = 1

    @nn.compact
    def __call__(self, seen: Array) -> Array:
        """Return the expected reward (...) of each case, from features (..., N, F) of N targets."""
        present = seen[..., -1:]
        num = jnp.maximum(jnp.sum(present, axis=-2), 1.0)
        mean = jnp.sum(present * _apply_attention(self, seen), axis=-2) / num
        hidden = nn.relu(nn.Dense(self.width)(mean))
        return nn.Dense(1)(hidden)[..., 0]


def _apply_attention(module: Any, seen: Array) -> Array:
    present = seen[..., -1] > 0.5
    # Each target attends to itself even if it is absent. A row of the mask that is false everywhere
    # would give NaN.
    mask = (present[..., None, :] | jnp.eye(seen.shape[-2], dtype=bool))[..., None, :, :]
    hidden = nn.Dense(module.width)(seen)
    for _ in range(module.layers):
        hidden += _attend(module, nn.LayerNorm()(hidden), mask)
        wide = nn.relu(nn.Dense(2 * module.width)(nn.LayerNorm()(hidden)))
        hidden += nn.Dense(module.width)(wide)
    return nn.LayerNorm()(hidden)


def _attend(module: Any, hidden: Array, mask: Array) -> Array:
    """Apply multi-head attention to the features of targets, under a mask (target, target).

    One matrix product computes queries, keys and values together. The matrices are so small that
    the run time depends on the number of products rather than on their sizes.
    """
    width, heads = module.width, module.heads
    every = nn.Dense(3 * width)(hidden).reshape(*hidden.shape[:-1], 3, heads, width // heads)
    queries, keys, values = (every[..., k, :, :] for k in range(3))
    weights = nn.dot_product_attention_weights(queries, keys, mask=mask)
    mixed = jnp.einsum("...hqk,...khd->...qhd", weights, values)
    return nn.Dense(width)(mixed.reshape(hidden.shape))


NETWORKS = {"attention": Attention, "mlp": Mlp}
KINDS = {**NETWORKS, PUBLISHED: PublishedMlp}  # networks of the extended and the published policy


def num_features(network: Any) -> int:
    """Return the number of input features of a network: of each target, or of the whole case."""
    return network.features if isinstance(network, PublishedMlp) else FEATURES
