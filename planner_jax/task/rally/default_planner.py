"""The `exact` rally planner: K hits in one search; every contact and every place is met exactly.

The ball's path up to the first hit is predicted. From then on the decision variables determine it:
the place and the time of the next contact follow from the hit before. So each hit leaves a next hit
that keeps all limits, too.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.ball.arc import fly_between
from planner_jax.ball.flight import BallState, drag_free_fall_time, solve_impact
from planner_jax.core.arithmetic import reciprocal
from planner_jax.cost.penalty import apex_excess, hitting_speed_excess
from planner_jax.cost.quadrotor import Measure
from planner_jax.optimise.chain import ChainEnds, ChainProblem
from planner_jax.optimise.planner import SearchPlanner, pending
from planner_jax.optimise.settings import Attempt, Curvature, LbfgsConfig
from planner_jax.optimise.shipped import load_scale
from planner_jax.robot.quadrotor import tangent_basis
from planner_jax.task.hit.context import HitContext, is_too_far, prepare_hit
from planner_jax.task.hit.default_planner import state_at_impact
from planner_jax.task.hit.plan import Stroke
from planner_jax.task.rally.case import RallyCase
from planner_jax.task.rally.metric import Metric, load_metric
from planner_jax.task.rally.plan import RallyPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial
from planner_jax.trajectory.proportional_minco import boundary_energy, boundary_rows

_PROPORTIONS = (0.3,) + (1.0,) * 5
# Starting points, the best first. Columns: height of the first contact between the least and the
# greatest, apex between the least and the greatest, thrust per unit mass / gravity at the contacts.
_GUESSES = np.array(
    [
        (0.5, 0.5, 1.1),
        (0.2, 0.8, 1.2),
        (0.8, 0.3, 1.0),
        (0.2, 0.4, 1.4),
        (0.8, 0.8, 0.8),
        (0.5, 0.9, 1.8),
    ]
)
# Weight of the squares of variables without another effect, so that the Hessian has an inverse.
_UNUSED_WEIGHT = 0.005
_LEAST_RANGE = 0.01  # [m], by which a distance from the middle of a smaller range is divided
_SHORTEST = 0.1  # [s], least duration of a flight in a starting point
# Settings of searches for any plan that keeps the limits. All costs are a tenth, so that the
# penalties weigh more. Their ratios stay: without `apex_weight` a plan may end in too short a
# flight, after which no hit is possible.
_ANY_FEASIBLE = (
    ("energy_weight", 5e-9),
    ("place_weight", 3e-4),
    ("apex_weight", 3e-4),
    ("margin", 0.02),
)
_HARD = LbfgsConfig(max_steps=200, memory=12, tolerance=1e-6, patience=5)
# An attempt takes the cases that are unsolved so far.
ATTEMPTS = (
    Attempt(1, LbfgsConfig(max_steps=12)),
    Attempt(1, LbfgsConfig(max_steps=60)),
    Attempt(1, _HARD, _ANY_FEASIBLE),
    Attempt(5, _HARD, _ANY_FEASIBLE, first=1),
)
# The first attempt in the measured metric. A re-plan, whose start is no guess, uses `ATTEMPTS[0]`.
_SHORT = Attempt(1, LbfgsConfig(max_steps=5))


@struct.dataclass
class RallyContext(HitContext):
    """One case with its ball's predicted path up to the first hit."""

    case: RallyCase  # pyright: ignore[reportIncompatibleVariableOverride]


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class RallyProblem(ChainProblem[RallyCase, RallyPlan]):
    """Rallies of K minimum-snap segments; each segment ends at a hit.

    A segment of M polynomial pieces has 3 (M - 1) + 11 decision variables in units of `scale`:
    offsets of its waypoints; logarithms of its duration, of the ball's flight time after the hit,
    and of the thrust; two velocities of the racket across its normal; the jerk; and the place (3,)
    to which the ball is sent. A place variable x moves the place from the centre of its box by
    x / sqrt(1 + x^2) half widths. The ball flies from hit to hit as long as the segment lasts, so
    that the flight time is a variable of the last hit only. The units in `measured_scales.json` are
    rough values that were set by hand. For two hits `metric_exact-6.npz` adds a measured metric:
    the search runs in combinations of variables along which the cost has similar curvature. It also
    has the typical displacement of an optimum from the first guess.

    The cost is energy_weight * integral |snap|^2, plus the integral of smooth one-sided penalties
    on the limits and of the user's extra terms, plus contact_weight * penalties at the contacts.
    Three further terms keep the rally going: place_weight * squares of the place variables and of
    the first contact's height off the middle; apex_weight * squares of the apexes off the middle;
    and next_weight * energy_weight * the least energy of a next segment, which ends at standstill,
    level, below the last place, or below `home` after twice the flight time. Without the last term,
    the last hit may end in a state from which no further hit keeps the limits.

    Attributes:
        contact_weight: [s], weight of the penalties at the contacts.
        place_weight: weight of the squares of the place variables.
        apex_weight: weight of the squares of the apexes off the middle.
        next_weight: weight of the least energy of a next segment, a multiple of `energy_weight`.
        metric: whether the measured metric of the variables of two hits is used.
    """

    case_type = RallyCase
    attempts = ATTEMPTS
    package = "planner_jax.task.rally"
    num_end_variables = 11
    guess_table = _GUESSES
    weights = (*ChainProblem.weights, "place_weight", "apex_weight")
    proportions: tuple[float, ...] = _PROPORTIONS
    nodes: int = 6
    time_weight: float = 0.0
    energy_weight: float = 5e-8
    contact_weight: float = 0.3
    place_weight: float = 3e-3
    apex_weight: float = 3e-3
    next_weight: float = 3.0
    metric: bool = True

    @property
    def end_weight(self) -> float:
        """Weight [s] of the penalties on apex, hitting speed and height of the first contact."""
        return self.contact_weight

    def _metric(self, size: int) -> Metric | None:
        name = f"{self.shipped_name}-{len(_PROPORTIONS)}"
        if not self.metric or self.scale != load_scale(self.package, name):
            return None
        metric = load_metric(self.package, name)
        return metric if metric.shift.size == size else None

    def _in_units(self, point: Array) -> Array:
        """Return the variables (n,) in units of `scale` at a point (n,) of the search."""
        metric = self._metric(point.size)
        return point if metric is None else _multiply(metric.factor, point)

    def split(self, point: Array) -> tuple[Array, Array]:
        """Split a point: waypoint offsets (K, M - 1, 3), variables (K, 11) of K hits."""
        return super().split(self._in_units(point))

    def join(self, offsets: Array, natural: Array) -> Array:
        """Return the point (n,) with these waypoint offsets and variables; inverts `split`."""
        point = super().join(offsets, natural)
        metric = self._metric(point.size)
        return point if metric is None else _multiply(metric.inverse, point)

    def guesses(self, context: RallyContext, num: int) -> Array:
        """Return starting points (num, n) of the search.

        The waypoint offsets of a point are zero. Only with a metric, the first point is moved from
        there by the median displacement of the optimum that was measured with the metric.
        """
        points = super().guesses(context, num)
        metric = self._metric(points.shape[1])
        if metric is None:
            return points
        points = points.at[0].add(jnp.asarray(metric.shift, points.dtype))
        return jax.vmap(functools.partial(_multiply, metric.inverse))(points)

    def fit_attempt(
        self,
        attempt: Attempt,
        cases: RallyCase,
        attempts: tuple[Attempt, ...],  # noqa: ARG002
    ) -> Attempt:
        """Return an attempt, with fewer iterations if there is a metric."""
        size = cases.places.shape[-2] * len(self.scale)
        is_short = attempt == ATTEMPTS[0] and self._metric(size) is not None
        return _SHORT if is_short else attempt

    def curvature_at(self, point: Array, context: RallyContext) -> Curvature:
        """Return evaluation, gradient, Hessian products and preconditioner at a point (n,)."""
        metric = self._metric(point.size)
        if metric is None:
            return super().curvature_at(point, context)
        plain = dataclasses.replace(self, metric=False)
        found = plain.curvature_at(self._in_units(point), context)
        forth = functools.partial(_multiply, metric.factor)  # the factor is symmetric
        back = functools.partial(_multiply, metric.inverse)

        def products() -> Callable[[Array], Array]:
            multiply = found.products()
            return lambda direction: forth(multiply(forth(direction)))

        def preconditioner(damping: Array) -> Callable[[Array], Array]:
            solve = found.preconditioner(damping)
            return lambda right: back(solve(back(right)))

        return Curvature(found.evaluation, forth(found.gradient), products, preconditioner)

    def active(self, context: RallyContext) -> Array:
        """Return which of K segments a case uses, (K,) bool: all of them."""
        return jnp.ones(context.case.places.shape[0], bool)

    def prepare(self, case: RallyCase) -> RallyContext:
        """Return the case with a table of the ball's path up to the first hit."""
        of_hit: PyTree = case  # has the fields of `HitCase` that hits need
        return RallyContext(**vars(prepare_hit(of_hit)))

    def guess_ends(self, context: RallyContext, num: int) -> Array:
        """Return the variables of K hits in `num` starting points, (num, K, 11)."""
        rows = jnp.asarray(_GUESSES[:num], context.landing_time.dtype)
        return jax.vmap(lambda row: self._guess(context, *row))(rows)

    def _guess(self, context: RallyContext, contact: Array, apex: Array, thrust: Array) -> Array:
        case, limits = context.case, context.case.hit_limits
        height = limits.min_contact + contact * (limits.max_contact - limits.min_contact)
        fall, falls = drag_free_fall_time(case.ball, height, case.gravity)
        first = case.ball_time + jnp.where(falls, fall, 0.5 * context.landing_time)
        flights = self.guess_flights(case, height, apex)
        durations = jnp.concatenate([first[None], flights[:-1]])
        thrusts = jnp.broadcast_to(thrust * case.gravity, flights.shape)
        sizes = jnp.maximum(jnp.stack([durations, flights, thrusts], axis=1), _SHORTEST)
        natural = jnp.pad(jnp.log(sizes), ((0, 0), (0, 8)))
        return natural.at[:-1, 1].set(0.0)  # flight times of hits before the last are durations

    def guess_flights(self, case: RallyCase, height: Array, apex: Array) -> Array:
        """Return flight times (K,) [s] after hits, the first at a `height` [m].

        `apex` () is the apex between the least (0) and the greatest one (1).
        """
        limits = case.hit_limits
        top = limits.min_apex + apex * (limits.max_apex - limits.min_apex)
        heights = jnp.concatenate([height[None], case.places[:, 2]])
        falls = jnp.sqrt(jnp.maximum(2.0 * (top - heights) / case.gravity, 1e-4))
        return falls[:-1] + falls[1:]

    def meet(self, natural: Array, context: RallyContext) -> ChainEnds:
        """Return K hits as ends of the trajectory's segments, from their variables (K, 11).

        The excess (K, 7) has the apex below and above its limits, the quadrotor's speeds along x, y
        and z, and the height of the contact below and above its limits.
        """
        case: PyTree = context.case
        limits = case.hit_limits
        durations, thrusts = jnp.exp(natural[:, 0]), jnp.exp(natural[:, 2])
        flights = jnp.concatenate([durations[1:], jnp.exp(natural[-1:, 1])])
        first = context.path.at(durations[0] - case.ball_time)
        share = natural[:, 8:]
        places = case.places + case.place_range * share * jax.lax.rsqrt(1.0 + share * share)
        pos = jnp.concatenate([first.pos[None], places[:-1]])
        arc = jax.vmap(fly_between, (0, 0, 0, None, None))
        after, later, apex = arc(pos, places, flights, case.drag, case.gravity)
        ball = BallState(pos, jnp.concatenate([first.vel[None], later[:-1]]))

        def reach(ball: BallState, after: Array, thrust: Array, free: Array) -> tuple:
            normal, speed = solve_impact(ball.vel, after, case.restitution)
            across_x, across_y = tangent_basis(normal)
            vel = speed * normal + free[0] * across_x + free[1] * across_y
            return normal, state_at_impact(case, ball.pos, normal, vel, thrust, free[2:])

        normal, tails = jax.vmap(reach)(ball, after, thrusts, natural[:, 3:8])
        excess = jnp.concatenate(
            [
                jax.vmap(apex_excess, (0, None, None), 1)(apex, limits.min_apex, limits.max_apex),
                hitting_speed_excess(tails[:, 1], limits.hitting_speed[None]).T,
                apex_excess(pos[:, 2], limits.min_contact, limits.max_contact),
            ]
        )
        level = limits.min_contact, limits.max_contact
        aside = jnp.sum(share * share) + _off_middle(pos[0, 2], *level) ** 2
        off = jnp.sum(_off_middle(apex, limits.min_apex, limits.max_apex) ** 2)
        cost = self.place_weight * aside + self.apex_weight * off
        cost = cost + _UNUSED_WEIGHT * jnp.sum(natural[:-1, 1] ** 2)
        cost = cost + self.energy_weight * self._cost_to_go(
            tails[-1], places[-1], flights[-1], case
        )
        times = jnp.cumsum(durations)
        strokes = Stroke(times, ball.pos, ball.vel, after, normal, flights)
        return ChainEnds(
            durations=durations,
            tail_states=tails,
            total_time=times[-1],
            excess=excess,
            contact=(strokes, places),
            cost=cost,
        )

    def _cost_to_go(self, state: Array, place: Array, time: Array, case: RallyCase) -> Array:
        """Return the least snap energy with which a robot can wait for the next ball, level."""
        if case.home is not None:  # a partner's hit and a second flight come before the next hit
            place, time = case.home, 2.0 * time
        below = place - case.racket_height * jnp.array([0.0, 0.0, 1.0], place.dtype)
        onward = jnp.zeros_like(state).at[0].set(below)
        piece = time / self.num_pieces
        energy = boundary_energy(self.maps, boundary_rows(state, onward, piece), piece)
        return self.next_weight * energy

    def relative_excess(self, excess: Array) -> Array:
        """Convert the excess (7, K), as `meet` returns it, to relative excesses."""
        return jnp.concatenate([excess[:2], Measure.ABOVE.relative(excess[2:5]), excess[5:]])

    def rules_out(self, context: RallyContext) -> Array:
        """Return whether the ball is provably never within the quadrotor's reach, () bool."""
        return is_too_far(context) & (context.case.ball_time <= 0.0)

    def make_plan(
        self,
        trajectory: PiecewisePolynomial,
        ends: ChainEnds,
        violation: Array,
        context: RallyContext,
    ) -> RallyPlan:
        """Return the plan of a trajectory through the hits `ends.contact`."""
        strokes, places = ends.contact
        return RallyPlan(
            trajectory=trajectory,
            gravity=context.case.gravity,
            air=context.case.limits.air,
            strokes=strokes,
            places=places,
            **pending(violation),
        ).with_heading(context.case)

    def replanner(self) -> SearchPlanner:
        """Return the planner by which `pj.replan` updates plans in flight."""
        from planner_jax.task.rally.replan import REMAINDER

        return REMAINDER.planner_of(self)


def _multiply(matrix: np.ndarray, vector: Array) -> Array:
    typed = jnp.asarray(matrix, vector.dtype)
    return jnp.matmul(typed, vector, precision=jax.lax.Precision.HIGHEST)


def _off_middle(value: Array, least: Array, most: Array) -> Array:
    """Return how far a value is from the middle of its range, relative to half the range."""
    return (2.0 * value - least - most) * reciprocal(jnp.maximum(most - least, _LEAST_RANGE))
