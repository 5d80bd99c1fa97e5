"""The table of a ball in flight on many lanes as one kernel for CUDA, in Pallas' Triton.

A step needs the one before it. As operations of their own the steps of a table are some three
hundred launches, which a small batch waits for; here a thread flies a ball to the end.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.ball.flight import BallState, rk4_step
from planner_jax.lanes import block_width

_THREADS = 32  # lanes of a block


def table_kernel(num_nodes: int, *, interpret: bool = False) -> Callable:
    """What `lanes.with_kernel` takes for the states at the nodes of a `PathTable`.

    Args:
        num_nodes: N.
        interpret: run it without a GPU, for tests.
    """

    def kernel(treedef: Any, leaves: Sequence[Array]) -> list[Array] | None:
        pos, _, *numbers = leaves
        if pos.ndim != 2 or pos.dtype != jnp.float32 or any(x.ndim != 1 for x in numbers):
            return None
        lanes = pos.shape[1]
        threads = block_width(lanes, _THREADS)
        if threads is None:
            return None
        return _call(num_nodes, lanes, threads, interpret)(*leaves)

    return kernel


@functools.cache
def _call(num_nodes: int, lanes: int, threads: int, interpret: bool) -> Callable:
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    def body(pos, vel, resolution, drag, gravity, pos_out, vel_out):
        step, drag, gravity = resolution[...], drag[...], gravity[...]
        vectors: Any = {
            "pos": tuple(pos[k] for k in range(3)),
            "vel": tuple(vel[k] for k in range(3)),
        }
        ball = BallState(**vectors)

        def write(node: Any, state: Any) -> None:
            for k in range(3):
                pos_out[node, k], vel_out[node, k] = state.pos[k], state.vel[k]

        def advance(node: Array, state: BallState) -> BallState:
            write(node, state)
            return rk4_step(state, step, drag, gravity)

        write(0, rk4_step(ball, -step, drag, gravity))
        write(num_nodes - 1, jax.lax.fori_loop(1, num_nodes - 1, advance, ball))

    vector = pl.BlockSpec((3, threads), lambda i: (0, i))
    number = pl.BlockSpec((threads,), lambda i: (i,))
    nodes = pl.BlockSpec((num_nodes, 3, threads), lambda i: (0, 0, i))
    shape = jax.ShapeDtypeStruct((num_nodes, 3, lanes), jnp.float32)
    return pl.pallas_call(
        body,
        out_shape=[shape, shape],
        grid=(lanes // threads,),
        in_specs=[vector, vector, number, number, number],
        out_specs=[nodes, nodes],
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="flight_table",
    )
