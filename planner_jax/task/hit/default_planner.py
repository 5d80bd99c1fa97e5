"""The `exact` hit planner: contact, impact and landing are built into the decision variables.

No plan it returns can miss; only inequalities are left to penalties. The idea of solving the
impact for the racket's normal and normal speed is [Yu2023bat]'s (eqs 11-12); what is new is the
choice of variables, which needs none of the singular divisions of its eqs 13-14.
"""

import dataclasses
from typing import TYPE_CHECKING, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.aim import aim_drag_free, aim_with_drag, apex_with_drag
from planner_jax.ball.flight import BallState, drag_free_apex, gravity_vector, required_impact
from planner_jax.ball.prediction import LEAST_NODES, target_at
from planner_jax.core.choices import require_size
from planner_jax.cost.quadrotor import Measure
from planner_jax.optimise.chain import ChainEnds, ChainPlanner
from planner_jax.optimise.planner import OptimisedPlanner, pending
from planner_jax.optimise.settings import LbfgsConfig, Round, Settings, Stage
from planner_jax.optimise.shipped import StartNetwork, shipped_network
from planner_jax.robot.quadrotor import tangent_basis
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.context import (
    HitContext,
    Impact,
    apex_excess,
    hitting_speed_excess,
    is_too_far,
    prepare_hit,
)
from planner_jax.task.hit.plan import HitPlan, Stroke
from planner_jax.trajectory.polynomial import PiecewisePolynomial
from planner_jax.trajectory.proportional_minco import ProportionalMinco, proportional_minco

if TYPE_CHECKING:
    from planner_jax.task.hit.replan import ReplanHit

_PROPORTIONS = (0.2, 0.5) + (1.0,) * 10
_SEEN = (0.5, 0.75, 0.95)  # of the landing time, at which the network's features take the ball
# Stages of rounds that look for any feasible plan. The velocities at the waypoints are for what a
# network or a search without them has brought near; alone they lead astray. At last, limits that
# bind all along the way have to leave no margin more than what peaks between nodes take.
_HARD = LbfgsConfig(memory=12, tolerance=1e-6, patience=5)
_ANY_FEASIBLE = (("energy_weight", 1e-11), ("margin", 0.01), ("nodes", 8))
_SMOOTH = (*_ANY_FEASIBLE, ("learned", False))
SUPPLE = (*_ANY_FEASIBLE, ("velocities", True))
_TO_THE_LIMIT = (
    ("energy_weight", 1e-11),
    ("margin", 0.004),
    ("hinge_width", 0.02),
    ("nodes", 12),
    ("velocities", True),
)


def _hard_stage(steps: int, settings: Settings, keep: int) -> Stage:
    return Stage(dataclasses.replace(_HARD, max_steps=steps), settings, keep)


_VELOCITY_SCALE = 2.0  # of the offsets of velocities; measured ones lie between 0.6 and 7
_PASSING = 0.9  # of the speed limit, at most, is how fast a guess passes the ball


# Starting points, best first: impact time over landing time, flight time afterwards [s],
# thrust over g. The first serves every easy case; the others hit earlier, flatter or harder.
_GUESSES = np.array(
    [
        (0.92, 1.7, 1.2),
        (0.75, 1.7, 1.2),
        (0.75, 1.3, 0.9),
        (0.85, 1.3, 1.2),
        (0.85, 2.1, 0.9),
        (0.65, 1.7, 1.2),
        (0.95, 1.3, 0.9),
        (0.65, 2.1, 1.4),
        (0.95, 1.3, 2.3),
        (0.70, 1.4, 2.2),
        (0.85, 1.2, 2.2),
        (0.65, 1.7, 2.2),
    ]
)


def start_features(context: HitContext) -> Array:
    """Return the inputs of the network, (F,): ball, target, quadrotor and limits."""
    case, lands = context.case, context.landing_time
    head, limits, stroke = case.head_state, case.limits, case.hit_limits
    seen = [target_at(context.path, share * lands) for share in _SEEN]
    acceleration = limits.acceleration
    if acceleration is None:  # about what the thrust leaves beside the weight
        thrust = 2.5 * case.gravity if limits.max_thrust is None else limits.max_thrust
        acceleration = jnp.maximum(thrust - case.gravity, 0.1 * case.gravity)
    numbers = (
        *(part for ball in seen for part in (ball.pos - head[0], ball.vel)),
        case.target - head[0],
        head[1],
        0.2 * head[2],
        0.02 * head[3],
        jnp.log(stroke.hitting_speed),
        jnp.stack(
            [
                lands,
                head[0, 2] - limits.min_height,
                *map(jnp.log, (limits.speed, acceleration, limits.body_rate, case.gravity)),
                case.restitution,
                case.racket_height,
                case.drag,
                stroke.min_apex,
                stroke.max_apex,
            ]
        ),
    )
    return jnp.concatenate(numbers)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ExactHit(ChainPlanner[HitCase, HitPlan]):
    """Minimum-snap hits with the impact eliminated exactly.

    Decision variables, n = 3 (M - 1) + 8, each in units of `scale`: whitened waypoint offsets
    y, log impact time, log flight time after it, log thrust, two racket velocities across the
    normal, jerk at the impact. From the two times follow the ball's velocities before and
    after (target reached exactly), from these normal and normal speed of the racket
    [Yu2023bat, eqs 11-12], and so position, velocity and acceleration at the impact. With
    `velocities` the velocities at the waypoints are 3 (M - 1) variables more, behind the offsets.

    Cost: energy_weight * integral |snap|^2 + integral of the smoothed hinges of the limits
    [Yu2023bat, eq. 18a], and of the case's extras + hinges of apex (eq. 21) and hitting speed
    (eq. 24).
    """

    case_type = HitCase
    package = "planner_jax.task.hit"
    num_end_variables = 8
    guess_table = _GUESSES
    decode_nodes = (16, 16)
    # Relative durations of the pieces. The first are short, because a hovering quadrotor has
    # to begin to turn at once and its jerk is continuous.
    proportions: tuple[float, ...] = _PROPORTIONS
    nodes: int = 4  # penalty intervals a piece
    time_weight: float = 0.0
    energy_weight: float = 1e-8
    num_table_nodes: int = 36
    drag_after_impact: bool = False
    impact_weight: float = 0.3  # [s], of apex and hitting-speed hinges beside the integrals
    # The first two solve what is easy. Where limits bind all along the way, energy is worth
    # nothing any more and the margin has to give: the others look for any feasible plan. The third
    # and the fourth begin where a network has learnt that limits can hold, the fourth, which is
    # longer, if little is missing. The last two begin at fixed guesses, for cases and sizes that no
    # network knows: long from those from where a short search says that it is worth it, and at
    # last, at twice the price a case, if little is missing.
    rounds: tuple[Round, ...] = (
        Round(starts=1, solver=LbfgsConfig(max_steps=3)),
        Round(starts=1, solver=LbfgsConfig(max_steps=60)),
        Round(starts=1, solver=dataclasses.replace(_HARD, max_steps=150), settings=SUPPLE),
        Round(
            starts=1,
            within=0.1,
            solver=dataclasses.replace(_HARD, max_steps=500),
            settings=_TO_THE_LIMIT,
            stages=(_hard_stage(800, SUPPLE, keep=1),),
        ),
        Round(
            starts=12,
            solver=dataclasses.replace(_HARD, max_steps=240),
            settings=SUPPLE,
            stages=(_hard_stage(50, _SMOOTH, keep=2),),
        ),
        Round(
            starts=12,
            within=0.04,
            solver=dataclasses.replace(_HARD, max_steps=300),
            settings=_TO_THE_LIMIT,
            stages=(
                _hard_stage(60, _SMOOTH, keep=6),
                _hard_stage(150, _SMOOTH, keep=2),
                _hard_stage(400, SUPPLE, keep=1),
            ),
        ),
    )
    velocities: bool = False  # whether the velocities at the waypoints are variables, too
    learned: bool = True  # whether a network makes the first guess, where there is one

    def __post_init__(self) -> None:
        super().__post_init__()
        require_size("num_table_nodes", self.num_table_nodes, LEAST_NODES)

    @property
    def end_weight(self) -> float:
        """Weight [s] of the hinges at the impact."""
        return self.impact_weight

    @property
    def maps(self) -> ProportionalMinco:
        """Constant maps from boundary and offsets to the trajectory."""
        return proportional_minco(4, self.proportions, self.velocities)

    @property
    def num_offsets(self) -> int:
        """Number of variables of the waypoints."""
        return self._num_places * (2 if self.velocities else 1)

    @property
    def _num_places(self) -> int:
        """Number of variables of the waypoints' positions."""
        return 3 * (self.num_pieces - 1)

    def _fit_scale(self, scale: tuple[float, ...]) -> tuple[float, ...]:
        """Return a scale with units for the velocities at the waypoints, if these are variables."""
        places = self._num_places
        if not self.velocities or len(scale) != places + self.num_end_variables:
            return scale
        return scale[:places] + (_VELOCITY_SCALE,) * places + scale[places:]

    def start_network(self, case: HitCase) -> StartNetwork | None:
        """Return the network for the first guess; there are two for the shipped sizes.

        The network of points without velocities has learnt where every limit holds at little
        energy, the other one where limits bind along the whole trajectory. Around obstacles there
        is none, because the side on which a search starts decides where it can end.
        """
        is_usual = self.proportions == _PROPORTIONS and not case.extras
        if not self.learned or not is_usual:
            return None
        if self.scale != self._fit_scale(self._usual_scale):
            return None
        return shipped_network(self.package, "exact-12" + "-supple" * self.velocities)

    def start_features(self, context: HitContext) -> Array:
        """Return the inputs of the network, (F,)."""
        return start_features(context)

    def prepare(self, case: HitCase) -> HitContext:
        """Return the incoming ball's table; see `prepare_hit`."""
        return prepare_hit(case, self.num_table_nodes)

    def guess_ends(self, context: HitContext, num: int) -> Array:
        """Return impacts at a few impact times, flight times and thrusts, (num, 1, 8)."""
        fraction, flight_time, thrust = jnp.asarray(_GUESSES[:num], context.landing_time.dtype).T
        times = jnp.stack(
            [
                jnp.log(fraction * jnp.maximum(context.landing_time, 0.1)),
                jnp.log(flight_time),
                jnp.log(thrust * context.case.gravity),
            ],
            axis=1,
        )
        natural = jnp.pad(times, ((0, 0), (0, 5)))
        if num > 1:  # what is hard is hit in passing
            passing = jax.vmap(lambda own: self._in_passing(own, context))(natural[1:])
            natural = jnp.concatenate([natural[:1], passing])
        return natural[:, None]

    def _in_passing(self, natural: Array, context: HitContext) -> Array:
        """Return a guess (8,) whose racket is as fast across the normal as an even acceleration.

        The acceleration leads from the start to the impact, no faster than allowed.
        """
        impact, case = self.impact(natural, context), context.case
        start, time = case.head_state, impact.stroke.time
        vel = 2.0 * (impact.tail_state[0] - start[0]) / time - start[1]
        speed = jnp.sqrt(jnp.maximum(jnp.sum(vel * vel), 1e-12))
        vel = vel * jnp.minimum(1.0, _PASSING * case.limits.speed / speed)
        across = tangent_basis(impact.stroke.normal)
        return natural.at[3:5].set(jnp.stack([jnp.sum(vel * each) for each in across]))

    def carried(self, point: Array, before: OptimisedPlanner) -> Array:
        """Return a point (n,) without velocities as one with the smoothest velocities."""
        if self.velocities == cast(ExactHit, before).velocities:
            return point
        places, own = point[: self._num_places], point[self._num_places :]
        return jnp.concatenate([places, jnp.zeros_like(places), own])

    def meet(self, natural: Array, context: HitContext) -> ChainEnds:
        """Return the impact that the variables (1, 8) describe, as the end of the segment.

        Its excess (5,) is that of the apex, and of the squares of the hitting speed.
        """
        impact, limits = self.impact(natural[0], context), context.case.hit_limits
        apex = apex_excess(impact.apex, limits.min_apex, limits.max_apex)
        speed = hitting_speed_excess(impact.tail_state[1], limits.hitting_speed)
        return ChainEnds(
            durations=impact.stroke.time[None],
            tail_states=impact.tail_state[None],
            total_time=impact.stroke.time,
            excess=jnp.concatenate([apex, speed]),
            contact=impact.stroke,
        )

    def relative_excess(self, excess: Array) -> Array:
        """Return the excess (5,) at the impact, the squares of the speeds as ratios."""
        return jnp.concatenate([excess[:2], Measure.ABOVE.relative(excess[2:])])

    def impact(self, natural: Array, context: HitContext) -> Impact:
        """Return the impact that the end variables (8,) describe.

        These are log T, log t_post, log thrust, two tangential speeds [m/s] and jerk [m/s^3].
        """
        case = context.case
        time, flight_time, thrust = jnp.exp(natural[0]), jnp.exp(natural[1]), jnp.exp(natural[2])
        ball = target_at(context.path, time)
        if self.drag_after_impact:
            after = aim_with_drag(ball.pos, case.target, flight_time, case.drag, case.gravity)
            apex = apex_with_drag(BallState(ball.pos, after), flight_time, case.drag, case.gravity)
        else:
            after = aim_drag_free(ball.pos, case.target, flight_time, case.gravity)
            apex = drag_free_apex(BallState(ball.pos, after), case.gravity)
        normal, normal_speed = required_impact(ball.vel, after, case.restitution)
        across_x, across_y = tangent_basis(normal)
        tail_state = jnp.stack(
            [
                ball.pos - case.racket_height * normal,
                normal_speed * normal + natural[3] * across_x + natural[4] * across_y,
                thrust * normal + gravity_vector(case.gravity),
                natural[5:],
            ]
        )
        stroke = Stroke(
            time=time,
            ball_pos=ball.pos,
            ball_vel=ball.vel,
            ball_vel_after=after,
            normal=normal,
            flight_time=flight_time,
        )
        return Impact(stroke=stroke, tail_state=tail_state, apex=apex)

    def rules_out(self, context: HitContext) -> Array:
        """Return whether the ball is never within reach."""
        return is_too_far(context)

    def make_plan(
        self,
        trajectory: PiecewisePolynomial,
        ends: ChainEnds,
        violation: Array,
        context: HitContext,
    ) -> HitPlan:
        """Return the plan of a trajectory and its stroke."""
        return HitPlan(
            trajectory=trajectory,
            gravity=context.case.gravity,
            stroke=ends.contact,
            **pending(violation),
        )

    def replanner(self) -> "ReplanHit":
        """Return the `ReplanHit` that continues from this planner's plans; see `pj.replan`."""
        from planner_jax.task.hit.replan import ReplanHit

        return ReplanHit(self)
