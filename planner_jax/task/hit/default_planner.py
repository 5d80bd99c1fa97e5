"""The `exact` hit planner: contact, impact and landing are built into the decision variables.

No plan it returns can miss; only inequalities are left to penalties. The idea of solving the
impact for the racket's normal and normal speed is paper 002's (eqs 11-12); what is new is the
choice of variables, which needs none of the singular divisions of its eqs 13-14.
"""

import dataclasses
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.aim import aim_drag_free, aim_with_drag, apex_with_drag
from planner_jax.ball.flight import (
    BallState,
    drag_free_apex,
    gravity_vector,
)
from planner_jax.ball.impact import required_impact
from planner_jax.ball.prediction import LEAST_NODES, target_at
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import require_settings
from planner_jax.cost.along import Along, integrate_along
from planner_jax.cost.contact import apex_excess, hitting_speed_excess
from planner_jax.cost.penalty import smoothed_hinge
from planner_jax.cost.quadrotor import Measure, flight_along, greatest_excess, limits_along
from planner_jax.optimise.evaluation import Evaluation
from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.learned_start import StartNetwork, cheaper_start, shipped_network
from planner_jax.optimise.newton import Curvature
from planner_jax.optimise.planner import OptimisedPlanner, pending
from planner_jax.optimise.problem import Round, Settings, Stage
from planner_jax.optimise.scaling import shipped_scale
from planner_jax.robot.quadrotor import tangent_basis
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.context import HitContext, Impact, prepare_hit
from planner_jax.task.hit.plan import HitPlan, Stroke
from planner_jax.task.hit.reach import is_too_far
from planner_jax.task.segments import BETWEEN_NODES, segments_curvature
from planner_jax.trajectory.proportional_minco import (
    ProportionalMinco,
    boundary_energy,
    boundary_rows,
    offset_energy,
    proportional_minco,
    proportional_trajectory,
    sample_motion,
)

_ORDER = 4  # minimum snap
_PROPORTIONS = (0.2, 0.5) + (1.0,) * 10
_SEEN = (0.5, 0.75, 0.95)  # of the landing time, at which a learned start looks at the ball
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
_DECODE_NODES = 16  # intervals a piece at which a finished plan is looked at


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
    """What a learned start is made from, (F,): ball, target, quadrotor and limits."""
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
class ExactHit(OptimisedPlanner):
    """Minimum-snap hits with the impact eliminated exactly.

    Decision variables, n = 3 (M - 1) + 8, each in units of `scale`: whitened waypoint offsets
    y, log impact time, log flight time after it, log thrust, two racket velocities across the
    normal, jerk at the impact. From the two times follow the ball's velocities before and
    after (target reached exactly), from these normal and normal speed of the racket (paper
    002, eqs 11-12), and so position, velocity and acceleration at the impact. With `velocities`
    those at the waypoints are 3 (M - 1) variables more, behind the offsets.

    Cost: energy_weight * integral |snap|^2 + integral of the smoothed hinges of the limits
    (paper 002, eq. 18a), and of the case's extras + hinges of apex (eq. 21) and hitting speed
    (eq. 24).
    """

    case_type = HitCase
    subspace = 0
    # Relative durations of the pieces. The first are short, because a hovering quadrotor has
    # to begin to turn at once and its jerk is continuous.
    proportions: tuple[float, ...] = _PROPORTIONS
    nodes: int = 4  # penalty intervals a piece
    num_table_nodes: int = 36
    drag_after_impact: bool = False
    energy_weight: float = 1e-8
    margin: float = 0.03  # penalties begin this far inside a limit, relative
    hinge_width: float = 0.1
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
    scale: tuple[float, ...] = ()
    velocities: bool = False  # whether those at the waypoints are variables, too
    learned: bool = True  # whether a network makes the first guess, where there is one

    def __post_init__(self) -> None:
        require_settings(self)
        require_size("num_table_nodes", self.num_table_nodes, LEAST_NODES)
        if len(self.proportions) < 2 or not all(0.0 < x < np.inf for x in self.proportions):
            raise ArgumentError("proportions", "of >= 2 pieces, finite and > 0", self.proportions)
        if not self.scale:
            object.__setattr__(self, "scale", shipped_scale(__package__, self._name))
        if self.velocities and len(self.scale) == self._num_places + 8:
            object.__setattr__(self, "scale", self._with_velocities(self.scale))
        if len(self.scale) != self.num_offsets + 8:
            rule = f"of {self.num_offsets + 8} numbers"
            raise ArgumentError("scale", rule, len(self.scale))

    @property
    def num_pieces(self) -> int:
        """M."""
        return len(self.proportions)

    @property
    def _name(self) -> str:
        """Of what is shipped for so many pieces."""
        return f"exact-{self.num_pieces}"

    @property
    def _network(self) -> StartNetwork | None:
        """That makes the first guess; there are two for the shipped sizes.

        The one of points without velocities has learnt where every limit holds at little energy,
        the other one where limits bind all along the way.
        """
        if not self.learned or self.proportions != _PROPORTIONS:
            return None
        usual = shipped_scale(__package__, self._name)
        if self.scale != (self._with_velocities(usual) if self.velocities else usual):
            return None
        return shipped_network(__package__, self._name + "-supple" * self.velocities)

    def _with_velocities(self, scale: tuple[float, ...]) -> tuple[float, ...]:
        """A scale without those of the velocities, with them."""
        places = self._num_places
        return scale[:places] + (_VELOCITY_SCALE,) * places + scale[places:]

    @property
    def maps(self) -> ProportionalMinco:
        """Constant maps from boundary and offsets to the trajectory."""
        return proportional_minco(_ORDER, self.proportions, self.velocities)

    @property
    def num_offsets(self) -> int:
        """Number of variables of the waypoints."""
        return self._num_places * (2 if self.velocities else 1)

    @property
    def _num_places(self) -> int:
        """Number of variables of the waypoints' places."""
        return 3 * (self.num_pieces - 1)

    def prepare(self, case: HitCase) -> HitContext:
        """The incoming ball's table; see `prepare_hit`."""
        return prepare_hit(case, self.num_table_nodes)

    def guesses(self, context: HitContext, num: int) -> Array:
        """Smooth trajectories to a few impact times, flight times and thrusts, (num, n)."""
        if num > len(_GUESSES):
            raise ArgumentError("starts", f"<= {len(_GUESSES)}", num)
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
        natural = jnp.pad(natural, ((0, 0), (self.num_offsets, 0)))
        points = natural / jnp.asarray(self.scale, natural.dtype)
        network = self._network
        # Around obstacles the side on which a search begins decides where it can end.
        if network is None or context.case.extras:
            return points
        learned = points[0] + network(start_features(context))
        cost = lambda point: self.objective(point, context).cost  # noqa: E731
        return points.at[0].set(cheaper_start(cost, points[0], learned))

    def _in_passing(self, natural: Array, context: HitContext) -> Array:
        """A guess of `impact`'s variables (8,) with the racket as fast across as the way there is.

        That is where an even acceleration from the start leads, and no faster than allowed.
        """
        impact, case = self.impact(natural, context), context.case
        start, time = case.head_state, impact.stroke.time
        vel = 2.0 * (impact.tail_state[0] - start[0]) / time - start[1]
        speed = jnp.sqrt(jnp.maximum(jnp.sum(vel * vel), 1e-12))
        vel = vel * jnp.minimum(1.0, _PASSING * case.limits.speed / speed)
        across = tangent_basis(impact.stroke.normal)
        return natural.at[3:5].set(jnp.stack([jnp.sum(vel * each) for each in across]))

    def carried(self, point: Array, before: Self) -> Array:
        """A point (n,) without velocities as one with the smoothest ones."""
        if self.velocities == before.velocities:
            return point
        places, own = point[: self._num_places], point[self._num_places :]
        return jnp.concatenate([places, jnp.zeros_like(places), own])

    def impact(self, natural: Array, context: HitContext) -> Impact:
        """The impact that the variables after the waypoint offsets describe.

        Args:
            natural: (8,) log T, log t_post, log thrust, two tangential speeds [m/s], jerk
                [m/s^3].
            context: of the case.
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

    def _split(self, point: Array) -> tuple[Array, Array]:
        """Whitened offsets (M - 1, 3) and the variables after them, (8,), at a point."""
        natural = point * jnp.asarray(self.scale, point.dtype)
        return natural[: self.num_offsets].reshape(-1, 3), natural[self.num_offsets :]

    def _unpack(self, point: Array, context: HitContext) -> tuple[Array, Array, Array, Impact]:
        """Whitened offsets, boundary rows, piece duration and impact at a point."""
        offsets, natural = self._split(point)
        impact = self.impact(natural, context)
        duration = impact.stroke.time / self.num_pieces
        rows = boundary_rows(context.case.head_state, impact.tail_state, duration)
        return offsets, rows, duration, impact

    def _at_impact(self, impact: Impact, context: HitContext) -> Array:
        """Excess at the impact, (5,): apex, and squares of the hitting speed."""
        limits = context.case.hit_limits
        return jnp.concatenate(
            [
                apex_excess(impact.apex, limits.min_apex, limits.max_apex),
                hitting_speed_excess(impact.tail_state[1], limits.hitting_speed),
            ]
        )

    def _along(self, nodes: int, case: HitCase) -> Along:
        """Penalties along the way."""
        return flight_along(self.maps, nodes, case, self.margin, self.hinge_width)

    def objective(self, point: Array, context: HitContext) -> Evaluation:
        """Cost, and the largest excess at the penalty nodes (squares over squares)."""
        offsets, natural = self._split(point)
        rows, duration, core, at_impact = self.ends(natural, context)
        penalties, worst = integrate_along(
            self._along(self.nodes, context.case),
            jnp.concatenate([rows, offsets])[None],
            duration[None],
            (context.case.gravity, context.case.limits, context.case.extras),
        )
        energy = self.energy_weight * offset_energy(self.maps, offsets, duration)
        violation = jnp.maximum(worst[0], at_impact) + BETWEEN_NODES
        return Evaluation(cost=penalties[0] + core + energy, violation=violation)

    def ends(self, natural: Array, context: HitContext) -> tuple[Array, Array, Array, Array]:
        """What the variables after the waypoint offsets make of the objective.

        Args:
            natural: (8,) as for `impact`.
            context: of the case.

        Returns:
            Boundary rows (8, 3), mean duration of a piece [s], the cost of the ends, and the
            greatest excess at the impact.
        """
        impact = self.impact(natural, context)
        duration = impact.stroke.time / self.num_pieces
        rows = boundary_rows(context.case.head_state, impact.tail_state, duration)
        at_impact = self._at_impact(impact, context)
        energy = self.energy_weight * boundary_energy(self.maps, rows, duration)
        return rows, duration, self._hinges(at_impact) + energy, jnp.max(at_impact)

    def curved(self, point: Array, context: HitContext) -> Curvature:
        """Evaluation, gradient, and second derivatives; see `segments_curvature`."""
        offsets, natural = self._split(point)

        def ends(natural: Array) -> tuple[Array, Array, Array, Array]:
            rows, duration, core, at_impact = self.ends(natural[0], context)
            return rows[None], duration[None], core, at_impact

        rows, duration, core, at_impact = self.ends(natural, context)
        return segments_curvature(
            self.maps,
            self._along(self.nodes, context.case),
            ends,
            (rows[None], duration[None], core, at_impact),
            natural[None],
            offsets[None],
            jnp.asarray(self.scale, point.dtype),
            (context.case.gravity, context.case.limits, context.case.extras),
            self.energy_weight,
            jnp.ones(1, bool),
        )

    def _hinges(self, at_impact: Array) -> Array:
        hinges = smoothed_hinge(at_impact + self.margin, self.hinge_width)
        return self.impact_weight * jnp.sum(hinges)

    def residuals(self, point: Array, context: HitContext) -> Array:
        """Squared hinges and energy as residuals, for `measure_scale`.

        The smoothed hinge bends at most with 3 / (2 hinge_width); the residuals bend alike.
        """
        offsets, rows, duration, impact = self._unpack(point, context)
        along = self._along(self.nodes, context.case)
        columns = jnp.concatenate([rows, offsets])
        motion = sample_motion(self.maps, self.nodes, columns, duration, along.orders)
        given = (context.case.gravity, context.case.limits, context.case.extras)
        excess = jnp.stack(limits_along(motion, given))
        at_impact = self._at_impact(impact, context)
        bend = jnp.sqrt(1.5 / self.hinge_width)
        inside = jnp.maximum(excess + jnp.asarray(along.margins, point.dtype)[:, None], 0.0)
        inside = inside * jnp.sqrt(duration * jnp.asarray(along.weights(), point.dtype))
        impact_part = jnp.sqrt(self.impact_weight) * jnp.maximum(at_impact + self.margin, 0.0)
        energy_unit = jnp.sqrt(self.energy_weight / duration ** (2 * _ORDER - 1))
        smooth = energy_unit * np.sqrt(self.maps.offset_energy) * offsets
        return jnp.concatenate([bend * inside.ravel(), bend * impact_part, smooth.ravel()])

    def rules_out(self, context: HitContext) -> Array:
        """Whether the ball is never within reach."""
        return is_too_far(context)

    def decode(self, point: Array, context: HitContext) -> HitPlan:
        """The plan at a point, its violation looked for at 16 nodes a piece and between them."""
        offsets, rows, duration, impact = self._unpack(point, context)
        along = greatest_excess(
            self.maps,
            _DECODE_NODES,
            jnp.concatenate([rows, offsets])[None],
            duration[None],
            context.case,
        )
        at_impact = self._at_impact(impact, context)
        hitting_speed = Measure.ABOVE.relative(at_impact[2:])
        violation = jnp.max(jnp.concatenate([*along, hitting_speed, at_impact[:2]]))
        return HitPlan(
            trajectory=proportional_trajectory(self.maps, rows, offsets, duration),
            gravity=context.case.gravity,
            stroke=impact.stroke,
            **pending(violation),
        )

    def replanner(self) -> Any:
        """The `ReplanHit` that goes on from this planner's plans; see `pj.replan`."""
        from planner_jax.task.hit.replan import ReplanHit

        return ReplanHit(self)
