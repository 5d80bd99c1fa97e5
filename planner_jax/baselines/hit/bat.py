"""The baselines `bat` and `bat-lite`: the planner of [Yu2023bat] with and without transition.

The transition is a state before the hit at which the quadrotor starts its swing.
"""

import dataclasses
import functools
import math
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.ball.flight import BallState, drag_free_fall_time, fly, solve_impact
from planner_jax.baselines.hit.common import largest_violation, make_impact, motion_excess
from planner_jax.baselines.hit.decoupled import aim_at_angle, solve_decoupled_hit
from planner_jax.baselines.parts.lbfgs_lite import LitePlanner, LiteRule
from planner_jax.baselines.parts.minimum_jerk import minimum_jerk
from planner_jax.core.choices import require, require_size
from planner_jax.core.protocol import require_settings
from planner_jax.cost.penalty import join_trapezoid_weights
from planner_jax.optimise.planner import Problem, pending
from planner_jax.optimise.settings import Attempt, Evaluation, LbfgsConfig
from planner_jax.penalties.hinges import smooth_hinge
from planner_jax.penalties.hits import apex_excess, hitting_speed_excess
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
_DECODE_NODES = 96  # number of samples per piece at which the plan's violation is evaluated

# Fractions of segments in `transition_point` [Yu2023bat, Section VI-A]. Point A is at alpha from
# the quadrotor's start to the hit, point B at phi (assumed) from the ball's origin to its target.
# The transition is at eta from the projection of A onto the line from B to the hit, to A.
_ALPHA, _ETA, _PHI = 0.5, 2.0 / 3.0, 0.5
_SLOWING = np.array([0.5, 0.5, 1.0 / 3.0])  # (velocity at transition) / (velocity at hit), x, y, z
_ACCELERATION_SHARE = 2.0 / 3.0  # (acceleration at transition) / (acceleration at hit)

_LEAST_RISE = 0.1  # [m/s], least vertical ball speed by which a remaining height is divided


def serve_origin(case: HitCase) -> Array:
    """Return the point (3,) [m] on the ground at which the ball's flight, traced back, starts.

    The flight is traced back by a forward flight with opposite velocity and opposite drag, which
    lasts as long as a fall without drag. A straight line then covers the remaining height. If the
    flight with opposite drag diverges, the flight without drag is used.
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

    The ray of the paper's Fig. 4 is interpreted as the ray from the middle of origin and target
    through the hit. The middle of start and hit is projected onto this ray. p_t is at two thirds of
    the segment from the projection to the middle of start and hit.

    Args:
        start: (3,) [m], position of the quadrotor at time 0.
        hit: (3,) [m], position of the quadrotor at the hit.
        origin: (3,) [m], where the ball's flight starts on the ground.
        target: (3,) [m], where the returned ball should land.

    Returns:
        (3,) [m].
    """
    middle = origin + _PHI * (target - origin)
    halfway = start + _ALPHA * (hit - start)
    ray = hit - middle
    share = jnp.sum((halfway - middle) * ray) / jnp.maximum(jnp.sum(ray**2), 1e-6)
    foot = middle + jnp.maximum(share, 0.0) * ray
    return foot + _ETA * (halfway - foot)


# Units of the optimiser's variables, chosen by hand: 0.1 m for a waypoint's coordinate, 0.05 for
# the logarithm of the impact time, 0.3 m/s for a racket speed and 0.5 m/s^2 for a thrust.
_UNITS = (0.1, 0.05, 0.3, 0.5)
# Units, chosen by hand, of position [m], velocity, acceleration and jerk at the transition.
_STATE_UNITS = (0.1, 0.3, 0.5, 5.0)


def _sample(maps: ProportionalMinco, section: tuple[Array, Array, Array], nodes: int) -> Motion:
    rows, offsets, duration = section
    return sample_motion(maps, nodes, jnp.concatenate([rows, offsets]), duration)


def _join(parts: list[Any]) -> Any:
    """Concatenate the arrays of pytrees along the first axis."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class BatHit(Problem):
    """The problem that [Yu2023bat] minimises; `transition=False` makes the problem of "Bat-Lite".

    A trajectory of M polynomial pieces has M - 1 inner waypoints. The decision variables, in units
    of `scale`, are the waypoints' positions [m], the logarithm of the impact time T [s], y and z of
    the racket's velocity [m/s], and x and z of the thrust per unit mass [m/s^2] at the impact.
    With `sections=2` the trajectory consists of two such splines, before and after the transition.
    Position, velocity, acceleration and jerk at the transition are variables, too (eq. 18e).
    These parts follow the paper without changes:

    - Eqs 11-14 derive the complete state at the impact (`solve_decoupled_hit`).
    - The initial guess has the values of Section VI-A. It consists of two minimum-jerk primitives
      (eqs 15-17, Section IV-C), to the transition point of Section IV-A and from there to the hit.
    - The trajectory has the least snap, with pieces of equal duration (MINCO, eq. 19), from the
      start to the hit (eqs 18c and 18d). The variable log T keeps T positive (eq. 18b). The cost is
      a weighted sum of the squared snap, T and smooth penalties (eqs 18a, 20-22 and 24a).
    - L-BFGS runs from one start. Its last iterate is returned even if this iterate breaks limits.
      The planner `bat` has the stopping rule and line search of LBFGS-Lite (`LitePlanner`), and
      the paper's variables without other units.

    Two misprints are corrected. Eq. 18a compares the square of a quantity with its limit; here it
    is compared with the limit's square. Eq. 22 computes the ball's apex from the x component of its
    velocity; here it is z. In the ground term z_min^2 - z^2 of eq. 18a, a height z below -z_min
    would be allowed; here the term is z_min - z.

    The paper leaves some choices open. This planner makes these choices:

    - With one section, the transition acts only on the initial guess. The durations of two sections
      are in proportion to `stage_times`, and the initial guess has no jerk at the transition.
    - `transition_point` interprets the ray of Fig. 4, and `transition_state` the thrust of Fig. 4b.
    - The jerk at the impact is zero.
    - Bat-Lite's initial guess is one primitive straight to the impact, of duration T_0.
    - Weights and numbers of pieces and nodes are usual values.

    The planner `bat-fitted` stops after 80 iterations of the library's L-BFGS (`attempts`). This
    number is fitted to the mean success rates of the published trials, but the published planners
    succeed on other serves (docs/lab/hit.md).

    This planner ignores the additional limits of a case (`extras`); the referee checks them.
    """

    case_type = HitCase
    attempts = (
        Attempt(
            starts=1,
            solver=LbfgsConfig(
                max_steps=80, memory=16, trial_steps=(2.0, 0.7071, 0.25, 0.0884), patience=3
            ),
        ),
    )
    transition: bool = True
    sections: int = 1  # number of splines; 2 have a variable state at the transition between them
    num_pieces: int = 4  # number of polynomial pieces of each section
    nodes: int = 16  # number of intervals per piece in which penalties are integrated
    time_weight: float = 1e3  # weight of the impact time
    limit_weight: float = 1e5  # weight of speed, acceleration, body rate and ground
    terminal_weight: float = 1e4  # weight of apex, hitting speed, and the defect of eqs 13-14
    hinge_width: float = 0.01  # width of the smooth penalties, in the unit of each limit
    # [s], durations before and after the transition in the initial guess; Bat-Lite uses the first.
    stage_times: tuple[float, float] = (0.7, 0.5)
    first_angle: float = math.radians(60.0)  # [rad], ball's elevation after the guessed hit
    first_thrust_z: float = 1.1  # vertical thrust at the impact in the initial guess / gravity
    first_racket_vel_yz: tuple[float, float] = (0.0, 1.0)  # [m/s], in the initial guess
    scale: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        require_settings(self)
        require_size("num_pieces", self.num_pieces, 2)
        most = 2 if self.transition else 1
        require(self.sections in range(1, most + 1), "sections", f"1 to {most}", self.sections)
        if not self.scale:
            place, time, speed, thrust = _UNITS
            inner = (place,) * self.num_waypoints + _STATE_UNITS * (self.sections - 1)
            scale = (*np.repeat(inner, 3).tolist(), time, speed, speed, thrust, thrust)
            object.__setattr__(self, "scale", scale)
        size = self.num_offsets + 5
        require(len(self.scale) == size, "scale", f"of {size} numbers", len(self.scale))

    @property
    def maps(self) -> ProportionalMinco:
        """Constant matrices that compute a section from its end states and waypoint variables."""
        return proportional_minco(_ORDER, (1.0,) * self.num_pieces)

    @property
    def num_waypoints(self) -> int:
        """The number of inner waypoints of all sections."""
        return self.sections * (self.num_pieces - 1)

    @property
    def num_offsets(self) -> int:
        """The number of variables of waypoints and of the transition state, three for each row."""
        return 3 * (self.num_waypoints + 4 * (self.sections - 1))

    @property
    def shares(self) -> tuple[float, ...]:
        """The durations of the sections, divided by the impact time."""
        stages = self.stage_times
        return (1.0,) if self.sections == 1 else tuple(each / sum(stages) for each in stages)

    def prepare(self, case: HitCase) -> HitContext:
        """Tabulate the incoming ball's positions and velocities at equal time steps."""
        return prepare_hit(case)

    def impact(self, natural: Array, context: HitContext) -> tuple[Impact, Array]:
        """Return the impact from the last five variables, and the defect [Yu2023bat, eqs 13-14].

        `natural` (5,) has the logarithm of the impact time, y and z of the racket's velocity [m/s],
        and x and z of the thrust per unit mass [m/s^2]. The defect is > 0 if no hit is possible.
        """
        case, time = context.case, jnp.exp(natural[0])
        ball = context.path.at(time)
        hit = solve_decoupled_hit(
            ball, case.target, natural[1:3], natural[3:5], case.restitution, case.gravity
        )
        impact = make_impact(
            time, hit.flight_time, ball, hit.ball_vel_after, hit.racket_vel, hit.thrust, case
        )
        return impact, hit.defect

    def guesses(self, context: HitContext, num: int) -> Array:
        """Return one initial guess (1, n), a minimum-jerk motion [Yu2023bat, Section VI-A]."""
        require(num == 1, "starts", "1", num)
        case, dtype = context.case, context.landing_time.dtype
        stages = self.stage_times if self.transition else self.stage_times[:1]
        # If the ball lands early, the guess of the impact time is 0.9 of the landing time.
        time = jnp.minimum(sum(stages), 0.9 * jnp.maximum(context.landing_time, 0.1))
        ball = context.path.at(time)
        after = aim_at_angle(ball.pos, case.target, self.first_angle, case.gravity)
        normal, _ = solve_impact(ball.vel, after, case.restitution)
        thrust = self.first_thrust_z * case.gravity / jnp.maximum(normal[2], 0.2) * normal
        speeds = jnp.asarray(self.first_racket_vel_yz, dtype)
        terminal = jnp.concatenate([jnp.log(time)[None], speeds, thrust[::2]])
        impact, _ = self.impact(terminal, context)
        inner = [self.primitive_waypoints(impact, case)]
        if self.sections == 2:
            inner += [self.transition_state(impact, case), jnp.zeros((1, 3), dtype)]
        natural = jnp.concatenate([*(rows.ravel() for rows in inner), terminal])
        return (natural / jnp.asarray(self.scale, dtype))[None]

    def primitive_waypoints(self, impact: Impact, case: HitCase) -> Array:
        """Return the initial waypoints [m] of each section's pieces, on minimum-jerk trajectories.

        The result has the shape (W, 3), with W = `num_waypoints`.
        """
        head, tail, end = case.head_state[:3], impact.tail_state[:3], impact.stroke.time
        shares = np.arange(1, self.num_pieces) / self.num_pieces
        starts = np.cumsum(self.shares) - self.shares
        shares = (starts[:, None] + np.outer(self.shares, shares)).ravel()
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
        """Return the quadrotor's position, velocity and acceleration at the transition, (3, 3).

        The acceleration is two thirds of the acceleration at the hit, so that the vertical thrust
        equals the paper's. The paper shows the thrust's direction only in Fig. 4b; here it follows
        from the acceleration.
        """
        hit = impact.tail_state
        pos = transition_point(case.head_state[0], hit[0], serve_origin(case), case.target)
        return jnp.stack(
            [pos, jnp.asarray(_SLOWING, pos.dtype) * hit[1], _ACCELERATION_SHARE * hit[2]]
        )

    def _unpack(self, point: Array, context: HitContext):
        """Return the arguments of `trajectory_energy` by section, the impact and its defect."""
        natural = point * jnp.asarray(self.scale, point.dtype)
        inner = natural[: self.num_offsets].reshape(-1, 3)
        impact, defect = self.impact(natural[self.num_offsets :], context)
        middle = [inner[self.num_waypoints :]] if self.sections == 2 else []
        states = [context.case.head_state, *middle, impact.tail_state]
        to_offsets = jnp.asarray(self.maps.offsets, point.dtype)
        sections = []
        for k, share in enumerate(self.shares):
            duration = impact.stroke.time / (self.num_pieces / share)
            rows = boundary_rows(states[k], states[k + 1], duration)
            first = k * (self.num_pieces - 1)
            columns = jnp.concatenate([rows, inner[first : first + self.num_pieces - 1]])
            offsets = jnp.matmul(to_offsets, columns, precision=lax.Precision.HIGHEST)
            sections.append((rows, offsets, duration))
        return sections, impact, defect

    def _terminal_penalty(self, impact: Impact, defect: Array, case: HitCase) -> Array:
        """Return the penalty of apex and hitting velocity [Yu2023bat, eqs 21 and 24a]."""
        limits = case.hit_limits
        apex = apex_excess(impact.apex, limits.min_apex, limits.max_apex, in_si=True)
        speed = hitting_speed_excess(impact.tail_state[1], limits.hitting_speed, in_si=True)
        excess = jnp.concatenate([apex, speed])
        return self.terminal_weight * (jnp.sum(smooth_hinge(excess, self.hinge_width)) + defect)

    def _penalty(self, motion: Motion, duration: Array, case: HitCase) -> Array:
        """Return the penalty on limits along a section [Yu2023bat, eq. 18a].

        It penalises the differences between squared quantities and squared limits, in SI units.
        """
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
        """Return the sum of snap, time and penalties [Yu2023bat, eq. 20] / `_COST_UNIT`.

        The reported violation is always zero, so that the solver does not prefer iterates that keep
        the limits, and returns its last iterate.
        """
        sections, impact, defect = self._unpack(point, context)
        motions = [_sample(self.maps, each, self.nodes) for each in sections]
        energies = (trajectory_energy(self.maps, *each) for each in sections)
        penalties = (
            self._penalty(motion, each[2], context.case)
            for motion, each in zip(motions, sections, strict=True)
        )
        cost = (
            functools.reduce(operator.add, energies)
            + self.time_weight * impact.stroke.time
            + functools.reduce(operator.add, penalties)
            + self._terminal_penalty(impact, defect, context.case)
        )
        return Evaluation(cost=cost / _COST_UNIT, violation=jnp.zeros_like(cost))

    def rules_out(self, context: HitContext) -> Array:
        """Return whether the quadrotor provably cannot hit the ball at any time, () bool."""
        return is_too_far(context)

    def decode(self, point: Array, context: HitContext) -> HitPlan:
        """Convert the variables `point` to a plan; its violation is sampled 96 times per piece."""
        case = context.case
        sections, impact, defect = self._unpack(point, context)
        motion = _join([_sample(self.maps, each, _DECODE_NODES) for each in sections])
        along = jnp.stack(motion_excess(motion, case.gravity, case.limits))
        violation = jnp.maximum(largest_violation(along, impact, case), defect)
        trajectory = _join([proportional_trajectory(self.maps, *each) for each in sections])
        return HitPlan(
            trajectory=trajectory, gravity=case.gravity, stroke=impact.stroke, **pending(violation)
        ).with_heading(case)


def bat(rule: LiteRule = LiteRule(), **options: Any) -> LitePlanner:  # noqa: B008
    """Make the planner `bat`: a `BatHit`, minimised as by LBFGS-Lite in the paper's variables.

    `rule` stops the search, and `options` are fields of `BatHit`.
    """
    problem = BatHit(**options)
    plain = dataclasses.replace(problem, scale=(1.0,) * len(problem.scale))
    return LitePlanner(plain, _COST_UNIT, rule)


# The same planners without the state at which a swing starts.
bat_lite = functools.partial(bat, transition=False)
bat_lite_fitted = functools.partial(BatHit.planner, transition=False)
