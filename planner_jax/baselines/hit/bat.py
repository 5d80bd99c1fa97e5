"""The baselines `bat` and `bat-lite`: the planner of [Yu2023bat] with and without transition.

The transition is a state before the hit at which the quadrotor starts its swing.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.ball.flight import BallState, drag_free_fall_time, fly, solve_impact
from planner_jax.ball.prediction import target_at
from planner_jax.baselines.hit.common import largest_violation, make_impact, motion_excess
from planner_jax.baselines.hit.decoupled import aim_at_angle, solve_decoupled_hit
from planner_jax.baselines.parts.minimum_jerk import minimum_jerk
from planner_jax.core.choices import require, require_size
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

_ORDER = 4  # derivative whose square is minimised: snap
_COST_UNIT = 1e4  # divisor of the cost, so that the Hessian has moderate entries
_DECODE_NODES = 24  # number of samples per piece at which the plan's violation is evaluated

# Constants of [Yu2023bat, Section VI-A]. The paper lists phi but does not define it; here it is the
# fraction at which s_mid divides the segment from s_0 to s_t.
_ALPHA, _ETA, _PHI = 0.5, 2.0 / 3.0, 0.5
_SLOWING = np.array([0.5, 0.5, 1.0 / 3.0])  # varpi, (velocity at transition) / (velocity at hit)
_ACCELERATION_SHARE = 2.0 / 3.0  # (acceleration at transition) / (acceleration at hit)

_LEAST_RISE = 0.1  # [m/s], least vertical speed for extrapolation to the ground


def serve_origin(case: HitCase) -> Array:
    """Return where the ball's flight, traced backwards, leaves the ground: s_0, (3,) [m].

    A ball with the opposite velocity flies forward against drag of the opposite sign, for the
    flight time without drag. A straight line covers the height that then remains. If drag of the
    opposite sign makes the flight diverge, the flight without drag is used.
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
    """Return p_t of [Yu2023bat, Section IV-A], the point where the quadrotor starts the swing.

    The paper's ray of Fig. 4 is taken as the ray from s_mid through p_h, along which the racket
    swings. p_alpha lies halfway between p_0 and p_h, and p_perp is the projection of p_alpha onto
    the ray. p_t divides the segment from p_perp to p_alpha at the fraction eta.

    Args:
        start: (3,) p_0 [m].
        hit: (3,) p_h [m].
        origin: (3,) s_0 [m], origin of the ball's flight.
        target: (3,) s_t [m], where the returned ball should land.

    Returns:
        (3,) [m].
    """
    middle = origin + _PHI * (target - origin)
    halfway = start + _ALPHA * (hit - start)
    ray = hit - middle
    share = jnp.sum((halfway - middle) * ray) / jnp.maximum(jnp.sum(ray**2), 1e-6)
    foot = middle + jnp.maximum(share, 0.0) * ray
    return foot + _ETA * (halfway - foot)


# Units of the variables: waypoint coordinate [m], log T, racket speed [m/s], thrust [m/s^2]. They
# are chosen by hand so that a step of one unit is of moderate size in every variable.
_UNITS = (0.1, 0.05, 0.3, 0.5)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class BatHit(OptimisedPlanner):
    """The planner of [Yu2023bat]; with `transition=False` its "Bat-Lite".

    The n = 3 (M - 1) + 5 decision variables, in units of `scale`, are the waypoints' positions [m],
    log T, p_y_dot, p_z_dot, tau_x and tau_z. These parts follow the paper without changes:

    - Eqs 11-14 derive the complete state at the impact (`solve_decoupled_hit`).
    - The initial guess has the values of Section VI-A. It consists of two minimum-jerk primitives
      (eqs 15-17, Section IV-C), to the transition point of Section IV-A and from there to the hit.
    - The trajectory is MINCO with s = 4 and equal times (eq. 19). The cost is a weighted sum of the
      squared snap, T and the penalties L_mu of the paper's ref. [10] (eqs 18a, 20-22 and 24a).
    - L-BFGS runs from one start. Its last iterate is returned even if this iterate breaks limits.

    Two misprints are corrected: eq. 18a has D_max^2, and eq. 22 has the velocity's z. The ground
    term of eq. 18a is z_min - z, because the difference of squares changes its sign below the
    ground.

    The paper leaves some choices open. This planner makes these choices:

    - The transition acts only on the initial guess. Eq. 18e leaves the transition state free, and
      the least-snap trajectory through free waypoints is the trajectory of MINCO.
    - `transition_point` interprets the ray of Fig. 4, and `transition_state` the thrust of Fig. 4b.
    - The jerk at the impact is zero.
    - Bat-Lite's initial guess is one primitive straight to the impact (ref. [11]), with time T_0.
    - Weights, mu, M = 4, kappa, units and the stopping rule are usual values of MINCO planners.

    `max_steps` is fitted to the mean success rates of the published trials, 85.4 % for `bat` and
    46.6 % for `bat-lite`. With 80 iterations both planners are within two points of these rates,
    though they hardly succeed on the same serves as the published planners. The number of
    iterations decides the success almost alone. Success on 1,800 published serves, in %:

        iterations                 0   20   40   60   80  100  150  200  300
        bat                        0   45   58   77   85   92   94   94   94
        bat-lite                   0    8    5   23   48   63   79   82   82
        bat-lite from T_0 + T_1   24   53   72   85   91   94   94   94   94

    In the last row Bat-Lite starts with the longer impact time of `bat`. The main benefit of the
    guess in two stages is therefore an initial impact time closer to the optimum. A solver that
    runs to convergence needs this benefit less than the published solver.

    This planner ignores a case's extras; the referee checks them.
    """

    case_type = HitCase
    transition: bool = True
    num_pieces: int = 4  # M, number of polynomial pieces
    nodes: int = 16  # kappa, number of intervals per piece in which penalties are integrated
    num_table_nodes: int = 48  # number of nodes at which the incoming ball is tabulated
    time_weight: float = 1e3  # rho, weight of the impact time T
    limit_weight: float = 1e5  # W_D and W_c: speed, acceleration, body rate, ground
    terminal_weight: float = 1e4  # W_r and W_t: apex, hitting speed, and the defect of eqs 13-14
    hinge_width: float = 0.01  # mu, in the unit of each constraint
    stage_times: tuple[float, float] = (0.7, 0.5)  # T_0, T_1 [s]; without transition only T_0
    first_angle: float = math.radians(60.0)  # [rad], elevation of the returned ball in the guess
    first_thrust_z: float = 1.1  # tau_z of the guess, divided by gravity
    first_racket_vel_yz: tuple[float, float] = (0.0, 1.0)  # [m/s], in the guess
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
        require_size("num_pieces", self.num_pieces, 2)
        if not self.scale:
            place, time, speed, thrust = _UNITS
            terminal = (time, speed, speed, thrust, thrust)
            object.__setattr__(self, "scale", (place,) * self.num_offsets + terminal)
        size = self.num_offsets + 5
        require(len(self.scale) == size, "scale", f"of {size} numbers", len(self.scale))

    @property
    def maps(self) -> ProportionalMinco:
        """The constant matrices that map boundary states and offsets to the trajectory."""
        return proportional_minco(_ORDER, (1.0,) * self.num_pieces)

    @property
    def num_offsets(self) -> int:
        """The number of waypoint variables, three for each inner waypoint."""
        return 3 * (self.num_pieces - 1)

    def prepare(self, case: HitCase) -> HitContext:
        """Tabulate the incoming ball's trajectory of a case by `prepare_hit`."""
        return prepare_hit(case, self.num_table_nodes)

    def impact(self, natural: Array, context: HitContext) -> tuple[Impact, Array]:
        """Return the impact of the last five variables, and by how much eqs 13-14 are unsolvable.

        The variables are log T; p_y_dot, p_z_dot [m/s]; tau_x, tau_z [m/s^2].
        """
        case, time = context.case, jnp.exp(natural[0])
        ball = target_at(context.path, time)
        hit = solve_decoupled_hit(
            ball, case.target, natural[1:3], natural[3:5], case.restitution, case.gravity
        )
        impact = make_impact(
            time, hit.flight_time, ball, hit.ball_vel_after, hit.racket_vel, hit.thrust, case
        )
        return impact, hit.defect

    def guesses(self, context: HitContext, num: int) -> Array:
        """Return the initial guess (1, n): values of Section VI-A, waypoints on the primitives."""
        require(num == 1, "starts", "1", num)
        case, dtype = context.case, context.landing_time.dtype
        stages = self.stage_times if self.transition else self.stage_times[:1]
        # If planning starts late, the ball may land before T_0 + T_1. Then the guess is earlier.
        time = jnp.minimum(sum(stages), 0.9 * jnp.maximum(context.landing_time, 0.1))
        ball = target_at(context.path, time)
        after = aim_at_angle(ball.pos, case.target, self.first_angle, case.gravity)
        normal, _ = solve_impact(ball.vel, after, case.restitution)
        thrust = self.first_thrust_z * case.gravity / jnp.maximum(normal[2], 0.2) * normal
        speeds = jnp.asarray(self.first_racket_vel_yz, dtype)
        terminal = jnp.concatenate([jnp.log(time)[None], speeds, thrust[::2]])
        impact, _ = self.impact(terminal, context)
        natural = jnp.concatenate([self.primitive_waypoints(impact, case).ravel(), terminal])
        return (natural / jnp.asarray(self.scale, dtype))[None]

    def primitive_waypoints(self, impact: Impact, case: HitCase) -> Array:
        """Sample the minimum-jerk primitives at M - 1 equally spaced times, (M - 1, 3) [m]."""
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
        """Return position, velocity and acceleration at the transition, (3, 3).

        The acceleration is 2/3 of the acceleration at the hit, so that the thrust has the paper's
        vertical part g + 2 (tau_z - g) / 3. The thrust's direction e_tau is defined only by the
        paper's Fig. 4b. Here it follows from the acceleration, and lies between the vertical and
        the thrust's direction at the hit.
        """
        hit = impact.tail_state
        pos = transition_point(case.head_state[0], hit[0], serve_origin(case), case.target)
        return jnp.stack(
            [pos, jnp.asarray(_SLOWING, pos.dtype) * hit[1], _ACCELERATION_SHARE * hit[2]]
        )

    def _unpack(self, point: Array, context: HitContext):
        """Return offsets, boundary rows, piece duration, impact and defect of a search point."""
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
        """Return the penalty on apex (eq. 21), hitting speed (eq. 24a) and defect of eqs 13-14."""
        limits = case.hit_limits
        excess = jnp.concatenate(
            [
                jnp.stack([limits.min_apex - impact.apex, impact.apex - limits.max_apex]),
                jnp.abs(impact.tail_state[1]) - limits.hitting_speed,
            ]
        )
        return self.terminal_weight * (jnp.sum(smooth_hinge(excess, self.hinge_width)) + defect)

    def _penalty(self, motion: Motion, duration: Array, case: HitCase) -> Array:
        """Return the penalty on limits along the trajectory (eq. 18a), with squares in SI units."""
        limits = case.limits
        along = jnp.stack(motion_excess(motion, case.gravity, limits))
        one = jnp.ones_like(limits.speed)
        acceleration = one if limits.acceleration is None else limits.acceleration
        unit = jnp.stack([limits.speed**2, acceleration**2, limits.body_rate**2, one])
        hinges = smooth_hinge(along * unit[:, None], self.hinge_width)
        weights = join_trapezoid_weights(self.nodes, self.maps.proportions)
        weights = jnp.asarray(weights, along.dtype)
        return self.limit_weight * duration * jnp.sum(hinges * weights[None])

    def objective(self, point: Array, context: HitContext) -> Evaluation:
        """Return the cost of eq. 20, divided by `_COST_UNIT`.

        The reported violation is always zero, so that the solver does not prefer iterates that keep
        the limits, and returns its last iterate.
        """
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
        """Return whether the ball never comes within the quadrotor's reach, () bool."""
        return is_too_far(context)

    def decode(self, point: Array, context: HitContext) -> HitPlan:
        """Return the plan of a search point; its violation is evaluated at 24 nodes per piece."""
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
    """Create the baseline `bat-lite`, a `BatHit` without transition; `options` are its fields."""
    return BatHit(transition=False, **options)
