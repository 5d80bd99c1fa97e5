"""Flights with quadratic drag between two points: velocities at both ends, and the apex.

A flight without wind stays in a vertical plane. In units of its duration T, the share of the
horizontal distance r has the rate a, and the height has the rate w [m]. With the speed
s = sqrt(r^2 a^2 + w^2) [m], drag K_D [1/m] and c = g T^2 [m], the rates follow

    da/dt = -K_D s a,    dw/dt = -c - K_D s w.

For a known speed s(t) these equations are linear, and E = exp(-K_D integral s) solves them:
a = a_0 E and w = E (w_0 - c integral 1/E). The initial rates a_0 and w_0 follow from the ends of
the flight. The solver alternates between the rates and the speed. Gauss's quadrature integrates
the climb and the fall separately, because the speed may have a kink at the apex.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from planner_jax.core.arithmetic import reciprocal
from planner_jax.lanes.kernels import is_on_gpu

_NODES = 5  # number of nodes of the climb, and of the fall
_ITERATIONS = 3  # number of times that the speed is computed from the rates
_FIRST = 4  # the same before those iterations, if the drag is strong
# Greatest product of drag and greatest speed without drag, [m] per flight time, of weak drag: the
# iterations without `_FIRST` then miss the target by no more than the quadrature does.
_WEAK = 0.5


def fly_between(
    pos: Array, target: Array, flight_time: Array, drag: Array, gravity: Array
) -> tuple[Array, Array, Array]:
    """Return the flight of a ball with quadratic drag from `pos` to `target`, both (3,) [m].

    With the product N of drag, initial speed and flight time, flights of up to 3 s miss the target
    by less than 0.3 mm up to N = 3, by 0.6 mm up to N = 10, and by 4 mm up to N = 30. Derivatives
    are computed in forward mode, and store no intermediate values.

    Args:
        pos: (3,) [m], position at the start.
        target: (3,) [m], position after the flight time.
        flight_time: () [s], > 0.
        drag: () K_D [1/m], >= 0.
        gravity: () [m/s^2], magnitude > 0.

    Returns:
        Velocities (3,) [m/s] at the start and at the target, and the greatest height () [m].
    """
    way = target - pos
    numbers = jnp.sum(way[:2] ** 2), way[2], gravity * flight_time**2, drag
    arc = _arc(*map(jnp.asarray, numbers))
    pace = reciprocal(flight_time)
    velocity = lambda a, w: jnp.stack([way[0] * a, way[1] * a, w]) * pace  # noqa: E731
    return velocity(arc[0], arc[1]), velocity(arc[2], arc[3]), pos[2] + arc[4]


@jax.custom_jvp
def _arc(square: Array, rise: Array, fall: Array, drag: Array) -> Array:
    return _solve(square, rise, fall, drag)


def _arc_jvp(primals: Sequence[Array], tangents: Sequence) -> tuple[Array, Array]:
    moving = [k for k, each in enumerate(tangents) if not isinstance(each, SymbolicZero)]
    slopes = jax.jacfwd(_solve, moving)(*primals)
    changes = [slope * tangents[k] for k, slope in zip(moving, slopes, strict=True)]
    return _arc(*primals), sum(changes[1:], changes[0])


_arc.defjvp(_arc_jvp, symbolic_zeros=True)


def _solve(square: Array, rise: Array, fall: Array, drag: Array) -> Array:
    """Return the rates (a_0, w_0, a_1, w_1) at both ends and the apex's height (), together (5,).

    `square` is the squared horizontal distance [m^2], `rise` the height of the target [m], and
    `fall` is c = g T^2 [m].
    """
    nodes, integrals = (jnp.asarray(each, rise.dtype) for each in _quadrature())

    def integrate(values: Array, lengths: Array) -> Array:
        """Return integrals of values (2, N) from 0 to the nodes and the end of each part."""
        within = lengths[:, None] * jnp.sum(integrals[None] * values[:, None, :], axis=2)
        return within + jnp.stack([jnp.zeros_like(rise), within[0, -1]])[:, None]

    def divide(top: Array) -> tuple[Array, Array]:
        """Return the lengths (2,) of climb and fall, and the times (2, N) of their nodes."""
        lengths, begins = jnp.stack([top, 1.0 - top]), jnp.stack([jnp.zeros_like(top), top])
        return lengths, lengths[:, None] * nodes[None] + begins[:, None]

    def speed_of(across: Array, upward: Array) -> Array:
        return jnp.sqrt(jnp.maximum(square * across**2 + upward**2, 1e-12))

    def rates_of(speed: Array, lengths: Array) -> tuple[Array, ...]:
        """Return a_0 and w_0 at the start, and a and w (2, N + 1) at nodes and ends of parts."""
        kept = jnp.exp(-drag * integrate(speed, lengths))
        fallen = fall * integrate(1.0 / kept[:, :-1], lengths)
        across = 1.0 / integrate(kept[:, :-1], lengths)[1, -1]
        upward = across * (rise + integrate((kept * fallen)[:, :-1], lengths)[1, -1])
        return across, upward, kept * across, kept * (upward - fallen)

    def improve(top: Array, speed: Array) -> tuple[Array, Array]:
        """Return the time of the apex and the speed at the nodes (2, N) by the speed before."""
        lengths, times = divide(top)
        _, _, across, upward = rates_of(speed, lengths)
        top = jnp.clip(top + upward[0, -1] / fall, 0.0, 1.0)
        shift = divide(top)[1] - times
        brake = 1.0 - drag * speed * shift
        return top, speed_of(across[:, :-1] * brake, upward[:, :-1] * brake - fall * shift)

    top = jnp.clip(0.5 + rise / fall, 0.0, 1.0)  # time of the apex in units of T
    times = divide(top)[1]
    speed = speed_of(jnp.ones_like(times), rise + fall * (0.5 - times))
    top, speed = _repeat_first(improve, drag, top, speed)
    for _ in range(_ITERATIONS):
        top, speed = improve(top, speed)
    lengths, _ = divide(top)
    *first, across, upward = rates_of(speed, lengths)
    climb = integrate(upward[:, :-1], lengths)[0, -1]
    return jnp.stack([*first, across[1, -1], upward[1, -1], climb])


def _repeat_first(
    improve: Callable[[Array, Array], tuple[Array, Array]], drag: Array, top: Array, speed: Array
) -> tuple[Array, Array]:
    """Return time of the apex and speed after `_FIRST` iterations; on a CPU only if they help."""
    is_strong = drag * jnp.max(speed) > _WEAK
    found = top, speed
    if not is_on_gpu():
        last = jnp.where(is_strong, _FIRST, 0)
        advance = lambda state: (state[0] + 1, *improve(*state[1:]))  # noqa: E731
        state = lax.while_loop(lambda s: s[0] < last, advance, (jnp.zeros_like(last), *found))
        return state[1], state[2]
    # On a GPU the host would wait for every test whether the loop has ended.
    for k in range(_FIRST):
        found = improve(*(lax.stop_gradient(found) if k < _FIRST - 1 else found))
    pairs = zip(found, (top, speed), strict=True)
    top, speed = (jnp.where(is_strong, later, first) for later, first in pairs)
    return top, speed


@functools.cache
def _quadrature() -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss's nodes (N,) in [0, 1], and matrix (N + 1, N) of integrals to nodes and 1."""
    nodes = 0.5 * (np.polynomial.legendre.leggauss(_NODES)[0] + 1.0)
    powers = np.arange(_NODES)
    ends = np.append(nodes, 1.0)[:, None] ** (powers + 1) / (powers + 1)
    return nodes, ends @ np.linalg.inv(nodes[:, None] ** powers)
