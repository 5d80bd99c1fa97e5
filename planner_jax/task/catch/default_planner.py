"""The `exact` catch planner: its decision variables are such that every plan meets the balls.

[Yu2023catch, eqs 22-24] moves the net to the ball by a penalty and accepts a small error. Here the
position of the net's centre is the ball's position minus an offset inside the hoop, so every plan
catches the ball. Attitude and limits remain inequalities, which are met by penalties.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.protocol import FEASIBILITY_TOLERANCE
from planner_jax.optimise.chain import ChainEnds, ChainProblem
from planner_jax.optimise.planner import SearchPlanner, pending
from planner_jax.optimise.settings import Attempt, Attempts, LbfgsConfig, Stage
from planner_jax.optimise.shipped import StartNetwork, load_network
from planner_jax.penalties.catches import facing_cosine
from planner_jax.robot.quadrotor import add_drag, body_z, tangent_basis
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.context import (
    CatchContext,
    is_too_far,
    nearest_upright,
    order_targets,
    targets_at,
)
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial

_PROPORTIONS = (0.3,) + (1.0,) * 5
_FEATURE_TIMES = (-0.1, 0.1)  # [s] times of the network's inputs, after the estimated catch
_RIM = 0.9  # greatest distance of a catch from the net's centre, relative to the net's radius
# Greatest norm of the two unbounded variables that determine a catch point, if a network predicts
# them. The point is then at most 0.89 * `_RIM` * (radius of the net) from the net's centre.
_LEARNED_SIZE = 2.0
_ENCODED_RIM = 0.99  # greatest distance of a catch point made by `encode`, relative to `_RIM`
# Starting points, the most successful first. Column 1 is a factor on the estimated times of the
# catches. Columns 2 and 3 are the velocity at catches before the last one and at the last one,
# relative to the mean velocity since the previous catch. Columns 4 and 5 are the thrust at these
# catches: -1 is the least, 0 hover, 1 the greatest thrust.
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
_FIRST = Attempt(starts=1, solver=LbfgsConfig(max_steps=8))
_ATTEMPTS = (
    _FIRST,
    Attempt(starts=1, solver=LbfgsConfig(max_steps=25)),
    Attempt(starts=1, solver=LbfgsConfig(max_steps=80)),
    Attempt(starts=6, solver=LbfgsConfig(max_steps=200)),
)
_FROM_LEARNED = Attempt(starts=1, solver=LbfgsConfig(max_steps=2))  # from a network's start
# Settings of L-BFGS, which runs before Newton's method if there are several targets, because the
# eight iterations for a single target would end too far from the optimum.
_LONG_CHAIN = Stage(LbfgsConfig(max_steps=200, tolerance=1e-6, patience=5))
_CHAIN_TOLERANCE = 1e-4
# If more than `_FEW` targets must all be caught, the first attempt has `_STEPS_A_TARGET` iterations
# for each target, and the second attempt the settings `_OF_MANY`.
_FEW = 3
_STEPS_A_TARGET = 20
_OF_MANY = LbfgsConfig(max_steps=300, memory=8, trial_steps=(1.0, 0.3))
# Angle between the net's axis and the ball's reversed velocity at a catch in a starting point, as a
# fraction of the greatest allowed angle.
_LEAN = 0.95


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class CatchProblem(ChainProblem[CatchCase, CatchPlan]):
    """Minimum-snap catches whose decision variables put the ball into the net.

    A segment of M polynomial pieces leads to each catch. It has 3 (M - 1) + 12 variables in units
    of `scale`: offsets of its waypoints from the smoothest trajectory, logarithm of its duration,
    catch point in the net, and velocity, acceleration and jerk at the catch. The acceleration
    determines the net's axis. The quadrotor's position at the catch is the ball's position minus
    the net's height along this axis and minus the catch point's offset inside the hoop.

    The cost is time_weight * total time + energy_weight * integral |snap|^2, plus the integral of
    smooth one-sided penalties on the limits [Yu2023catch, eqs 26-28] and of the user's extra terms,
    plus catch_weight * penalties on the net's angle [Yu2023catch, eq. 25] and on late catches.

    Attributes:
        proportions: relative durations of the pieces.
        catch_weight: [s], weight of the penalties at a catch.
        lift: thrust at catches before the last one in the first starting point: -1 is the least, 0
            hover, 1 the greatest thrust. Near -1 catches are earliest; larger values leave a margin
            for feedback control in flight.
        entry: [m/s], least speed at which a ball enters the net from above; None: it may enter from
            below.
        learned: whether a network predicts a starting point for a single catch.
    """

    case_type = CatchCase
    attempts = _ATTEMPTS
    package = "planner_jax.task.catch"
    num_end_variables = 12
    guess_table = _GUESSES
    proportions: tuple[float, ...] = _PROPORTIONS
    catch_weight: float = 0.3
    lift: float = _GUESSES[0, 3].item()
    entry: float | None = None
    learned: bool = True

    @property
    def end_weight(self) -> float:
        """Weight [s] of the penalties on the net's angle at a catch, and on a catch too late."""
        return self.catch_weight

    def active(self, context: CatchContext) -> Array:
        """Return which of N catches, in their order, are of targets that exist, (N,) bool."""
        return context.active

    def start_network(self, case: CatchCase) -> StartNetwork | None:
        """Return the network that predicts a starting point; None if there is no such network.

        It exists for one target without obstacles, if the pieces' relative durations `proportions`,
        the variables' units `scale` and the thrust `lift` have their defaults, as in training.
        """
        is_usual = self.proportions == _PROPORTIONS and self.lift == _GUESSES[0, 3]
        is_usual &= case.num_targets == 1 and not case.extras
        if not self.learned or not is_usual or self.scale != self._usual_scale:
            return None
        return load_network(self.package, "exact-6")

    def start_features(self, context: CatchContext) -> Array:
        """Return the network's inputs, a vector: states of ball and quadrotor, and the limits."""
        case, net = context.case, context.case.net
        head, limits, time = case.head_state, case.limits, context.times[0]
        balls = [targets_at(context.targets, context.times[:1] + late) for late in _FEATURE_TIMES]
        least, most = limits.thrust_bounds
        numbers = (
            *(part for ball in balls for part in (ball.pos[0] - head[0], ball.vel[0])),
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

    def prepare(self, case: CatchCase) -> CatchContext:
        """Return a case with its targets in the order of catching, for evaluations of the cost."""
        return order_targets(case)

    def guess_ends(self, context: CatchContext, num: int) -> Array:
        """Return the variables of N catches for `num` starting points, (num, N, 12).

        They are log duration, catch point (2,) in the net, velocity, acceleration and jerk (3,).
        """
        rows = _GUESSES[:num].copy()
        rows[0, 3] = self.lift
        rows = jnp.asarray(rows, context.times.dtype)
        return jax.vmap(lambda guess: self._guess(context, guess))(rows)

    def starts_long(self, cases: CatchCase, attempts: Attempts) -> bool:
        """Return whether more than three targets must be caught, which needs more iterations."""
        return attempts == _ATTEMPTS and cases.num_targets > _FEW and not cases.optional

    def fit_attempt(self, attempt: Attempt, cases: CatchCase, attempts: Attempts) -> Attempt:
        """Return an attempt with more iterations for more targets."""
        if self.starts_long(cases, attempts) and attempt in _ATTEMPTS[:2]:
            steps = _STEPS_A_TARGET * cases.num_targets if attempt == _FIRST else _OF_MANY.max_steps
            return Attempt(starts=1, solver=dataclasses.replace(_OF_MANY, max_steps=steps))
        if attempt.stages == (Stage(_FIRST.solver),) and cases.num_targets > 1:
            # With several targets the search starts far from the optimum, where a small gain in one
            # iteration does not prove convergence: the tolerance must be smaller.
            slow = min(attempt.solver.tolerance, _CHAIN_TOLERANCE)
            solver = dataclasses.replace(attempt.solver, tolerance=slow)
            return dataclasses.replace(attempt, stages=(_LONG_CHAIN,), solver=solver)
        is_near = attempt == _FIRST and self.start_network(cases) is not None
        return _FROM_LEARNED if is_near else attempt

    def limit_learned(self, point: Array) -> Array:
        """Move the catch points of a predicted starting point away from the hoop's rim.

        Two unbounded variables determine a catch point in the hoop. Near the rim, where catches are
        earliest, the point hardly moves with its variables, so that a search could not move it.
        """
        offsets, natural = self.split(point)
        place = natural[:, 1:3]
        size = jnp.sqrt(jnp.maximum(jnp.sum(place**2, axis=1, keepdims=True), 1e-12))
        natural = natural.at[:, 1:3].set(place * jnp.minimum(1.0, _LEARNED_SIZE / size))
        return self.join(offsets, natural)

    def _guess(self, context: CatchContext, guess: Array) -> Array:
        case = context.case
        factor, *of_catches = guess
        begin = jnp.zeros_like(context.times[:1])
        times = context.times * factor
        durations = jnp.maximum(jnp.diff(times, prepend=begin), 0.05)
        ball = targets_at(context.targets, times)
        before = jnp.concatenate([case.head_state[None, 0], ball.pos[:-1]])
        is_last = jnp.arange(times.size) == jnp.sum(context.active) - 1
        share, lift = (
            jnp.where(is_last, of_last, of_others)[:, None]
            for of_others, of_last in (of_catches[:2], of_catches[2:])
        )
        least, most = case.limits.thrust_bounds
        less, more = case.gravity - least, most - case.gravity
        thrust = case.gravity + lift * jnp.where(lift < 0.0, less, more)
        vel = share * (ball.pos - before) / durations[:, None]
        up = jnp.array([0.0, 0.0, 1.0], times.dtype)
        lean = _LEAN * case.net.max_angle
        acc = thrust * nearest_upright(ball.vel, lean) - case.gravity * up[None]
        still = jnp.zeros((times.size, 3))
        return jnp.concatenate(
            [jnp.log(durations)[:, None], jnp.zeros((times.size, 2)), vel, acc, still], axis=1
        )

    def meet(self, natural: Array, context: CatchContext) -> ChainEnds:
        """Return N catches as ends of the trajectory's segments, from their variables (N, 12).

        The variables are log duration, catch point (2,) in the net, velocity, acceleration and jerk
        (3,). The field `excess` (2, N) of the result has two rows: relative excess of the net's
        angle over its limit, and of the catch's time over the latest allowed time. With `entry`
        there is a third row: the lack of speed at which the ball enters, over the speed limit.
        """
        case, net = context.case, context.case.net
        durations = jnp.exp(natural[:, 0])
        times = jnp.cumsum(jnp.where(context.active, durations, 0.0))
        ball = targets_at(context.targets, times)
        vel, acc = natural[:, 3:6], natural[:, 6:9]
        axis = body_z(add_drag(case.limits.air, vel, acc), case.gravity)
        across_x, across_y = jax.vmap(tangent_basis)(axis)
        place = natural[:, 1:3]
        inside = _RIM * net.radius / jnp.sqrt(1.0 + jnp.sum(place**2, axis=1, keepdims=True))
        place = place * inside
        pos = ball.pos - net.height * axis - place[:, :1] * across_x - place[:, 1:] * across_y
        facing, moving = facing_cosine(axis, ball.vel)
        # Relative excess of the angle, linearised at the limit, which needs no arc cosine.
        angle = jnp.maximum(net.max_angle, 1e-3)
        excess = (jnp.cos(angle) - facing) / (angle * jnp.sin(angle))
        excess = jnp.where(moving, excess, -1.0)
        tail_states = jnp.stack([pos, vel, acc, natural[:, 9:12]], axis=1)
        # Feasible plans may exceed a limit by the tolerance, added here so that no catch is late.
        late = times / context.horizon - 1.0 + FEASIBILITY_TOLERANCE
        rows = [excess, late]
        if self.entry is not None:
            rising = jnp.sum((ball.vel - vel) * axis, axis=1)
            rows.append((rising + self.entry) / case.limits.speed)
        return ChainEnds(
            durations=durations,
            tail_states=tail_states,
            total_time=times[-1],
            excess=jnp.where(context.active, jnp.stack(rows), -1.0),
            contact=times,
        )

    def encode(
        self, context: CatchContext, durations: Array, tail_states: Array, offsets: Array
    ) -> Array:
        """Return the decision variables that describe N given catches: the inverse of `decode`.

        Balls off the net's plane are projected onto it, and balls outside of the hoop onto its rim.
        The N segments have durations (N,) [s], end states (N, 4, 3) of the quadrotor, and M pieces
        with offsets (N, M - 1, 3) of the waypoints.
        """
        case, net = context.case, context.case.net
        times = jnp.cumsum(jnp.where(context.active, durations, 0.0))
        pos, vel, acc = (tail_states[:, order] for order in range(3))
        axis = body_z(add_drag(case.limits.air, vel, acc), case.gravity)
        miss = targets_at(context.targets, times).pos - net.height * axis - pos
        across = jnp.stack(jax.vmap(tangent_basis)(axis), axis=1)  # (N, 2, 3)
        share = jnp.sum(across * miss[:, None], axis=2) / (_RIM * net.radius)
        squared = jnp.sum(share**2, axis=1, keepdims=True)
        # At the hoop's rim even large changes of its two variables hardly move a catch point, so
        # that a search could not change it: keep the point inside.
        share *= jnp.minimum(1.0, _ENCODED_RIM / jnp.sqrt(jnp.maximum(squared, 1e-12)))
        place = share / jnp.sqrt(1.0 - jnp.sum(share**2, axis=1, keepdims=True))
        natural = jnp.concatenate(
            [jnp.log(durations)[:, None], place, tail_states[:, 1:].reshape(times.size, -1)], axis=1
        )
        return self.join(offsets, natural)

    def rules_out(self, context: CatchContext) -> Array:
        """Return whether a target is provably never within the quadrotor's reach, () bool."""
        return is_too_far(context)

    def make_plan(
        self,
        trajectory: PiecewisePolynomial,
        ends: ChainEnds,
        violation: Array,
        context: CatchContext,
    ) -> CatchPlan:
        """Return the plan of a trajectory with catches at the times `ends.contact`."""
        return CatchPlan(
            trajectory=trajectory,
            gravity=context.case.gravity,
            air=context.case.limits.air,
            order=context.case.order,
            decided_times=context.times,
            times=ends.contact,
            **pending(violation),
        ).with_heading(context.case)

    def replanner(self) -> SearchPlanner:
        """Return the planner by which `pj.replan` updates plans in flight."""
        from planner_jax.task.catch.replan import REMAINDER

        return REMAINDER.planner_of(self)
