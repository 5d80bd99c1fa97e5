"""A GPU kernel that integrates the flights of a batch of balls into tables.

As XLA operations the steps of a flight take about three hundred kernel launches. In this Pallas
kernel each thread integrates one ball, together with the requested derivatives.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PyTree

from planner_jax.ball.flight import BallState, rk4_step
from planner_jax.core.compiled import Treedef
from planner_jax.lanes.pallas import block_width, kernel_by_lanes

_THREADS = 32  # greatest number of threads (balls) in one GPU block
# Indices among the kernel's arguments: position, velocity, times, drag, gravity.
_VEL, _DRAG = 1, 3


def table_kernel(
    num_nodes: int, substeps: int, moving: tuple[int, ...] = (), *, interpret: bool = False
) -> Callable:
    """Build the GPU kernel that computes the states at the nodes of a `FlightTable`.

    Args:
        num_nodes: number N of nodes.
        substeps: number of Runge-Kutta steps between two nodes.
        moving: arguments by which states are differentiated: 1 initial velocity, 3 drag, 4 gravity.
            With () the kernel returns states. Otherwise it returns derivatives: of the positions,
            (N, 3) by each argument, or (N, 3, 3) by the velocity, in the order of `moving`; then of
            the velocities in the same shapes.
        interpret: run the kernel in Pallas's interpreter, without a GPU, for tests.
    """

    def kernel(treedef: Treedef, leaves: Sequence[Array]) -> Sequence[Array] | None:
        pos, _, times, *numbers = leaves
        if pos.ndim != 2 or pos.dtype != jnp.float32 or any(x.ndim != 1 for x in numbers):
            return None
        if times.ndim != 2:
            return None
        lanes = pos.shape[1]
        threads = block_width(lanes, _THREADS)
        if threads is None:
            return None
        return _call(num_nodes, substeps, moving, lanes, threads, interpret)(*leaves)

    return kernel


@dataclasses.dataclass(frozen=True)
class _Direction:
    """One scalar input of a ball's flight, by which the kernel differentiates the ball's states."""

    result: int  # index of the array of results that holds the derivatives by this input
    index: tuple[int, ...]  # component of the velocity (last axis of the array); () for a scalar
    vel: tuple[float, ...]  # (3,) tangent of the velocity at time 0
    numbers: tuple[float, ...]  # (2,) tangents of the scalars drag and gravity


def _directions(moving: tuple[int, ...]) -> list[_Direction]:
    still = (0.0, 0.0)
    units = [tuple(float(j == k) for j in range(3)) for k in range(3)]
    directions = []
    for result, argument in enumerate(moving):
        if argument == _VEL:
            directions += [_Direction(result, (k,), unit, still) for k, unit in enumerate(units)]
        else:
            directions.append(_Direction(result, (), (0.0, 0.0, 0.0), units[argument - _DRAG][:2]))
    return directions


@functools.cache
def _call(
    num_nodes: int,
    substeps: int,
    moving: tuple[int, ...],
    lanes: int,
    threads: int,
    interpret: bool,
) -> Callable:
    directions = _directions(moving)
    shapes = [(num_nodes, 3, 3) if argument == _VEL else (num_nodes, 3) for argument in moving]
    shapes = 2 * (shapes or [(num_nodes, 3)])  # shapes of results: positions, then velocities

    def body(pos, vel, times, drag, gravity, *out):
        numbers = drag[...], gravity[...]
        zero = jnp.zeros_like(numbers[0])

        def full(values: Iterable[ArrayLike]) -> PyTree:  # a vector as a tuple of components
            return tuple(zero + value for value in values)

        def write(node: ArrayLike, ball: BallState, moved: list[BallState]) -> None:
            targets = [(each.result, each.index) for each in directions] or [(0, ())]
            for (result, index), state in zip(targets, moved or [ball], strict=True):
                for k in range(3):
                    out[result][node, k, *index] = state.pos[k]
                    out[result + len(out) // 2][node, k, *index] = state.vel[k]

        def write_and_advance(node: Array, carry: tuple) -> tuple:
            write(node, *carry)
            duration = (times[node + 1] - times[node]) / substeps

            def advance(_: Array, carry: tuple) -> tuple:
                ball, moved = carry

                def step(ball: BallState, *numbers: Array) -> BallState:
                    return rk4_step(ball, duration, *numbers)

                after, push = jax.linearize(step, ball, *numbers)
                pairs = zip(moved, directions, strict=True)
                return after, [push(state, *full(each.numbers)) for state, each in pairs]

            return jax.lax.fori_loop(0, substeps, advance, carry)

        ball = BallState(full(pos[k] for k in range(3)), full(vel[k] for k in range(3)))
        moved = [BallState(full((0.0, 0.0, 0.0)), full(each.vel)) for each in directions]
        write(num_nodes - 1, *jax.lax.fori_loop(0, num_nodes - 1, write_and_advance, (ball, moved)))

    inputs = [(3,), (3,), (num_nodes,), (), ()]
    return kernel_by_lanes(
        body, inputs, shapes, lanes, threads, name="flight_table", interpret=interpret
    )
