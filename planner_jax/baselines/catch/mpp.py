"""The `mpp` baseline: sampled state-to-state primitives to catches at a height fixed beforehand."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.ball.flight import BallState, gravity_vector
from planner_jax.ball.target import state_at
from planner_jax.baselines.parts.minimum_jerk import eased_minimum_jerk
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt, outcome, require_settings
from planner_jax.cost.quadrotor import (
    body_rate_excess,
    ground_excess,
    relative,
    speed_excess,
    thrust_excess,
)
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.context import CatchContext, order_targets, targets_at
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.trajectory.polynomial import (
    PiecewisePolynomial,
    evaluate,
    sample_pieces,
    snap_energy,
    total_duration,
)

_BISECTIONS = 30
_SHORTEST = 1e-2  # [s], of a segment
_SLOWEST = 1e-3  # [m/s], of a target whose velocity gives the net's axis


@struct.dataclass
class Candidates:
    """The K primitives that are tried for one segment."""

    trajectory: PiecewisePolynomial  # leaves (K, 2, ...)
    cost: Array  # (K,) mean squared jerk [m^2/s^6]


def falling_time(target, height: Array, horizon: Array, nodes: int) -> tuple[Array, Array]:
    """Time at which a target first falls through a height.

    The first of `nodes` equal intervals at whose ends it is above and below, halved on.

    Args:
        target: one path.
        height: () [m].
        horizon: () [s], until when it is looked at.
        nodes: how many intervals.

    Returns:
        time: () [s]; the horizon where the height is not fallen through until then.
        found: () bool.
    """

    def above(time: Array) -> Array:
        return state_at(target, time).pos[2] > height

    times = horizon * jnp.asarray(np.arange(nodes + 1) / nodes, horizon.dtype)
    high = jax.vmap(above)(times)
    falls = high[:-1] & ~high[1:]
    first = jnp.argmax(falls)

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = 0.5 * (bounds[0] + bounds[1])
        still = above(middle)
        return jnp.where(still, middle, bounds[0]), jnp.where(still, bounds[1], middle)

    early, late = lax.fori_loop(0, _BISECTIONS, halve, (times[first], times[first + 1]))
    found = jnp.any(falls)
    return jnp.where(found, 0.5 * (early + late), horizon), found


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class MppCatch(Planner):
    """The motion primitive planner that [Yu2023catch] compares with; nothing is optimised.

    What is taken from where:

    - [Yu2023catch, Sections V-B and VII-A]: the primitive of least jerk of [Mueller2015] to a catch
      whose height is fixed by hand, below 2 m, so that the target's fall gives time and place;
      velocity and acceleration there are sampled and the primitive of least mean squared jerk is
      kept; limits are only looked at afterwards.
    - Eq. 22: the net's centre at the target. Eq. 25, as the end state is the one thing that
      the paper has this planner check: every sampled acceleration has the net face the target.
    - Assumed, as the paper gives none of it: the height, 1.2 m, about that of the net in
      hover at the start; the grids; the ramp of `eased_minimum_jerk`, without which the body
      rate would jump at time 0 and after every catch; several targets one after the other, in
      the case's order, each where it first falls through the height, and each segment
      kept by its own cost.

    With the limits of `pj.catch.case` it succeeds on four of five `throws` and two of five
    `hard` ones, more on lower catches (0.8 m: 99 % and 51 %) and fewer on higher ones (1.9 m:
    68 % and 27 %), body rate being what it breaks. The paper has it plan 14 % of its throws,
    within limits and at a height that it does not give.

    A target that does not fall through the height before its horizon, or before the one that
    is due earlier does, leaves the lane unsolved: this planner has no other time to offer.

    It does not look at a case's extras; the referee does.
    """

    attempts: ClassVar[tuple[Attempt, ...]] = (Attempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    case_type: ClassVar[type] = CatchCase
    height: float = 1.2  # [m], of the targets at the catches
    speeds: tuple[float, ...] = (-1.0, 0.0, 1.0)  # [m/s], sampled on each axis at a catch
    thrusts: tuple[float, ...] = (0.5, 1.0, 1.5)  # sampled at a catch, over gravity
    ease: float = 0.02  # [s], in which the jerk reaches that of the primitive
    nodes: int = 60  # intervals a piece in which limits are looked at
    time_nodes: int = 128  # intervals of a horizon in which a fall is looked for

    def __post_init__(self) -> None:
        require_settings(self)
        if not 0.0 < self.height < 2.0:
            raise ArgumentError("height", "> 0 and < 2", self.height)
        if not self.speeds or not self.thrusts:
            raise ArgumentError("speeds and thrusts", "an entry", verb="have", shown="none")

    def solve(self, case: CatchCase, attempt: Attempt) -> CatchPlan:
        """The cheapest primitives one after another; no variable is left to decide on.

        Their cost is the mean squared jerk of the whole way.
        """
        context = order_targets(case)
        times, missed = self.times(context)
        balls = targets_at(context.targets, times)
        durations = jnp.maximum(jnp.diff(times, prepend=jnp.zeros_like(times[:1])), _SHORTEST)

        def fly(head: Array, catch: tuple[BallState, Array]) -> tuple[Array, PiecewisePolynomial]:
            best = _cheapest(self.candidates(head, *catch, case))
            return _end_state(best), best

        # Leaves (N, 2, ...): two pieces to each catch.
        _, joined = lax.scan(fly, case.head_state, (balls, durations))
        flown = jnp.where(context.active[:, None], joined.durations, 0.0)
        last = jnp.maximum(jnp.sum(context.active) - 1, 0)
        end = _end_state(_lane(joined, last))[0]
        still = jnp.zeros_like(joined.coeffs).at[:, :, 0].set(end)
        coeffs = jnp.where(context.active[:, None, None, None], joined.coeffs, still)
        trajectory = PiecewisePolynomial(
            coeffs=coeffs.reshape(-1, *coeffs.shape[2:]), durations=flown.ravel()
        )
        excess = jax.vmap(lambda segment: self._excess(segment, case))(joined)
        violation = jnp.max(jnp.where(context.active, jnp.maximum(excess, missed), -1.0))
        energy = jax.vmap(lambda segment: snap_energy(segment, 3))(joined)
        energy = jnp.sum(jnp.where(context.active, energy, 0.0))
        return CatchPlan(
            trajectory=trajectory,
            gravity=case.gravity,
            order=case.order,
            decided_times=case.times,
            times=times,
            **outcome(energy / jnp.maximum(jnp.sum(flown), _SHORTEST), violation),
        )

    def times(self, context: CatchContext) -> tuple[Array, Array]:
        """Times (N,) [s] of the catches, rising, and what is wrong with them, (N,) <= 0 if right.

        The places of absent targets, which come last, have the time of the last catch.
        """
        height = jnp.asarray(self.height, context.horizon.dtype)
        find = lambda target, end: falling_time(target, height, end, self.time_nodes)  # noqa: E731
        fall, found = jax.vmap(find)(context.targets, context.horizon)
        before = jnp.concatenate([jnp.zeros_like(fall[:1]), fall[:-1]])
        # A wrong time makes a short segment, so that what follows stays finite.
        duration = jnp.maximum(fall - before, _SHORTEST)
        times = jnp.cumsum(jnp.where(context.active, duration, 0.0))
        late = jnp.maximum(_SHORTEST - (fall - before), jnp.where(found, -1.0, 1.0))
        return times, late

    def candidates(
        self, head_state: Array, ball: BallState, duration: Array, case: CatchCase
    ) -> Candidates:
        """What is tried for one segment.

        Args:
            head_state: (4, 3), where the segment begins, position to jerk.
            ball: the target at the catch.
            duration: () [s], until then.
            case: for gravity and the net.
        """
        ends = self.end_states(ball, case)
        tried = jax.vmap(eased_minimum_jerk, in_axes=(None, 0, None, None))(
            head_state, ends, duration, self.ease
        )
        cost = jax.vmap(lambda one: snap_energy(one, 3))(tried) / duration
        return Candidates(trajectory=tried, cost=cost)

    def end_states(self, ball: BallState, case: CatchCase) -> Array:
        """The sampled states (K, 3, 3), position to acceleration, at a catch.

        The thrust is straight against the target, or upright for one at rest; the net's centre
        is on the target.
        """
        dtype = ball.pos.dtype
        square = jnp.sum(ball.vel**2)
        moving = square > _SLOWEST**2
        against = -ball.vel / jnp.sqrt(jnp.where(moving, square, 1.0))
        axis = jnp.where(moving, against, jnp.array([0.0, 0.0, 1.0], dtype))
        grid = np.meshgrid(*[self.speeds] * 3, self.thrusts, indexing="ij")
        vx, vy, vz, thrust = (jnp.asarray(g.ravel(), dtype) for g in grid)
        acc = case.gravity * thrust[:, None] * axis + gravity_vector(case.gravity)
        pos = jnp.broadcast_to(ball.pos - case.net.height * axis, acc.shape)
        return jnp.stack([pos, jnp.stack([vx, vy, vz], axis=1), acc], axis=1)

    def _excess(self, segment: PiecewisePolynomial, case: CatchCase) -> Array:
        """Largest excess of one segment, relative, that of the ground in metres, ()."""
        limits = case.limits
        motion = sample_pieces(segment, self.nodes)
        weak, strong = thrust_excess(motion.acc, case.gravity, *limits.thrust_bounds)
        squared = [
            speed_excess(motion.vel, limits),
            body_rate_excess(motion.acc, motion.jerk, case.gravity, limits),
            strong,
        ]
        parts = [relative(jnp.max(jnp.stack(squared))), -relative(-jnp.max(weak))]
        return jnp.max(jnp.stack([*parts, jnp.max(ground_excess(motion.height, limits))]))


def _lane(tree: PyTree, lane: Array) -> PyTree:
    """One entry of the leading axis of every leaf."""
    return jax.tree.map(lambda leaf: leaf[lane], tree)


def _cheapest(candidates: Candidates) -> PiecewisePolynomial:
    """The segment that is kept: two pieces."""
    return _lane(candidates.trajectory, jnp.argmin(candidates.cost))


def _end_state(segment: PiecewisePolynomial) -> Array:
    """Position to jerk (4, 3) where a trajectory ends."""
    end = total_duration(segment)
    return jnp.stack([evaluate(segment, end, order) for order in range(4)])
