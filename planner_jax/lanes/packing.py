"""The arrays of many lanes (problems of a batch) as rows, to gather and scatter lanes at once."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree


class Packing:
    """The arrays of one lane as one vector for each data type, which is gathered at once."""

    def __init__(self, lane: PyTree) -> None:
        leaves, self._tree = jax.tree.flatten(lane)
        self._shapes = [leaf.shape for leaf in leaves]
        self._kinds = [np.dtype(leaf.dtype) for leaf in leaves]
        self._types = sorted(set(self._kinds), key=str)

    def zeros(self, num: int) -> list[Array]:
        """Return the vectors of `num` lanes of zeros: a list of arrays (num, size)."""
        sizes = dict.fromkeys(self._types, 0)
        for kind, shape in zip(self._kinds, self._shapes, strict=True):
            sizes[kind] += math.prod(shape)
        return [jnp.zeros((num, size), kind) for kind, size in sizes.items()]

    def pack(self, lanes: PyTree) -> list[Array]:
        """Return the vectors (lanes, size) of arrays with the lanes last."""
        triples = zip(self._kinds, self._shapes, jax.tree.leaves(lanes), strict=True)
        pairs = [(kind, x.reshape(math.prod(shape), x.shape[-1])) for kind, shape, x in triples]
        return [jnp.concatenate([x for k, x in pairs if k == own]).T for own in self._types]

    def unpack(self, vectors: list[Array]) -> PyTree:
        """Return arrays with the lanes last from their vectors (lanes, size)."""
        columns = {own: vector.T for own, vector in zip(self._types, vectors, strict=True)}
        done, leaves = dict.fromkeys(self._types, 0), []
        for kind, shape in zip(self._kinds, self._shapes, strict=True):
            begin, done[kind] = done[kind], done[kind] + math.prod(shape)
            part = columns[kind][begin : done[kind]]
            leaves.append(part.reshape(*shape, part.shape[1]))
        return jax.tree.unflatten(self._tree, leaves)
