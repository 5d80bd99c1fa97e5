"""The baseline `juggle`: a minimum-jerk trajectory to a hit that is chosen without optimisation."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from planner_jax.ball.flight import solve_impact
from planner_jax.ball.flight_table import FlightTable
from planner_jax.baselines.hit.common import largest_violation, make_impact, motion_excess
from planner_jax.baselines.parts.minimum_jerk import minimum_jerk_after_ramp
from planner_jax.core.outcome import outcome
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import BaseAttempt, require_settings
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.context import HitContext, Impact, prepare_hit
from planner_jax.task.hit.plan import HitPlan
from planner_jax.trajectory.polynomial import sample_pieces, snap_energy

_BISECTIONS = 30  # number of bisection steps for the time of the fall
_SHORTEST = 1e-2  # [s], least duration of a trajectory
_LEAST_UPRIGHT = 1e-2  # least vertical component of the racket's normal, which is a divisor


def falling_time(path: FlightTable, height: Array, earliest: Array, latest: Array) -> Array:
    """Return the time () [s] at which the ball falls through a height.

    Bisection is followed by one Newton step, and only this step is differentiated. If the ball does
    not cross the height between `earliest` and `latest`, the result is next to one of these times.

    Args:
        path: tabulated trajectory of the ball.
        height: () [m].
        earliest: () [s], lower bound, when the ball is above `height`.
        latest: () [s], upper bound, when the ball is below `height`.
    """

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = 0.5 * (bounds[0] + bounds[1])
        above = path.at(middle).pos[2] > height
        return jnp.where(above, middle, bounds[0]), jnp.where(above, bounds[1], middle)

    earliest, latest = lax.fori_loop(0, _BISECTIONS, halve, (earliest, latest))
    time = lax.stop_gradient(0.5 * (earliest + latest))
    ball = path.at(time)
    missing = ball.pos[2] - height
    crossed = jnp.abs(missing) < 1e-2
    sinking = lax.stop_gradient(jnp.minimum(ball.vel[2], -0.1))
    return time - jnp.where(crossed, missing, 0.0) / sinking


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class JuggleHit(Planner):
    """The "Juggle" of [Yu2023bat]: a minimum-jerk trajectory (primitive) to a predetermined hit.

    Its parts come from these sources:

    - [Mueller2011] and [Dong2015]: the ball is hit where it falls through a fixed height. The
      returned ball rises to a fixed apex. Two components of the racket's velocity are fixed, and
      the third follows from the impact.
    - [Mueller2015]: the primitive of least jerk to that state.
    - [Yu2023bat]: eqs 11-12 (the racket's normal and its speed along the normal), eqs 15-17 (the
      primitive), and a vertical thrust of 1.1 times gravity at the impact.
    - The published trials: at every recorded hit the quadrotor's horizontal velocity is zero, and
      its height is 1.43 to 1.50 m. The ball's apex after the hit is 2.3 m in the median, computed
      from attitude and target without drag.
    - Assumption: the jerk changes linearly for 0.02 s, or else the body rate would jump at time 0.

    With the coefficient of restitution 0.7 of [Yu2023bat] this planner succeeds on two of three
    serves, and the published planner on one of ten. The recorded hits imply a coefficient near
    0.32, with which the racket has to rise at 3 m/s at the impact instead of almost standing still.
    With 0.32 this planner also succeeds on one of ten serves.

    This planner ignores the additional limits of a case (`extras`); the referee checks them.
    """

    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    case_type: ClassVar[type] = HitCase
    height: float = 1.5  # [m], height of the ball at the impact
    apex: float = 2.3  # [m], height to which the returned ball rises
    thrust_z: float = 1.1  # vertical thrust at the impact, divided by gravity
    racket_vel_xy: tuple[float, float] = (0.0, 0.0)  # [m/s], of the quadrotor at the impact
    ease: float = 0.02  # [s], duration of the ramp of the jerk at the start
    nodes: int = 240  # number of intervals per piece, at whose ends limits are evaluated

    def __post_init__(self) -> None:
        require_settings(self)

    def solve(self, case: HitCase, attempt: BaseAttempt) -> HitPlan:
        """Return the plan that leads to the predetermined hit; nothing is optimised.

        The plan's cost is the mean squared jerk [Yu2023bat, eq. 15].
        """
        impact = self.impact(prepare_hit(case))
        trajectory = minimum_jerk_after_ramp(
            case.head_state, impact.tail_state[:3], impact.stroke.time, self.ease
        )
        motion = sample_pieces(trajectory, self.nodes)
        along = jnp.stack(motion_excess(motion, case.gravity, case.limits))
        # A height or apex that the ball cannot reach is a violation, as is a vertical racket face.
        meeting = jnp.abs(impact.stroke.ball_pos[2] - self.height)
        too_low = jnp.maximum(impact.stroke.ball_pos[2], case.target[2]) - self.apex
        lying = _LEAST_UPRIGHT - impact.stroke.normal[2]
        missed = jnp.maximum(jnp.maximum(meeting, too_low) - 1e-3, lying)
        violation = jnp.maximum(largest_violation(along, impact, case), missed)
        mean_jerk = snap_energy(trajectory, 3) / impact.stroke.time
        return HitPlan(
            trajectory=trajectory,
            gravity=case.gravity,
            stroke=impact.stroke,
            **outcome(mean_jerk, violation),
        ).with_heading(case)

    def impact(self, context: HitContext) -> Impact:
        """Return the hit where the ball falls through the fixed height.

        A ball that never falls through `height` is hit where it comes closest to that height.
        """
        case, path = context.case, context.path
        gravity = case.gravity
        highest = jnp.maximum(case.ball.vel[2], 0.0) / gravity
        latest = jnp.maximum(context.landing_time, highest)
        height = jnp.asarray(self.height, gravity.dtype)
        time = jnp.maximum(falling_time(path, height, highest, latest), _SHORTEST)
        ball = path.at(time)
        rise = jnp.sqrt(2.0 * gravity * jnp.maximum(self.apex - ball.pos[2], 1e-3))
        fall = jnp.sqrt(2.0 / gravity * jnp.maximum(self.apex - case.target[2], 1e-3))
        flight_time = rise / gravity + fall
        across = (case.target - ball.pos)[:2] / flight_time
        after = jnp.concatenate([across, rise[None]])
        normal, normal_speed = solve_impact(ball.vel, after, case.restitution)
        upright = jnp.maximum(normal[2], _LEAST_UPRIGHT)
        fixed = jnp.asarray(self.racket_vel_xy, rise.dtype)
        vel_z = (normal_speed - jnp.sum(fixed * normal[:2])) / upright
        racket_vel = jnp.concatenate([fixed, vel_z[None]])
        thrust = self.thrust_z * gravity / upright * normal
        return make_impact(time, flight_time, ball, after, racket_vel, thrust, case)
