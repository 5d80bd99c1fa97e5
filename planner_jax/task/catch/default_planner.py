"""The `exact` catch planner: every catch is built into the decision variables.

Paper 000 brings the net to the ball by a penalty (eqs 22-24), and its plans miss by what the
penalty lets through. Here the net's centre is the ball's position less an offset inside the
hoop, so that no plan misses; attitude and limits stay inequalities.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import FEASIBILITY_TOLERANCE, require_settings
from planner_jax.cost.along import Along, integrate_along
from planner_jax.cost.penalty import smoothed_hinge
from planner_jax.cost.quadrotor import flight_along, greatest_excess, limits_along
from planner_jax.optimise.evaluation import Evaluation
from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.learned_start import StartNetwork, cheaper_start, shipped_network
from planner_jax.optimise.newton import Curvature
from planner_jax.optimise.planner import OptimisedPlanner, pending
from planner_jax.optimise.problem import Round, Stage
from planner_jax.optimise.scaling import shipped_scale
from planner_jax.robot.quadrotor import body_z, tangent_basis
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.chain import (
    CatchContext,
    Chain,
    chain_energy,
    chain_motion,
    chain_rows,
    chain_trajectory,
    facing_cosine,
    nearest_upright,
    ordered_context,
    targets_at,
)
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.reach import is_too_far
from planner_jax.task.segments import BETWEEN_NODES, segments_curvature
from planner_jax.trajectory.proportional_minco import (
    ProportionalMinco,
    boundary_energy,
    offset_energy,
    proportional_minco,
)

_ORDER = 4  # minimum snap
_PROPORTIONS = (0.3,) + (1.0,) * 5
_SEEN = (-0.1, 0.1)  # [s] from the decided time, at which a learned start looks at the ball
# Intervals at which a piece is looked at in the end, of one catch and of several: body rates peak
# sharply where the thrust is small, as it is between catches.
_DECODE_NODES = (32, 48)
_RIM = 0.9  # share of the net's radius that a planned catch may use
_LEARNED_PLACE = 2.0  # greatest size of a place that is learnt: 0.89 of that share
_ENCODED_RIM = 0.99  # share of that which a point made by `encode` may use


# Starting points, best first: factor on the guessed times, then twice two numbers, for a catch on
# the way and for the last one: the share of the mean velocity of the way there that is kept, and
# the thrust, from -1 for the least that is allowed over 0 for the weight to 1 for the greatest.
# Optimal plans sink through their catches and brake at the last one.
_GUESSES = np.array(
    [
        (1.0, 0.5, 0.8, -5.0 / 7.0, 0.1),
        (1.0, 1.0, 1.0, 0.0, 4.0 / 15.0),
        (1.15, 0.3, 0.3, -5.0 / 7.0, 0.1),
        (1.3, 0.0, 0.0, -2.0 / 7.0, 0.1),
        (0.9, 1.0, 1.0, -5.0 / 7.0, 0.1),
        (1.5, 0.2, 0.2, 0.0, 0.0),
    ]
)
_FIRST = Round(starts=1, solver=LbfgsConfig(max_steps=8))
_ROUNDS = (
    _FIRST,
    Round(starts=1, solver=LbfgsConfig(max_steps=25)),
    Round(starts=1, solver=LbfgsConfig(max_steps=80)),
    Round(starts=6, solver=LbfgsConfig(max_steps=200)),
)
_FROM_LEARNED = Round(starts=1, solver=LbfgsConfig(max_steps=2))  # in its place, of one target
# In its place, of several targets, where Newton's method goes on: it would begin too far away.
_LONG_CHAIN = Stage(LbfgsConfig(max_steps=200, tolerance=1e-6, patience=5))
_CHAIN_TOLERANCE = 1e-4
# In the place of the first two of `_ROUNDS`, where more than `_FEW` targets are in line, each of
# which must be caught: few iterations lead nowhere there.
_FEW = 3
_STEPS_A_TARGET = 20
_OF_MANY = LbfgsConfig(max_steps=300, memory=8, trial_steps=(1.0, 0.3))
_LEAN = 0.95  # of the angle that the net may have to the ball's way, what a guess makes use of


def start_features(context: CatchContext) -> Array:
    """What a learned start of a single catch is made from, (F,): ball, quadrotor and limits."""
    case, net = context.case, context.case.net
    head, limits, time = case.head_state, case.limits, context.times[0]
    seen = [targets_at(context.targets, context.times[:1] + late) for late in _SEEN]
    least, most = limits.thrust_bounds
    numbers = (
        *(part for ball in seen for part in (ball.pos[0] - head[0], ball.vel[0])),
        head[1],
        0.2 * head[2],
        0.02 * head[3],
        jnp.stack(
            [
                time,
                context.horizon[0] - time,
                head[0, 2] - limits.min_height,
                *map(jnp.log, (limits.speed, most, least, limits.body_rate, case.gravity)),
                net.height,
                net.radius,
                net.max_angle,
            ]
        ),
    )
    return jnp.concatenate(numbers)


def _is_learned(case: CatchCase) -> bool:
    """Whether the network has seen such cases, or batches: one target, and nothing in the way.

    Around obstacles the side on which a search begins decides where it can end.
    """
    return case.num_targets == 1 and not case.extras


@struct.dataclass
class Catch:
    """The N catches that a point describes."""

    times: Array  # (N,) [s]
    durations: Array  # (N,) [s], of the segments
    tail_states: Array  # (N, 4, 3) of the quadrotor
    angle_excess: Array  # (N,) of the net's angle over theta_safe, relative; <= 0 is good


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ExactCatch(OptimisedPlanner):
    """Minimum-snap catches with the ball in the net by construction.

    Decision variables, N segments with 3 (M - 1) + 12 each, in units of `scale`: whitened
    waypoint offsets, log duration of the segment, place in the net, velocity, acceleration and
    jerk at the catch. The acceleration gives the net's axis z_d; the ball's position at the
    catch less the net's height along z_d and a place inside the hoop is the quadrotor's.

    Cost: time_weight * total time + energy_weight * integral |snap|^2 + integral of the
    smoothed hinges of the limits (paper 000, eqs 26-28), and of the case's extras + hinges of the
    angle (eq. 25) and of the horizon.
    """

    case_type = CatchCase
    subspace = 0
    proportions: tuple[float, ...] = _PROPORTIONS  # relative durations of the pieces
    nodes: int = 8  # penalty intervals a piece
    time_weight: float = 0.005
    energy_weight: float = 3e-8
    margin: float = 0.03  # penalties begin this far inside a limit, relative
    hinge_width: float = 0.1
    catch_weight: float = 0.3  # [s], of the hinges at a catch beside the integrals
    rounds: tuple[Round, ...] = _ROUNDS
    # Of the first guess, the thrust at catches on the way, as in `_GUESSES`. Near the least that is
    # allowed catches are soonest; more leaves control a margin in flight.
    lift: float = _GUESSES[0, 3].item()
    scale: tuple[float, ...] = ()  # of one segment
    learned: bool = True  # whether a network makes the first guess of a single catch

    def __post_init__(self) -> None:
        require_settings(self)
        if len(self.proportions) < 2 or not all(0.0 < x < np.inf for x in self.proportions):
            raise ArgumentError("proportions", "of >= 2 pieces, finite and > 0", self.proportions)
        if not self.scale:
            object.__setattr__(
                self, "scale", shipped_scale(__package__, f"exact-{self.num_pieces}")
            )
        if len(self.scale) != self.num_offsets + 12:
            rule = f"of {self.num_offsets + 12} numbers"
            raise ArgumentError("scale", rule, len(self.scale))

    @property
    def num_offsets(self) -> int:
        """Number of waypoint variables of a segment."""
        return 3 * (self.num_pieces - 1)

    @property
    def num_pieces(self) -> int:
        """M, of one segment."""
        return len(self.proportions)

    @property
    def _network(self) -> StartNetwork | None:
        """That makes the first guess; there is one for the shipped sizes and the usual lift."""
        name = f"exact-{self.num_pieces}"
        is_usual = self.proportions == _PROPORTIONS and self.lift == _GUESSES[0, 3]
        if not self.learned or not is_usual or self.scale != shipped_scale(__package__, name):
            return None
        return shipped_network(__package__, name)

    @property
    def maps(self) -> ProportionalMinco:
        """Constant maps from boundary and offsets to one segment."""
        return proportional_minco(_ORDER, self.proportions)

    def prepare(self, case: CatchCase) -> CatchContext:
        """The targets in the order of catching."""
        return ordered_context(case)

    def guesses(self, context: CatchContext, num: int) -> Array:
        """Smooth trajectories that face the balls, at and after the guessed times, (num, n)."""
        if num > len(_GUESSES):
            raise ArgumentError("starts", f"<= {len(_GUESSES)}", num)
        rows = _GUESSES[:num].copy()
        rows[0, 3] = self.lift
        rows = jnp.asarray(rows, context.times.dtype)
        points = jax.vmap(lambda guess: self._guess(context, guess))(rows)
        network = self._network
        if network is None or not _is_learned(context.case):
            return points
        learned = self._off_the_rim(points[0] + network(start_features(context)))
        cost = lambda point: self.objective(point, context).cost  # noqa: E731
        return points.at[0].set(cheaper_start(cost, points[0], learned))

    def solve(self, case: CatchCase, attempt: Round) -> CatchPlan:
        """The plan of one case by one round."""
        return super().solve(case, self._for_start(attempt, case))

    def solve_lanes(self, cases: CatchCase, attempt: Round) -> CatchPlan:
        """The plans of a batch by one round."""
        return super().solve_lanes(cases, self._for_start(attempt, cases))

    def starts_long(self, case: CatchCase) -> bool:
        """Whether the first search is a long one: of many targets that must all be caught."""
        return self.rounds == _ROUNDS and case.num_targets > _FEW and not case.optional

    def _for_start(self, attempt: Round, case: CatchCase) -> Round:
        """A shorter first round where it begins near its end, longer searches where it is far."""
        if self.starts_long(case) and attempt in _ROUNDS[:2]:
            is_first = attempt == _FIRST
            steps = _STEPS_A_TARGET * case.num_targets if is_first else _OF_MANY.max_steps
            return Round(starts=1, solver=dataclasses.replace(_OF_MANY, max_steps=steps))
        if attempt.stages == (Stage(_FIRST.solver),) and case.num_targets > 1:
            # Far from the end what an iteration gains says little of what all of them do.
            slow = min(attempt.solver.tolerance, _CHAIN_TOLERANCE)
            solver = dataclasses.replace(attempt.solver, tolerance=slow)
            return dataclasses.replace(attempt, stages=(_LONG_CHAIN,), solver=solver)
        is_near = attempt == _FIRST and self._network is not None and _is_learned(case)
        return _FROM_LEARNED if is_near else attempt

    def _off_the_rim(self, point: Array) -> Array:
        """A point (n,) whose places in the net still move with their variables.

        The least time puts the ball on the rim, at places without bound, from which no later search
        comes back when the ball turns out to be elsewhere.
        """
        offsets, natural = self._split(point)
        place = natural[:, 1:3]
        size = jnp.sqrt(jnp.maximum(jnp.sum(place**2, axis=1, keepdims=True), 1e-12))
        natural = natural.at[:, 1:3].set(place * jnp.minimum(1.0, _LEARNED_PLACE / size))
        together = jnp.concatenate([offsets.reshape(natural.shape[0], -1), natural], axis=1)
        return (together / jnp.asarray(self.scale, point.dtype)).ravel()

    def _guess(self, context: CatchContext, guess: Array) -> Array:
        """The point (n,) of later times, velocities and thrusts, a row of `_GUESSES`."""
        case = context.case
        factor, *of_catches = guess
        begin = jnp.zeros_like(context.times[:1])
        times = context.times * factor
        durations = jnp.maximum(jnp.diff(times, prepend=begin), 0.05)
        ball = targets_at(context.targets, times)
        before = jnp.concatenate([case.head_state[None, 0], ball.pos[:-1]])
        is_last = jnp.arange(times.size) == jnp.sum(context.active) - 1
        kept, lift = (
            jnp.where(is_last, last, on_the_way)[:, None]
            for on_the_way, last in (of_catches[:2], of_catches[2:])
        )
        least, most = case.limits.thrust_bounds
        less, more = case.gravity - least, most - case.gravity
        thrust = case.gravity + lift * jnp.where(lift < 0.0, less, more)
        vel = kept * (ball.pos - before) / durations[:, None]
        up = jnp.array([0.0, 0.0, 1.0], times.dtype)
        lean = _LEAN * case.net.max_angle
        acc = thrust * nearest_upright(ball.vel, lean) - case.gravity * up
        natural = jnp.concatenate(
            [
                jnp.zeros((times.size, self.num_offsets)),
                jnp.log(durations)[:, None],
                jnp.zeros((times.size, 2)),
                vel,
                acc,
                jnp.zeros((times.size, 3)),
            ],
            axis=1,
        )
        return (natural / jnp.asarray(self.scale, times.dtype)).ravel()

    def catches(self, natural: Array, context: CatchContext) -> Catch:
        """The catches that the variables (N, 12) after the waypoint offsets describe."""
        case, net = context.case, context.case.net
        durations = jnp.exp(natural[:, 0])
        times = jnp.cumsum(jnp.where(context.active, durations, 0.0))
        ball = targets_at(context.targets, times)
        acc = natural[:, 6:9]
        axis = body_z(acc, case.gravity)
        across_x, across_y = jax.vmap(tangent_basis)(axis)
        place = natural[:, 1:3]
        inside = _RIM * net.radius / jnp.sqrt(1.0 + jnp.sum(place**2, axis=1, keepdims=True))
        place = place * inside
        pos = ball.pos - net.height * axis - place[:, :1] * across_x - place[:, 1:] * across_y
        facing, moving = facing_cosine(axis, ball.vel)
        # To first order the relative excess of the angle, without an arc cosine.
        angle = jnp.maximum(net.max_angle, 1e-3)
        excess = (jnp.cos(angle) - facing) / (angle * jnp.sin(angle))
        excess = jnp.where(moving, excess, -1.0)
        tail_states = jnp.stack([pos, natural[:, 3:6], acc, natural[:, 9:12]], axis=1)
        return Catch(times=times, durations=durations, tail_states=tail_states, angle_excess=excess)

    def encode(
        self, context: CatchContext, durations: Array, tail_states: Array, offsets: Array
    ) -> Array:
        """The point (n,) that describes given catches: the inverse of `decode`.

        A place in the net cannot hold what is outside of the hoop or off its plane; the catch
        is then the nearest across the net's axis.

        Args:
            context: the targets.
            durations: (N,) [s], of the segments.
            tail_states: (N, 4, 3) of the quadrotor at the catches.
            offsets: (N, M - 1, 3) whitened waypoint offsets.
        """
        case, net = context.case, context.case.net
        times = jnp.cumsum(jnp.where(context.active, durations, 0.0))
        pos, acc = tail_states[:, 0], tail_states[:, 2]
        axis = body_z(acc, case.gravity)
        miss = targets_at(context.targets, times).pos - net.height * axis - pos
        across = jnp.stack(jax.vmap(tangent_basis)(axis), axis=1)  # (N, 2, 3)
        share = jnp.sum(across * miss[:, None], axis=2) / (_RIM * net.radius)
        squared = jnp.sum(share**2, axis=1, keepdims=True)
        # Nearer to the rim than this the place hardly moves with its variables.
        share *= jnp.minimum(1.0, _ENCODED_RIM / jnp.sqrt(jnp.maximum(squared, 1e-12)))
        place = share / jnp.sqrt(1.0 - jnp.sum(share**2, axis=1, keepdims=True))
        natural = jnp.concatenate(
            [
                offsets.reshape(times.size, -1),
                jnp.log(durations)[:, None],
                place,
                tail_states[:, 1:].reshape(times.size, -1),
            ],
            axis=1,
        )
        return (natural / jnp.asarray(self.scale, natural.dtype)).ravel()

    def _split(self, point: Array) -> tuple[Array, Array]:
        """Whitened offsets (N, M - 1, 3) and the variables after them, (N, 12), at a point."""
        scale = jnp.asarray(self.scale, point.dtype)
        natural = point.reshape(-1, scale.size) * scale
        offsets = natural[:, : self.num_offsets].reshape(natural.shape[0], -1, 3)
        return offsets, natural[:, self.num_offsets :]

    def _unpack(self, point: Array, context: CatchContext) -> tuple[Chain, Catch]:
        """Segments and catches at a point."""
        offsets, natural = self._split(point)
        catch = self.catches(natural, context)
        piece_durations = catch.durations / self.num_pieces
        rows = chain_rows(context.case.head_state, catch.tail_states, piece_durations)
        return Chain(rows=rows, offsets=offsets, piece_durations=piece_durations), catch

    def _at_catch(self, catch: Catch, context: CatchContext) -> Array:
        """Excess at the catches, (2, N): of the angle, and over the horizon."""
        # The horizon is a hard end: the tolerance of a feasible plan is taken off.
        late = catch.times / context.horizon - 1.0 + FEASIBILITY_TOLERANCE
        return jnp.where(context.active, jnp.stack([catch.angle_excess, late]), -1.0)

    def _along(self, nodes: int, case: CatchCase) -> Along:
        """Penalties along the way."""
        return flight_along(self.maps, nodes, case, self.margin, self.hinge_width)

    def objective(self, point: Array, context: CatchContext) -> Evaluation:
        """Cost, and the largest excess at the penalty nodes (squares over squares)."""
        offsets, natural = self._split(point)
        rows, durations, core, at_catches = self.ends(natural, context)
        penalties, worst = integrate_along(
            self._along(self.nodes, context.case),
            jnp.concatenate([rows, offsets], axis=1),
            durations,
            (context.case.gravity, context.case.limits, context.case.extras),
        )
        along = penalties + self._offset_costs(offsets, durations)
        cost = core + jnp.sum(jnp.where(context.active, along, 0.0))
        worst = jnp.max(jnp.where(context.active, worst, -1.0))
        return Evaluation(cost=cost, violation=jnp.maximum(worst, at_catches) + BETWEEN_NODES)

    def ends(self, natural: Array, context: CatchContext) -> tuple[Array, Array, Array, Array]:
        """What the variables after the waypoint offsets make of the objective.

        Args:
            natural: (N, 12) as for `catches`.
            context: of the case.

        Returns:
            Boundary rows (N, 8, 3) and mean durations of a piece (N,) [s] of the segments, the
            cost of time and of the ends, and the greatest excess at the catches.
        """
        catch = self.catches(natural, context)
        durations = catch.durations / self.num_pieces
        rows = chain_rows(context.case.head_state, catch.tail_states, durations)
        at_catch = self._at_catch(catch, context)
        energies = jax.vmap(functools.partial(boundary_energy, self.maps))(rows, durations)
        energy = jnp.sum(jnp.where(context.active, energies, 0.0))
        hinges = smoothed_hinge(at_catch + self.margin, self.hinge_width)
        weighed = self.energy_weight * energy + self.time_weight * catch.times[-1]
        core = self.catch_weight * jnp.sum(hinges) + weighed
        return rows, durations, core, jnp.max(at_catch)

    def _offset_costs(self, offsets: Array, durations: Array) -> Array:
        """Cost of the energy that the offsets make, (N,)."""
        energies = jax.vmap(functools.partial(offset_energy, self.maps))(offsets, durations)
        return self.energy_weight * energies

    def curved(self, point: Array, context: CatchContext) -> Curvature:
        """Evaluation, gradient, and second derivatives; see `segments_curvature`."""
        offsets, natural = self._split(point)
        return segments_curvature(
            self.maps,
            self._along(self.nodes, context.case),
            lambda natural: self.ends(natural, context),
            self.ends(natural, context),
            natural,
            offsets,
            jnp.asarray(self.scale, point.dtype),
            (context.case.gravity, context.case.limits, context.case.extras),
            self.energy_weight,
            context.active,
        )

    def residuals(self, point: Array, context: CatchContext) -> Array:
        """Squared hinges, energy and time as residuals, for `measure_scale`.

        The smoothed hinge bends at most with 3 / (2 hinge_width); the residuals bend alike.
        """
        chain, catch = self._unpack(point, context)
        along = self._along(self.nodes, context.case)
        bend = jnp.sqrt(1.5 / self.hinge_width)
        margins = jnp.asarray(along.margins, point.dtype)[:, None, None]
        motion, case = chain_motion(self.maps, self.nodes, chain, along.orders), context.case
        excess = jnp.stack(limits_along(motion, (case.gravity, case.limits, case.extras)))
        excess = jnp.where(context.active[:, None], excess, -1.0)
        inside = jnp.maximum(excess + margins, 0.0)
        weights = jnp.asarray(along.weights(), point.dtype)
        inside = inside * jnp.sqrt(chain.piece_durations[:, None] * weights)
        at_catch = self._at_catch(catch, context) + self.margin
        at_catch = jnp.sqrt(self.catch_weight) * jnp.maximum(at_catch, 0.0)
        energy = jnp.where(context.active, chain_energy(self.maps, chain), 0.0)
        smooth = jnp.sqrt(2.0 * self.energy_weight * jnp.maximum(energy, 1e-6))
        spent = jnp.where(context.active, catch.durations, 1e-6)
        late = jnp.sqrt(2.0 * self.time_weight * spent)
        parts = (bend * inside, bend * at_catch, smooth, late)
        return jnp.concatenate([part.ravel() for part in parts])

    def rules_out(self, context: CatchContext) -> Array:
        """Whether a target is never within reach."""
        return is_too_far(context)

    def decode(self, point: Array, context: CatchContext) -> CatchPlan:
        """The plan at a point, its violation looked for at `_DECODE_NODES` and between them."""
        chain, catch = self._unpack(point, context)
        nodes = _DECODE_NODES[context.times.size > 1]
        greatest = greatest_excess(
            self.maps, nodes, chain.columns, chain.piece_durations, context.case
        )
        along = [jnp.max(jnp.where(context.active, each, -1.0)) for each in greatest]
        at_catch = jnp.max(self._at_catch(catch, context))
        violation = functools.reduce(jnp.maximum, [*along, at_catch])
        return CatchPlan(
            trajectory=chain_trajectory(self.maps, chain, context.active),
            gravity=context.case.gravity,
            order=context.case.order,
            decided_times=context.times,
            times=catch.times,
            **pending(violation),
        )

    def replanner(self) -> Any:
        """The `ReplanCatch` that goes on from this planner's plans; see `pj.replan`."""
        from planner_jax.task.catch.replan import ReplanCatch

        return ReplanCatch(self)
