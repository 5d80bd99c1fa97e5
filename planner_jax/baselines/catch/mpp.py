"""The baseline `mpp`: catches at a given height by minimum-jerk trajectories to sampled states."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.ball.flight import BallState, gravity_vector
from planner_jax.ball.target import state_at
from planner_jax.baselines.parts.minimum_jerk import minimum_jerk_after_ramp
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.outcome import outcome
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import BaseAttempt, require_settings, take
from planner_jax.cost.quadrotor import relative
from planner_jax.penalties.flight import (
    body_rate_excess,
    ground_excess,
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

_BISECTIONS = 30  # number of bisection steps for the time of a fall
_SHORTEST = 1e-2  # [s], least duration of a segment, the trajectory from one catch to the next
_SLOWEST = 1e-3  # [m/s], below this speed of the target, the net's axis points upwards


@struct.dataclass
class Candidates:
    """K candidate trajectories of one segment, which leads from one catch to the next."""

    trajectory: PiecewisePolynomial  # leaves (K, 2, ...): candidate, polynomial piece
    cost: Array  # (K,) [m^2/s^6], mean squared jerk [Yu2023catch, eq. 14]


def falling_time(target, height: Array, horizon: Array, nodes: int) -> tuple[Array, Array]:
    """Return the time () [s] at which a target first falls through a height, and whether it does.

    The time from 0 to `horizon` () [s] is divided into `nodes` equal intervals. The first interval
    in which the target starts above and ends below the height is bisected. Without such an interval
    the horizon is returned.
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
    """The planner MPP (motion primitives) that [Yu2023catch] compares with; it does not optimise.

    Its parts come from these sources:

    - [Yu2023catch, Sections V-B and VII-A]: a minimum-jerk trajectory (primitive) of [Mueller2015]
      leads to a catch whose height is fixed by hand, below 2 m. Time and position of the catch are
      where the target falls through this height. Velocity and acceleration at the catch are
      sampled, and the primitive of least mean squared jerk is selected. Limits are checked only
      afterwards.
    - [Yu2023catch, eq. 22]: the net's centre is at the target.
    - [Yu2023catch, eq. 25]: the net must face the target. Every sampled acceleration turns the net
      towards the target.
    - Assumptions, since the paper does not report them: the sampled values; the height of 1.2 m,
      about the height of the net at the start; a linear change of the jerk during the first 0.02 s
      of each segment, without which the body rate would jump. Several targets are caught in the
      case's order.

    Success on the suite `throws` (random throws of one ball) is 99, some 80 and 68 % for catches at
    0.8, 1.2 and 1.9 m. On the suite `hard`, with less time, it is 51, some 40 and 27 %. Failures
    exceed the body rate limit. In the paper this planner succeeds on 14 % of the throws; the paper
    reports neither the limits nor the height.

    A case is unsolved if a target does not fall through the height in time, or if it does so
    before the previous target.

    This planner ignores the additional limits of a case (`extras`); the referee checks them.
    """

    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    case_type: ClassVar[type] = CatchCase
    height: float = 1.2  # [m], height of the targets at the catches
    # [m/s], velocity components of the quadrotor that are tried on each axis at a catch.
    speeds: tuple[float, ...] = (-1.0, 0.0, 1.0)
    thrusts: tuple[float, ...] = (0.5, 1.0, 1.5)  # thrusts tried at a catch, in units of gravity
    ease: float = 0.02  # [s], duration of the ramp of the jerk at the start of each segment
    nodes: int = 60  # number of intervals per piece, at whose ends limits are evaluated
    time_nodes: int = 128  # number of intervals of a horizon that are searched for a fall

    def __post_init__(self) -> None:
        require_settings(self)
        require(0.0 < self.height < 2.0, "height", "> 0 and < 2", self.height)
        if not self.speeds or not self.thrusts:
            raise ArgumentError("speeds and thrusts", "an entry", verb="have", shown="none")

    def solve(self, case: CatchCase, attempt: BaseAttempt) -> CatchPlan:
        """Return the plan of one case: from catch to catch, the cheapest candidate trajectory.

        The plan's cost is the mean squared jerk of the whole trajectory.
        """
        context = order_targets(case)
        times, missed = self.times(context)
        balls = targets_at(context.targets, times)
        durations = jnp.maximum(jnp.diff(times, prepend=jnp.zeros_like(times[:1])), _SHORTEST)

        def fly(head: Array, catch: tuple[BallState, Array]) -> tuple[Array, PiecewisePolynomial]:
            tried = self.candidates(head, *catch, case)
            best = take(tried.trajectory, jnp.argmin(tried.cost))
            return _end_state(best), best

        # Leaves have shape (N, 2, ...): two polynomial pieces lead to each of the N catches.
        _, joined = lax.scan(fly, case.head_state, (balls, durations))
        durations_flown = jnp.where(context.active[:, None], joined.durations, 0.0)
        last = jnp.maximum(jnp.sum(context.active) - 1, 0)
        end = _end_state(take(joined, last))[0]
        still = jnp.zeros_like(joined.coeffs).at[:, :, 0].set(end)
        coeffs = jnp.where(context.active[:, None, None, None], joined.coeffs, still)
        trajectory = PiecewisePolynomial(
            coeffs=coeffs.reshape(-1, *coeffs.shape[2:]), durations=durations_flown.ravel()
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
            **outcome(energy / jnp.maximum(jnp.sum(durations_flown), _SHORTEST), violation),
        ).with_heading(case)

    def times(self, context: CatchContext) -> tuple[Array, Array]:
        """Return increasing catching times (N,) [s] of N targets, and their violations (N,).

        A target is caught when it falls through the height `self.height`. The violation is
        positive if the target falls too soon after the previous target, by the lacking time [s],
        or at least 1 if it does not fall. Absent targets have the time of the last catch.
        """
        height = jnp.asarray(self.height, context.horizon.dtype)
        find = lambda target, end: falling_time(target, height, end, self.time_nodes)  # noqa: E731
        fall, found = jax.vmap(find)(context.targets, context.horizon)
        before = jnp.concatenate([jnp.zeros_like(fall[:1]), fall[:-1]])
        # A catch comes `_SHORTEST` [s] after the previous catch if its target falls earlier.
        duration = jnp.maximum(fall - before, _SHORTEST)
        times = jnp.cumsum(jnp.where(context.active, duration, 0.0))
        late = jnp.maximum(_SHORTEST - (fall - before), jnp.where(found, -1.0, 1.0))
        return times, late

    def candidates(
        self, head_state: Array, ball: BallState, duration: Array, case: CatchCase
    ) -> Candidates:
        """Return candidate trajectories of the segment that ends with the catch of `ball`.

        The segment starts at `head_state` (4, 3), which has position, velocity, acceleration and
        jerk, and lasts `duration` () [s].
        """
        ends = self.end_states(ball, case)
        tried = jax.vmap(minimum_jerk_after_ramp, in_axes=(None, 0, None, None))(
            head_state, ends, duration, self.ease
        )
        cost = jax.vmap(lambda one: snap_energy(one, 3))(tried) / duration
        return Candidates(trajectory=tried, cost=cost)

    def end_states(self, ball: BallState, case: CatchCase) -> Array:
        """Return K sampled states at a catch, (K, 3, 3): position, velocity and acceleration.

        The thrust points against the target's velocity, or upwards if the target stands still. The
        net's centre is at the target.
        """
        dtype = ball.pos.dtype
        square = jnp.sum(ball.vel**2)
        moving = square > _SLOWEST**2
        against = -ball.vel / jnp.sqrt(jnp.where(moving, square, 1.0))
        axis = jnp.where(moving, against, jnp.array([0.0, 0.0, 1.0], dtype))
        grid = np.meshgrid(*[self.speeds] * 3, self.thrusts, indexing="ij")
        vx, vy, vz, thrust = (jnp.asarray(g.ravel(), dtype) for g in grid)
        acc = case.gravity * thrust[:, None] * axis[None] + gravity_vector(case.gravity)[None]
        pos = jnp.broadcast_to(ball.pos - case.net.height * axis, acc.shape)
        return jnp.stack([pos, jnp.stack([vx, vy, vz], axis=1), acc], axis=1)

    def _excess(self, segment: PiecewisePolynomial, case: CatchCase) -> Array:
        limits = case.limits
        motion = sample_pieces(segment, self.nodes)
        weak, strong = thrust_excess(motion.acc, case.gravity, *limits.thrust_bounds)
        squared = [
            speed_excess(motion.vel, limits.speed),
            body_rate_excess(motion.acc, motion.jerk, case.gravity, limits.body_rate),
            strong,
        ]
        parts = [relative(jnp.max(jnp.stack(squared))), -relative(-jnp.max(weak))]
        return jnp.max(
            jnp.stack([*parts, jnp.max(ground_excess(motion.height, limits.min_height))])
        )


def _end_state(segment: PiecewisePolynomial) -> Array:
    """Return position, velocity, acceleration and jerk (4, 3) at the end of a trajectory."""
    end = total_duration(segment)
    return jnp.stack([evaluate(segment, end, order) for order in range(4)])
