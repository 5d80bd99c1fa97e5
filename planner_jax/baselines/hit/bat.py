"""The baselines `bat` and `bat-lite`: the planner of [Yu2023bat] with and without its front end."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.ball.flight import BallState, drag_free_fall_time, fly, required_impact
from planner_jax.ball.prediction import target_at
from planner_jax.baselines.hit.common import largest_violation, make_impact, motion_excess
from planner_jax.baselines.hit.decoupled import aim_at_angle, decoupled_hit
from planner_jax.baselines.parts.minimum_jerk import minimum_jerk
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import require_settings
from planner_jax.cost.penalty import join_trapezoid_weights, smooth_hinge
from planner_jax.optimise.planner import OptimisedPlanner, pending
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, Round
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.context import HitContext, Impact, is_too_far, prepare_hit
from planner_jax.task.hit.plan import HitPlan
from planner_jax.trajectory.polynomial import Motion, evaluate
from planner_jax.trajectory.proportional_minco import (
    ProportionalMinco,
    boundary_rows,
    proportional_minco,
    proportional_trajectory,
    sample_motion,
    trajectory_energy,
)

_ORDER = 4  # minimum snap
_COST_UNIT = 1e4  # the solver wants curvatures of moderate size
_DECODE_NODES = 24

# [Yu2023bat, Section VI-A]. phi is in its list of parameters and nowhere in its text; it is read
# as the share of the way from s_0 to s_t.
_ALPHA, _ETA, _PHI = 0.5, 2.0 / 3.0, 0.5
_SLOWING = np.array([0.5, 0.5, 1.0 / 3.0])  # varpi, velocity at the transition over the last one
_TURNED = 2.0 / 3.0  # share of the hit's acceleration at the transition

# The least steep path [m/s] on which the ball is followed back to the ground.
_LEAST_RISE = 0.1


def serve_origin(case: HitCase) -> Array:
    """Where the ball's flight, followed backwards, comes out of the ground: s_0, (3,) [m].

    The mirrored ball flies forward against a drag of the other sign, for as long as it takes
    without drag; the rest is a straight line. A ball that the drag of the other sign would
    blow up is followed without drag.
    """
    mirrored = BallState(pos=case.ball.pos, vel=-case.ball.vel)
    floor = jnp.zeros_like(case.gravity)
    time, _ = drag_free_fall_time(mirrored, floor, case.gravity)
    ahead, _ = fly(mirrored, time, -case.drag, case.gravity, num_steps=10)
    rest = ahead.pos[2] / jnp.maximum(-ahead.vel[2], _LEAST_RISE)
    origin = ahead.pos + ahead.vel * rest
    sound = jnp.all(jnp.isfinite(origin)) & (jnp.abs(rest) < 0.5)
    plain = mirrored.pos + mirrored.vel * time
    origin = jnp.where(sound, origin, plain)
    return origin * jnp.array([1.0, 1.0, 0.0], origin.dtype)


def transition_point(start: Array, hit: Array, origin: Array, target: Array) -> Array:
    """Where the quadrotor stops hurrying and starts swinging: p_t of [Yu2023bat, Section IV-A].

    The ray of Fig. 4 is read as the one from s_mid through p_h, the way along which the
    racket swings: p_alpha, halfway from p_0 to p_h, is projected on it to p_perp, and p_t is
    eta of the way from p_perp back to p_alpha.

    Args:
        start: (3,) p_0 [m].
        hit: (3,) p_h [m].
        origin: (3,) s_0 [m], where the ball came from.
        target: (3,) s_t [m], where it shall go.

    Returns:
        (3,) [m].
    """
    middle = origin + _PHI * (target - origin)
    halfway = start + _ALPHA * (hit - start)
    ray = hit - middle
    share = jnp.sum((halfway - middle) * ray) / jnp.maximum(jnp.sum(ray**2), 1e-6)
    foot = middle + jnp.maximum(share, 0.0) * ray
    return foot + _ETA * (halfway - foot)


# Natural units of a waypoint coordinate [m], log T, a racket speed [m/s], a thrust [m/s^2]: by
# hand, steps of one unit are of a sensible size.
_UNITS = (0.1, 0.05, 0.3, 0.5)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class BatHit(OptimisedPlanner):
    """The planner of [Yu2023bat]; with `transition=False` its "Bat-Lite".

    Decision variables, n = 3 (M - 1) + 5, each in units of `scale`: the waypoints' positions
    [m], log T, p_y_dot, p_z_dot, tau_x, tau_z. Taken from the paper as it stands:

    - eqs 11-14, by which these give the whole state at the impact (`decoupled_hit`);
    - Section IV-A, the transition point, and IV-C, one minimum-jerk primitive to it and one
      from it (eqs 15-17): together the first guess, with the values of Section VI-A;
    - eq. 19, MINCO with s = 4 and equal times; eqs 18a, 20-22 and 24a, one weighted sum of
      the squared snap, T and the penalties L_mu of its ref. [10]; L-BFGS from one start, the
      last iterate returned whatever limits it breaks.

    Misprints are read as eq. 18a with D_max^2, eq. 22 with the velocity's z; the ground of
    eq. 18a as z_min - z, because the squares turn their sign below ground.

    Readings of what the paper leaves open: the transition acts in the first guess alone,
    since eq. 18e leaves its state free and the least snap through free waypoints is MINCO's
    joined trajectory; the ray of Fig. 4 (`transition_point`) and the thrust of Fig. 4b
    (`transition_state`); no jerk at the impact. Bat-Lite's front end is a primitive straight
    to the impact (ref. [11]): one stage, and so the time T_0 alone. Weights, mu, M, kappa,
    units and the stopping rule are not given: M = 4 and usual values of MINCO planners.

    `max_steps` is fitted: with 80 iterations both planners are within two points of the
    published trials' means, 85.4 and 46.6 %, though hardly for the same serves. It decides
    nearly everything. Success on 1,800 published serves after so many iterations, in %:

    iterations                 0   20   40   60   80  100  150  200  300
    bat                        0   45   58   77   85   92   94   94   94
    bat-lite                   0    8    5   23   48   63   79   82   82
    bat-lite from T_0 + T_1   24   53   72   85   91   94   94   94   94

    So what the two-stage guess buys here is above all a first impact time nearer to the best
    one, and a solver that is left to converge needs it less than the published one did.

    It does not look at a case's extras; the referee does.
    """

    case_type = HitCase
    transition: bool = True
    num_pieces: int = 4  # M
    nodes: int = 16  # kappa, penalty intervals a piece
    num_table_nodes: int = 48
    time_weight: float = 1e3  # rho
    limit_weight: float = 1e5  # W_D and W_c: speed, acceleration, body rate, ground
    terminal_weight: float = 1e4  # W_r and W_t: apex, hitting speed; and where eqs 13-14 fail
    hinge_width: float = 0.01  # mu, in the unit of each constraint
    stage_times: tuple[float, float] = (0.7, 0.5)  # T_0, T_1 [s]; without transition the first
    first_angle: float = math.radians(60.0)  # of the returned ball above the horizontal
    first_thrust_z: float = 1.1  # tau_z over gravity
    first_racket_vel_yz: tuple[float, float] = (0.0, 1.0)  # [m/s]
    rounds: tuple[Round, ...] = (
        Round(
            starts=1,
            solver=LbfgsConfig(
                max_steps=80, memory=16, trial_steps=(2.0, 0.7071, 0.25, 0.0884), patience=3
            ),
        ),
    )
    scale: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        require_settings(self)
        if self.num_pieces < 2:
            raise ArgumentError("num_pieces", ">= 2", self.num_pieces)
        if not self.scale:
            place, time, speed, thrust = _UNITS
            terminal = (time, speed, speed, thrust, thrust)
            object.__setattr__(self, "scale", (place,) * self.num_offsets + terminal)
        if len(self.scale) != self.num_offsets + 5:
            rule = f"of {self.num_offsets + 5} numbers"
            raise ArgumentError("scale", rule, len(self.scale))

    @property
    def maps(self) -> ProportionalMinco:
        """Constant maps from boundary and offsets to the trajectory."""
        return proportional_minco(_ORDER, (1.0,) * self.num_pieces)

    @property
    def num_offsets(self) -> int:
        """Number of waypoint variables."""
        return 3 * (self.num_pieces - 1)

    def prepare(self, case: HitCase) -> HitContext:
        """The incoming ball's table; see `prepare_hit`."""
        return prepare_hit(case, self.num_table_nodes)

    def impact(self, natural: Array, context: HitContext) -> tuple[Impact, Array]:
        """The impact of the variables behind the waypoints, and the defect of eqs 13-14.

        Args:
            natural: (5,) log T; p_y_dot, p_z_dot [m/s]; tau_x, tau_z [m/s^2].
            context: of the case.
        """
        case, time = context.case, jnp.exp(natural[0])
        ball = target_at(context.path, time)
        hit = decoupled_hit(
            ball, case.target, natural[1:3], natural[3:5], case.restitution, case.gravity
        )
        impact = make_impact(
            time, hit.flight_time, ball, hit.ball_vel_after, hit.racket_vel, hit.thrust, case
        )
        return impact, hit.defect

    def guesses(self, context: HitContext, num: int) -> Array:
        """The initial values of Section VI-A with the waypoints of the primitives, (1, n)."""
        if num != 1:
            raise ArgumentError("starts", "1", num)
        case, dtype = context.case, context.landing_time.dtype
        stages = self.stage_times if self.transition else self.stage_times[:1]
        # A ball that lands sooner, because planning began late, is met before it lands.
        time = jnp.minimum(sum(stages), 0.9 * jnp.maximum(context.landing_time, 0.1))
        ball = target_at(context.path, time)
        after = aim_at_angle(ball.pos, case.target, self.first_angle, case.gravity)
        normal, _ = required_impact(ball.vel, after, case.restitution)
        thrust = self.first_thrust_z * case.gravity / jnp.maximum(normal[2], 0.2) * normal
        speeds = jnp.asarray(self.first_racket_vel_yz, dtype)
        terminal = jnp.concatenate([jnp.log(time)[None], speeds, thrust[::2]])
        impact, _ = self.impact(terminal, context)
        natural = jnp.concatenate([self.primitive_waypoints(impact, case).ravel(), terminal])
        return (natural / jnp.asarray(self.scale, dtype))[None]

    def primitive_waypoints(self, impact: Impact, case: HitCase) -> Array:
        """Positions of the minimum-jerk primitives at equal times, (M - 1, 3) [m]."""
        head, tail, end = case.head_state[:3], impact.tail_state[:3], impact.stroke.time
        shares = np.arange(1, self.num_pieces) / self.num_pieces
        times = end * jnp.asarray(shares, end.dtype)
        position = jax.vmap(evaluate, in_axes=(None, 0))
        if not self.transition:
            return position(minimum_jerk(head, tail, end), times)
        switch = self.stage_times[0] / sum(self.stage_times) * end
        middle = self.transition_state(impact, case)
        first = position(minimum_jerk(head, middle, switch), times)
        second = position(minimum_jerk(middle, tail, end - switch), times - switch)
        return jnp.where((times < switch)[:, None], first, second)

    def transition_state(self, impact: Impact, case: HitCase) -> Array:
        """Position, velocity and acceleration at the transition, (3, 3).

        The acceleration is 2/3 of that at the hit: the thrust then has the paper's vertical
        part g + 2 (tau_z - g) / 3, and for e_tau, which only Fig. 4b defines, we take the
        direction that goes with it, on the way from upright to the hit's.
        """
        hit = impact.tail_state
        pos = transition_point(case.head_state[0], hit[0], serve_origin(case), case.target)
        return jnp.stack([pos, jnp.asarray(_SLOWING, pos.dtype) * hit[1], _TURNED * hit[2]])

    def _unpack(self, point: Array, context: HitContext):
        """Whitened offsets, boundary rows, piece duration, impact and its defect at a point."""
        natural = point * jnp.asarray(self.scale, point.dtype)
        waypoints = natural[: self.num_offsets].reshape(-1, 3)
        impact, defect = self.impact(natural[self.num_offsets :], context)
        duration = impact.stroke.time / self.num_pieces
        rows = boundary_rows(context.case.head_state, impact.tail_state, duration)
        to_offsets = jnp.asarray(self.maps.offsets, point.dtype)
        offsets = jnp.matmul(
            to_offsets, jnp.concatenate([rows, waypoints]), precision=lax.Precision.HIGHEST
        )
        return offsets, rows, duration, impact, defect

    def _terminal_penalty(self, impact: Impact, defect: Array, case: HitCase) -> Array:
        """Apex (eq. 21), hitting speed (eq. 24a) and the defect of eqs 13-14."""
        limits = case.hit_limits
        excess = jnp.concatenate(
            [
                jnp.stack([limits.min_apex - impact.apex, impact.apex - limits.max_apex]),
                jnp.abs(impact.tail_state[1]) - limits.hitting_speed,
            ]
        )
        return self.terminal_weight * (jnp.sum(smooth_hinge(excess, self.hinge_width)) + defect)

    def _penalty(self, motion: Motion, duration: Array, case: HitCase) -> Array:
        """The limits along the way (eq. 18a), the squares of their own units."""
        limits = case.limits
        along = jnp.stack(motion_excess(motion, case.gravity, limits))
        one = jnp.ones_like(limits.speed)
        acceleration = one if limits.acceleration is None else limits.acceleration
        unit = jnp.stack([limits.speed**2, acceleration**2, limits.body_rate**2, one])
        hinges = smooth_hinge(along * unit[:, None], self.hinge_width)
        weights = join_trapezoid_weights(self.nodes, self.maps.proportions)
        weights = jnp.asarray(weights, along.dtype)
        return self.limit_weight * duration * jnp.sum(hinges * weights)

    def objective(self, point: Array, context: HitContext) -> Evaluation:
        """The cost of eq. 20. It names no violation, so that the last iterate is the plan."""
        offsets, rows, duration, impact, defect = self._unpack(point, context)
        columns = jnp.concatenate([rows, offsets])
        motion = sample_motion(self.maps, self.nodes, columns, duration)
        cost = (
            trajectory_energy(self.maps, rows, offsets, duration)
            + self.time_weight * impact.stroke.time
            + self._penalty(motion, duration, context.case)
            + self._terminal_penalty(impact, defect, context.case)
        )
        return Evaluation(cost=cost / _COST_UNIT, violation=jnp.zeros_like(cost))

    def rules_out(self, context: HitContext) -> Array:
        """Whether the ball is never within reach."""
        return is_too_far(context)

    def decode(self, point: Array, context: HitContext) -> HitPlan:
        """The plan at a point, its violation looked for at 24 nodes a piece."""
        case = context.case
        offsets, rows, duration, impact, defect = self._unpack(point, context)
        columns = jnp.concatenate([rows, offsets])
        motion = sample_motion(self.maps, _DECODE_NODES, columns, duration)
        along = jnp.stack(motion_excess(motion, case.gravity, case.limits))
        violation = jnp.maximum(largest_violation(along, impact, case), defect)
        trajectory = proportional_trajectory(self.maps, rows, offsets, duration)
        return HitPlan(
            trajectory=trajectory, gravity=case.gravity, stroke=impact.stroke, **pending(violation)
        )


def bat_lite(**options: Any) -> BatHit:
    """`BatHit` without the transition point; options are its fields."""
    return BatHit(transition=False, **options)
