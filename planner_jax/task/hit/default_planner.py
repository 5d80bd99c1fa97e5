"""The `exact` hit planner: its decision variables satisfy contact, impact and landing exactly.

Every plan meets the ball and returns it to the target; only inequalities are treated by penalties.
As in [Yu2023bat, eqs 11-12] the ball's velocities before and after the impact determine the
racket's normal and its speed along the normal. In [Yu2023bat, eqs 13-14] components of velocity and
thrust are variables, and their other components follow from divisions that may be by zero. Here the
flight time after the impact is a variable instead, which avoids these divisions.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.aim import aim_drag_free, aim_with_drag, apex_with_drag
from planner_jax.ball.flight import BallState, drag_free_apex, gravity_vector, solve_impact
from planner_jax.cost.penalty import apex_excess, hitting_speed_excess
from planner_jax.cost.quadrotor import Measure
from planner_jax.optimise.chain import ChainEnds, ChainProblem
from planner_jax.optimise.planner import SearchPlanner, pending
from planner_jax.optimise.settings import Attempt, LbfgsConfig, Stage
from planner_jax.optimise.shipped import StartNetwork, load_network
from planner_jax.robot.quadrotor import tangent_basis, velocity_in_air
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.context import HitContext, Impact, is_too_far, prepare_hit
from planner_jax.task.hit.plan import HitPlan, Stroke
from planner_jax.trajectory.polynomial import PiecewisePolynomial
from planner_jax.trajectory.proportional_minco import ProportionalMinco, proportional_minco

_PROPORTIONS = (0.2, 0.5) + (1.0,) * 10
_FEATURE_TIMES = (0.5, 0.75, 0.95)  # times of the ball that the network sees / landing time
# Settings of searches for any plan that keeps the limits, whatever its cost. `margin` is the
# relative distance from a limit at which penalties start. Penalties are evaluated at samples only
# (`nodes` a piece), so that the margin must cover higher values between samples.
_ANY_FEASIBLE = (("energy_weight", 1e-11), ("margin", 0.01), ("nodes", 8))
WITH_VELOCITIES = (*_ANY_FEASIBLE, ("velocities", True))
_SMALL_MARGIN = (*WITH_VELOCITIES, ("margin", 0.004), ("hinge_width", 0.02), ("nodes", 12))
_VELOCITY_SCALE = 2.0  # entry of `scale` for the variables that change velocities at waypoints
_PASSING = 0.9  # greatest speed of the racket in a starting point, divided by the speed limit
# Starting points, the most successful first. Columns: time of the impact / time at which the ball
# would land without a hit; flight time after the impact [s]; thrust per unit mass / gravity. A
# network may replace the first row by a predicted point; therefore the second row repeats it.
_GUESSES = np.array(
    [
        (0.92, 1.7, 1.2),
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


def state_at_impact(
    case: HitCase, ball_pos: Array, normal: Array, vel: Array, thrust: Array, jerk: Array
) -> Array:
    """Return position, velocity, acceleration and jerk (4, 3) of the quadrotor at an impact."""
    acc = thrust * normal + gravity_vector(case.gravity)
    if (air := case.limits.air) is not None:  # the thrust is along a + g e_3 + d (v - w)
        acc = acc - air.drag * velocity_in_air(air, vel)
    return jnp.stack([ball_pos - case.racket_height * normal, vel, acc, jerk])


def _hard(steps: int) -> LbfgsConfig:
    return LbfgsConfig(max_steps=steps, memory=12, tolerance=1e-6, patience=5)


def _smooth(steps: int, keep: int) -> Stage:
    return Stage(_hard(steps), WITH_VELOCITIES, keep, frozen=True)


# An attempt takes the cases that are unsolved so far. The first two attempts solve easy
# cases. Later attempts search for any plan that keeps the limits: the energy has hardly any weight.
# Rounds 3 and 4 start at a point that a network predicts. Rounds 5 and 6 start at all rows of
# `_GUESSES` after the first one. They hold the velocities at waypoints constant at first, and then
# continue only the searches of least cost. Rounds 4 and 6 take only cases whose greatest relative
# excess over a limit is below the attempt's field `within`.
_ATTEMPTS = (
    Attempt(1, LbfgsConfig(max_steps=3)),
    Attempt(1, LbfgsConfig(max_steps=60)),
    Attempt(1, _hard(150), WITH_VELOCITIES),
    Attempt(1, _hard(500), _SMALL_MARGIN, (Stage(_hard(800), WITH_VELOCITIES),), within=0.1),
    Attempt(12, _hard(240), WITH_VELOCITIES, (_smooth(50, keep=2),), first=1),
    Attempt(
        starts=12,
        solver=_hard(300),
        settings=_SMALL_MARGIN,
        stages=(
            _smooth(60, keep=6),
            _smooth(150, keep=2),
            Stage(_hard(400), WITH_VELOCITIES, keep=1),
        ),
        first=1,
        within=0.04,
    ),
)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class HitProblem(ChainProblem[HitCase, HitPlan]):
    """Minimum-snap hits whose decision variables satisfy the equations of the impact.

    The trajectory has M polynomial pieces and M - 1 waypoints. The 3 (M - 1) + 8 decision
    variables, in units of `scale`, are the waypoints' offsets from the smoothest trajectory; the
    logarithms of the impact time, of the ball's flight time after the impact and of the thrust at
    the impact; two velocities of the racket across its normal; and the jerk at the impact. With
    `velocities` the velocities at the waypoints are 3 (M - 1) further variables after the offsets.

    The two times determine the ball's velocities before and after the impact, such that the ball
    reaches the target. The ball's velocities determine the racket's normal and its speed along the
    normal [Yu2023bat, eqs 11-12]. The other variables then determine the racket's state.

    The cost is energy_weight * integral |snap|^2, plus the integral of smooth one-sided penalties
    on the limits [Yu2023bat, eq. 18a] and of the user's extra terms, plus impact_weight * penalties
    on apex and hitting speed [Yu2023bat, eqs 21 and 24a].

    Attributes:
        proportions: relative durations of the trajectory's polynomial pieces. The first pieces are
            short, so that the jerk can change fast and a hovering quadrotor starts to turn early.
        nodes: number of intervals of each piece, at whose ends penalties are evaluated.
        time_weight: weight of the time of the impact.
        energy_weight: [s^8/m^2], weight of the integral of |snap|^2.
        drag_after_impact: whether the ball has drag also after the impact.
        impact_weight: [s], weight of the penalties on apex and hitting speed.
        velocities: whether the velocities at the waypoints are variables.
        learned: whether a network predicts starting points of usual cases.
    """

    case_type = HitCase
    attempts = _ATTEMPTS
    package = "planner_jax.task.hit"
    num_end_variables = 8
    guess_table = _GUESSES
    refinements = ("nodes", "velocities")
    decode_nodes = (16, 16)
    proportions: tuple[float, ...] = _PROPORTIONS
    nodes: int = 4
    time_weight: float = 0.0
    energy_weight: float = 1e-8
    drag_after_impact: bool = False
    impact_weight: float = 0.3
    velocities: bool = False
    learned: bool = True

    @property
    def end_weight(self) -> float:
        """Weight [s] of the penalties on the returned ball's apex and on the hitting speed."""
        return self.impact_weight

    @property
    def maps(self) -> ProportionalMinco:
        """Constant matrices that map the states at both ends and the waypoints to a trajectory."""
        return proportional_minco(4, self.proportions, self.velocities)

    @property
    def num_offsets(self) -> int:
        """Number of waypoint variables: coordinates of positions, and of velocities if variable."""
        return self._num_places * (2 if self.velocities else 1)

    @property
    def _num_places(self) -> int:
        return 3 * (self.num_pieces - 1)

    def _fit_scale(self, scale: tuple[float, ...]) -> tuple[float, ...]:
        places = self._num_places
        if not self.velocities or len(scale) != places + self.num_end_variables:
            return scale
        return scale[:places] + (_VELOCITY_SCALE,) * places + scale[places:]

    def start_network(self, case: HitCase) -> StartNetwork | None:
        """Return the network that predicts a starting point; None if there is no such network.

        There is one network for planners with waypoint velocities as variables, and one for other
        planners; `proportions` and `scale` must have their defaults. There is none for cases with
        obstacles or other extra terms: the network ignores obstacles, and a search that starts on
        the wrong side of an obstacle also ends there.
        """
        if not self.learned or not (self.proportions == _PROPORTIONS and not case.extras):
            return None
        if self.scale != self._fit_scale(self._usual_scale):
            return None
        return load_network(self.package, "exact-12" + "-supple" * self.velocities)

    def start_features(self, context: HitContext) -> Array:
        """Return the inputs of the network for starting points: ball, target, state and limits."""
        case, landing = context.case, context.landing_time
        head, limits, stroke = case.head_state, case.limits, case.hit_limits
        balls = [context.path.at(share * landing) for share in _FEATURE_TIMES]
        acceleration = limits.acceleration
        if acceleration is None:  # approximately the thrust minus the weight
            thrust = 2.5 * case.gravity if limits.max_thrust is None else limits.max_thrust
            acceleration = jnp.maximum(thrust - case.gravity, 0.1 * case.gravity)
        numbers = (
            *(part for ball in balls for part in (ball.pos - head[0], ball.vel)),
            case.target - head[0],
            head[1],
            0.2 * head[2],
            0.02 * head[3],
            jnp.log(stroke.hitting_speed),
            jnp.stack(
                [
                    landing,
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

    def prepare(self, case: HitCase) -> HitContext:
        """Return the case with a table of the incoming ball's path, for evaluations of the cost."""
        return prepare_hit(case)

    def guess_ends(self, context: HitContext, num: int) -> Array:
        """Return the variables of the impact in `num` starting points, (num, 1, 8).

        The axis of length 1 counts the trajectory's segments: a hit has one, which ends at the
        impact. The 8 variables are the logarithms of the impact time, of the flight time after the
        impact and of the thrust, two speeds of the racket across its normal, and the jerk (3,).
        """
        fraction, flight_time, thrust = jnp.asarray(_GUESSES[:num], context.landing_time.dtype).T
        time = fraction * jnp.maximum(context.landing_time, 0.1)
        sizes = (time, flight_time, thrust * context.case.gravity)
        natural = jnp.pad(jnp.stack([jnp.log(each) for each in sizes], axis=1), ((0, 0), (0, 5)))
        if num > 2:  # in hard cases the racket must also move across its normal
            moving = jax.vmap(lambda each: self._set_passing_speed(each, context))(natural[2:])
            natural = jnp.concatenate([natural[:2], moving])
        return natural[:, None]

    def _set_passing_speed(self, natural: Array, context: HitContext) -> Array:
        impact, case = self.impact(natural, context), context.case
        start, time = case.head_state, impact.stroke.time
        vel = 2.0 * (impact.tail_state[0] - start[0]) / time - start[1]
        speed = jnp.sqrt(jnp.maximum(jnp.sum(vel * vel), 1e-12))
        vel = vel * jnp.minimum(1.0, _PASSING * case.limits.speed / speed)
        across = tangent_basis(impact.stroke.normal)
        return natural.at[3:5].set(jnp.stack([jnp.sum(vel * each) for each in across]))

    @property
    def held(self) -> np.ndarray | None:
        """Which of n variables are velocities at waypoints, (n,) bool; None if there are none.

        Some stages of a search hold these variables at their starting values.
        """
        if not self.velocities:
            return None
        index = np.arange(len(self.scale))
        return (index >= self._num_places) & (index < 2 * self._num_places)

    def meet(self, natural: Array, context: HitContext) -> ChainEnds:
        """Return the impact, at which the trajectory ends, and its excess over limits.

        `natural` (1, 8) are logarithms of the impact time, of the flight time after it and of the
        thrust, two speeds of the racket across its normal, and the jerk. The excess (5,) has two
        entries for the apex height of the returned ball, below and above its limits, and three
        entries for the quadrotor's speeds along x, y and z.
        """
        impact, limits = self.impact(natural[0], context), context.case.hit_limits
        apex = apex_excess(impact.apex, limits.min_apex, limits.max_apex)
        apex = jnp.where(impact.is_returned, apex, 1.0)
        speed = hitting_speed_excess(impact.tail_state[1], limits.hitting_speed)
        return ChainEnds(
            durations=impact.stroke.time[None],
            tail_states=impact.tail_state[None],
            total_time=impact.stroke.time,
            excess=jnp.concatenate([apex, speed]),
            contact=impact.stroke,
        )

    def relative_excess(self, excess: Array) -> Array:
        """Convert the excess (5,) of an impact, as `meet` returns it, to relative excesses.

        For each of three speeds v with the limit v_max, v^2 / v_max^2 - 1 becomes v / v_max - 1.
        The two entries for the apex height of the returned ball are already relative and stay.
        """
        return jnp.concatenate([excess[:2], Measure.ABOVE.relative(excess[2:])])

    def impact(self, natural: Array, context: HitContext) -> Impact:
        """Return the impact that its 8 variables describe.

        The variables are the logarithms of the impact time, of the ball's flight time after the
        impact and of the thrust, two speeds of the racket across its normal, and the jerk (3,).
        """
        case = context.case
        time, flight_time, thrust = jnp.exp(natural[0]), jnp.exp(natural[1]), jnp.exp(natural[2])
        ball = context.path.at(time)
        if case.lift is not None:
            from planner_jax.task.hit.spin import meet_spin

            normal, vel, after, apex, is_returned = meet_spin(case, ball, flight_time, natural[3:5])
            is_returned &= time <= context.path.times[-1]
        else:
            is_returned = True
            if self.drag_after_impact:
                numbers = flight_time, case.drag, case.gravity
                after = aim_with_drag(ball.pos, case.target, *numbers)
                apex = apex_with_drag(BallState(ball.pos, after), *numbers)
            else:
                after = aim_drag_free(ball.pos, case.target, flight_time, case.gravity)
                apex = drag_free_apex(BallState(ball.pos, after), case.gravity)
            normal, normal_speed = solve_impact(ball.vel, after, case.restitution)
            across_x, across_y = tangent_basis(normal)
            vel = normal_speed * normal + natural[3] * across_x + natural[4] * across_y
        tail_state = state_at_impact(case, ball.pos, normal, vel, thrust, natural[5:])
        stroke = Stroke(time, ball.pos, ball.vel, after, normal, flight_time)
        return Impact(stroke, tail_state, apex, is_returned)

    def rules_out(self, context: HitContext) -> Array:
        """Return whether the ball is provably never within the quadrotor's reach, () bool."""
        return is_too_far(context) if context.case.lift is None else jnp.zeros((), bool)

    def make_plan(
        self,
        trajectory: PiecewisePolynomial,
        ends: ChainEnds,
        violation: Array,
        context: HitContext,
    ) -> HitPlan:
        """Return the plan of a trajectory that ends with the impact `ends.contact`."""
        return HitPlan(
            trajectory=trajectory,
            gravity=context.case.gravity,
            air=context.case.limits.air,
            stroke=ends.contact,
            **pending(violation),
        ).with_heading(context.case)

    def replanner(self) -> SearchPlanner:
        """Return the planner by which `pj.replan` updates plans in flight."""
        from planner_jax.task.hit.replan import REMAINDER

        return REMAINDER.planner_of(self)
