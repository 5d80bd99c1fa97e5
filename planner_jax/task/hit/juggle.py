"""The `juggle` baseline: one state-to-state primitive to a stroke that is fixed beforehand."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.ball.impact import required_impact
from planner_jax.ball.prediction import PathTable, target_at
from planner_jax.cost.limits import motion_excess
from planner_jax.optimise.lbfgs import Evaluation, LbfgsConfig
from planner_jax.optimise.problem import Round
from planner_jax.task.hit.baseline import largest_violation, make_impact, undecided_plan
from planner_jax.task.hit.exact import HitContext, Impact, prepare_hit
from planner_jax.task.hit.plan import HitPlan
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.trajectory.minimum_jerk import minimum_jerk
from planner_jax.trajectory.polynomial import (
    Motion,
    PiecewisePolynomial,
    derivative_factors,
    snap_energy,
)

_BISECTIONS = 30
_SHORTEST = 1e-2  # [s], of a trajectory
_LEAST_UPRIGHT = 1e-2  # vertical part of the racket's normal, by which v_z is divided


def falling_time(path: PathTable, height: Array, earliest: Array, latest: Array) -> Array:
    """Time at which the target falls through a height.

    Bisection, then a step of Newton's method, which alone is differentiated.

    Args:
        path: of the target.
        height: () [m].
        earliest: () [s], when the target is above `height`.
        latest: () [s], when it is below.

    Returns:
        () [s]; next to one of the bounds where the height is not crossed between them.
    """

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = 0.5 * (bounds[0] + bounds[1])
        above = target_at(path, middle).pos[2] > height
        return jnp.where(above, middle, bounds[0]), jnp.where(above, bounds[1], middle)

    earliest, latest = lax.fori_loop(0, _BISECTIONS, halve, (earliest, latest))
    time = lax.stop_gradient(0.5 * (earliest + latest))
    ball = target_at(path, time)
    missing = ball.pos[2] - height
    crossed = jnp.abs(missing) < 1e-2
    sinking = lax.stop_gradient(jnp.minimum(ball.vel[2], -0.1))
    return time - jnp.where(crossed, missing, 0.0) / sinking


def eased_minimum_jerk(
    head_state: Array, tail_state: Array, duration: Array, ease: float
) -> PiecewisePolynomial:
    """The minimum-jerk primitive, its first jerk reached by a ramp and not at once.

    The primitive begins with a jerk that a hovering quadrotor does not have: its body rate
    would jump. Here the jerk first runs in a straight line from its value at the head to the
    one that the primitive begins with, which starts from where the ramp has led. That jerk J
    is the root of J = first jerk of the primitive after a ramp to J, affine in J.

    Args:
        head_state: (4, 3), jerk included.
        tail_state: (3, 3) position, velocity, acceleration.
        duration: () [s] > 0, of ramp and primitive together.
        ease: [s] > 0, of the ramp, but at most half of `duration`.

    Returns:
        Two pieces of degree 5 that join up to the jerk.
    """
    t = jnp.minimum(ease, 0.5 * duration)
    p0, v0, a0, j0 = head_state

    def primitive(jerk: Array) -> PiecewisePolynomial:
        ramp_end = jnp.stack(
            [
                p0 + v0 * t + a0 * t**2 / 2.0 + (3.0 * j0 + jerk) * t**3 / 24.0,
                v0 + a0 * t + (2.0 * j0 + jerk) * t**2 / 6.0,
                a0 + (j0 + jerk) * t / 2.0,
            ]
        )
        return minimum_jerk(ramp_end, tail_state, duration - t)

    def first_jerk(jerk: Array) -> Array:
        return 6.0 * primitive(jerk).coeffs[0, 3]

    constant = first_jerk(jnp.zeros_like(j0))
    # By differences this would be lost in rounding: the two are a thousand times as large.
    share = t / (duration - t)
    slope = -share * (4.5 + share * (6.0 + 2.5 * share))
    jerk = constant / (1.0 - slope)
    ramp = jnp.stack([p0, v0, a0 / 2.0, j0 / 6.0, (jerk - j0) / (24.0 * t), jnp.zeros_like(p0)])
    after = primitive(jerk)
    return PiecewisePolynomial(
        coeffs=jnp.concatenate([ramp[None], after.coeffs]),
        durations=jnp.concatenate([t[None], after.durations]),
    )


def sample_pieces(trajectory: PiecewisePolynomial, nodes: int) -> Motion:
    """Motion at both ends and inside of every piece, `nodes` intervals each, pieces in a row."""
    coeffs, degree = trajectory.coeffs, trajectory.coeffs.shape[1] - 1
    fractions = jnp.asarray(np.arange(nodes + 1) / nodes, coeffs.dtype)
    times = trajectory.durations[:, None] * fractions

    def sample(order: int) -> Array:
        factors = derivative_factors(degree, order)
        value = jnp.zeros(times.shape + (3,), coeffs.dtype)
        for k in range(degree, order - 1, -1):
            value = value * times[..., None] + factors[k] * coeffs[:, None, k]
        return value.reshape(-1, 3)

    return Motion(height=sample(0)[:, 2], vel=sample(1), acc=sample(2), jerk=sample(3))


@dataclasses.dataclass(frozen=True)
class JuggleHit:
    """A minimum-jerk primitive to a stroke that is fixed beforehand; nothing is optimised.

    The "Juggle" of paper 002. What is taken from where:

    - Mueller, Lupashin, D'Andrea 2011 (its ref. [7]) and Dong et al. 2015 ([8]): the ball is
      met where it falls through a fixed height; the returned ball rises to a fixed apex;
      two components of the racket's velocity are fixed and the third follows from the impact.
    - Mueller, Hehn, D'Andrea 2015 ([9]): the primitive of least jerk to that state.
    - Paper 002: eqs 11-12 (the impact solved for normal and normal speed), 15-17 (the
      primitive), and its tau_z = 1.1 g at the impact.
    - The published trials: v_x = v_y = 0 in every recorded hit; the quadrotor at 1.43 to
      1.50 m, never above, which is the first 10 ms sample below 1.5 m; an apex of 2.3 m
      (median; quartiles 2.2 and 2.4) that attitude and target imply, if gravity alone acts.
    - Assumed: the ramp of `eased_minimum_jerk`. Without it the body rate jumps at time 0.

    With the restitution 0.7 of paper 002 this planner succeeds on two serves of three, and
    not on the one in ten of the published trials. Their recorded hits have a restitution near
    0.32: a racket that must rise at 3 m/s at the impact instead of nearly resting. With that
    restitution in the scenarios it succeeds on one in ten, and mostly in those of the 36
    scenarios in which the published one did (correlation 0.65).
    """

    height: float = 1.5  # [m], of the ball at the impact
    apex: float = 2.3  # [m], of the returned ball
    thrust_z: float = 1.1  # vertical thrust at the impact over gravity
    racket_vel_xy: tuple[float, float] = (0.0, 0.0)  # [m/s], of the quadrotor at the impact
    ease: float = 0.02  # [s], in which the jerk reaches that of the primitive
    nodes: int = 60  # intervals a piece in which limits are looked at
    num_table_nodes: int = 48

    @property
    def rounds(self) -> tuple[Round, ...]:
        """One evaluation: without a decision to take, every lane is stationary at once."""
        solver = LbfgsConfig(max_steps=0, memory=1, trial_steps=(1.0,), patience=0)
        return (Round(starts=1, solver=solver),)

    def prepare(self, scenario: HitScenario) -> HitPlan:
        """The plan itself: no variable is left to decide on."""
        impact = self.impact(prepare_hit(scenario, self.num_table_nodes))
        trajectory = eased_minimum_jerk(
            scenario.head_state, impact.tail_state[:3], impact.stroke.time, self.ease
        )
        motion = sample_pieces(trajectory, self.nodes)
        along = jnp.stack(motion_excess(motion, scenario.gravity, scenario.limits))
        # A height or an apex that cannot be, or a racket on edge, is a broken limit too.
        meeting = jnp.abs(impact.stroke.ball_pos[2] - self.height)
        too_low = jnp.maximum(impact.stroke.ball_pos[2], scenario.target[2]) - self.apex
        lying = _LEAST_UPRIGHT - impact.stroke.normal[2]
        missed = jnp.maximum(jnp.maximum(meeting, too_low) - 1e-3, lying)
        violation = jnp.maximum(largest_violation(along, impact, scenario), missed)
        mean_jerk = snap_energy(trajectory, 3) / impact.stroke.time
        return undecided_plan(trajectory, impact, mean_jerk, violation)

    def guesses(self, context: HitPlan, num: int) -> Array:
        """One point of one number that means nothing, (1, 1)."""
        if num != 1:
            raise ValueError(f"starts must be 1, got {num}")
        return jnp.zeros((1, 1), context.cost.dtype)

    def objective(self, point: Array, context: HitPlan) -> Evaluation:
        """Mean squared jerk (paper 002, eq. 15) and largest violation, whatever the point."""
        return Evaluation(cost=context.cost, violation=context.violation)

    def decode(self, point: Array, context: HitPlan) -> HitPlan:
        """The plan, whatever the point."""
        return context

    def impact(self, context: HitContext) -> Impact:
        """The stroke. A ball that never falls through `height` is met where it comes closest."""
        scenario, path = context.scenario, context.path
        gravity = scenario.gravity
        highest = jnp.maximum(scenario.ball.vel[2], 0.0) / gravity
        latest = jnp.maximum(context.landing_time, highest)
        height = jnp.asarray(self.height, gravity.dtype)
        time = jnp.maximum(falling_time(path, height, highest, latest), _SHORTEST)
        ball = target_at(path, time)
        rise = jnp.sqrt(2.0 * gravity * jnp.maximum(self.apex - ball.pos[2], 1e-3))
        fall = jnp.sqrt(2.0 / gravity * jnp.maximum(self.apex - scenario.target[2], 1e-3))
        flight_time = rise / gravity + fall
        across = (scenario.target - ball.pos)[:2] / flight_time
        after = jnp.concatenate([across, rise[None]])
        normal, normal_speed = required_impact(ball.vel, after, scenario.restitution)
        upright = jnp.maximum(normal[2], _LEAST_UPRIGHT)
        fixed = jnp.asarray(self.racket_vel_xy, rise.dtype)
        vel_z = (normal_speed - jnp.sum(fixed * normal[:2])) / upright
        racket_vel = jnp.concatenate([fixed, vel_z[None]])
        thrust = self.thrust_z * gravity / upright * normal
        return make_impact(time, flight_time, ball, after, racket_vel, thrust, scenario)
