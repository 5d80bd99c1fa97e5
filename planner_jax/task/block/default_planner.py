"""The default planner: a straight motion of the joints if one is free, else least squares.

The shield may meet a ball anywhere between the boxes, with the wrist and the elbow on either side.
Each of these end poses has a straight motion of the joints, all of them in step; the first that
is in time and touches nothing is taken. Where none is, end pose, time of contact and motion are
optimised together by Levenberg-Marquardt, from straight motions with a bump to one side, until one
keeps every limit. Paper 004 looks its motions up in a library instead; nothing is stored here but
the bumps.
"""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.ball.flight import drag_free_flight
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import (
    FEASIBILITY_TOLERANCE,
    Attempt,
    is_solved,
    require_settings,
    status_of,
)
from planner_jax.optimise.levenberg import (
    LevenbergConfig,
    LevenbergState,
    Model,
    begun,
    go_on,
    least_squares,
)
from planner_jax.planning.select import better_of, first_solved
from planner_jax.robot.arm import product, shield_jacobian, shield_pose
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.clearance import (
    clearance_slopes,
    clearances,
    least_clearances,
    num_of_pole,
)
from planner_jax.task.block.end_poses import (
    EndPoses,
    Flight,
    all_profiles,
    coasted,
    end_poses,
    facing,
    flight_of,
    frame_of,
)
from planner_jax.task.block.motion import angles_at, polynomial, quickened, sums
from planner_jax.task.block.plan import BlockPlan, explained, no_plan

_HIGHEST = lax.Precision.HIGHEST
_PLANE = 1e-3  # [m], how far from the shield's plane the ball may be at the contact


@dataclasses.dataclass(frozen=True)
class Search(Attempt):
    """An attempt: so many straight motions, then least squares from so many starts; static.

    Two cases in three have a straight motion, nearly all of them among the first few.
    """

    starts: int = 8
    straight: int = 48  # motions that are looked at
    tries: int = 15  # starts of least squares
    first: int = 0  # place of the first of these
    kept: int = 5  # of the tries, those that are gone on with after the solver's trial
    # Whether a lane by itself has no trial, but follows each start to its end before the next.
    in_turn: bool = True
    # Of starts that led to a plan, hardly any ever cost more than the solver hopes for.
    solver: LevenbergConfig = LevenbergConfig(
        *(26, 1e-2, 0.25, 6.0), settled=1, tolerance=1.0, trial=3, hope=1000.0, fade=0.7
    )


_LEAST_SQUARES = (
    Search(straight=0, tries=4, kept=2),
    Search(straight=0, tries=11, first=4, kept=5, in_turn=False),
)
_SEARCHES = (Search(straight=6, tries=0), Search(tries=0), *_LEAST_SQUARES)
_BRISK = (Search(tries=0), *_LEAST_SQUARES)


@functools.cache
def learned_starts() -> tuple[np.ndarray, np.ndarray]:
    """Where least squares begin: places (N,) in the order of poses, and bumps (N, 6) [rad]."""
    found = json.loads((Path(__file__).parent / "learned_starts.json").read_text())
    ranks = np.array([start["rank"] for start in found], np.int32)
    return ranks, np.array([start["bump"] for start in found], np.float32)


@dataclasses.dataclass(frozen=True)
class Weights:
    """What residuals are multiplied by; static."""

    meeting: float = 100.0  # [1/m]
    tilt: float = 30.0  # [1/rad]
    limits: float = 30.0  # of relative excesses
    clearance: float = 100.0  # [1/m]
    effort: float = 0.1  # of accelerations in shares of their limits


def _violation(joints: Array, contact: Array, too_near: Array) -> Array:
    """The largest excess over a limit; a centimetre too near counts as much as a whole limit.

    Args:
        joints: (), relative, of angles, rates and accelerations.
        contact: (), relative, of the places and angles of the contact.
        too_near: () [m].
    """
    return jnp.maximum(jnp.maximum(joints, contact), 100.0 * too_near)


def _hopes(tried: LevenbergState, solver: LevenbergConfig) -> Array:
    """What searches are put in order by after their trial: their cost, the settled ones first."""
    return jnp.where(tried.stalled >= solver.settled, -1.0, tried.model.cost)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class OnlineBlock(Planner):
    """Meets a ball somewhere between the boxes; the cost of a plan is its execution time [s]."""

    case_type: ClassVar[type] = BlockCase
    is_sequential: ClassVar[bool] = True
    pieces: int = 10  # of rates
    points: int = 48  # of the ball's way, where end poses are looked at
    samples: int = 32  # of a motion, where least squares look at distances
    worst: int = 8  # of them, those at which slopes are worked out
    checked: int = 96  # samples of the plan that is given back
    margin: float = 0.003  # [m], kept from everything
    pole_margin: float = 0.012  # [m], the same of the pole, which samples may pass by
    slack: float = 0.004  # share of every limit that is kept free
    # Whether motions from rest to rest are made as quick as limits allow, and of the straight ones
    # that are looked at the quickest is taken: the arm then stands and waits for the ball.
    # Otherwise it moves until the ball is there, which asks for less torque.
    brisk: bool = False
    weights: Weights = Weights()
    searches: tuple[Search, ...] = _SEARCHES

    def __post_init__(self) -> None:
        require_settings(self)

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches."""
        return self.searches

    def solve(self, case: BlockCase, attempt: Search) -> BlockPlan:
        """The plan of one case."""
        return self._solve(case, attempt, self._one_after_another)

    def solve_at_once(self, cases: BlockCase, attempt: Search) -> BlockPlan:
        """The plans of a batch, all starts of all cases in step."""
        return jax.vmap(lambda case: self._solve(case, attempt, self._in_step))(cases)

    def _solve(self, case: BlockCase, attempt: Search, bend: Callable) -> BlockPlan:
        """The plan of one case: a straight motion, else what `bend` makes of the starts."""
        flight = flight_of(case)
        poses = end_poses(case, flight, self.points, self.pieces, quickest=self.brisk)
        ranks, bumps = (
            each[attempt.first : attempt.first + attempt.tries] for each in learned_starts()
        )
        order = self.order(poses, max(attempt.straight, 1 + max(ranks, default=0)))
        in_time = jnp.sum(poses.effort <= 1.0 - self.slack)
        straight = jnp.where(flight.comes, jnp.minimum(in_time, attempt.straight), 0)

        def plan_of(k: Array) -> BlockPlan:
            point = self.straight_point(case, poses, order[k])
            return self.plan_at(case, flight, point, jnp.zeros((), jnp.int32))

        def quicker(k: Array, best: BlockPlan) -> BlockPlan:
            plan = plan_of(k)
            return better_of(best, plan, ~is_solved(best.status) | (plan.cost < best.cost))

        best = no_plan(case, self.pieces)
        if self.brisk:
            best = lax.fori_loop(0, straight, quicker, best)
        else:
            best = first_solved(plan_of, straight, best)
        if attempt.tries:
            points = jax.vmap(lambda rank: self.straight_point(case, poses, order[rank]))(ranks)
            bent = jax.vmap(self.bump)(jnp.asarray(bumps, points.dtype))
            points = points.at[:, :-1].add(bent.reshape(attempt.tries, -1))
            best = bend(case, flight, points, attempt, best)
        return dataclasses.replace(best, status=explained(case, poses, best.status))

    def quickened(self, case: BlockCase, plan: BlockPlan) -> BlockPlan:
        """The plan on the same way as quick as limits allow, if it is from rest to rest."""
        limits, most = case.limits, 1.0 - self.slack
        motion, pace = quickened(plan.motion, most * limits.velocity, most * limits.acceleration)
        rests = is_solved(plan.status) & case.ends_at_rest & jnp.all(case.rates == 0.0)
        quick = dataclasses.replace(plan, motion=motion, cost=pace * plan.cost)
        return jax.tree.map(lambda new, old: jnp.where(rests, new, old), quick, plan)

    def _one_after_another(
        self, case: BlockCase, flight: Flight, points: Array, attempt: Search, best: BlockPlan
    ) -> BlockPlan:
        """Least squares from one start (N, n) after another until one leads to a plan."""
        if attempt.in_turn:
            tries = jnp.where(flight.comes, attempt.tries, 0)
            bent = lambda k: self.bent(case, flight, points[k], attempt.solver)  # noqa: E731
            return first_solved(bent, tries, best)
        return self._cheapest_first(case, flight, points, attempt, best)

    def _cheapest_first(
        self, case: BlockCase, flight: Flight, points: Array, attempt: Search, best: BlockPlan
    ) -> BlockPlan:
        """A trial of every start (N, n), then those to their end that cost least."""
        model, solver, tries = self._model_of(case, flight), attempt.solver, attempt.tries
        total = jnp.where(flight.comes, tries + min(attempt.kept, tries), 0)

        def next_one(turn: tuple[Array, LevenbergState, Array, BlockPlan]) -> tuple:
            k, searches, costs, best = turn
            is_trial = k < tries
            place = jnp.where(is_trial, k, jnp.argmin(costs))
            most = jnp.where(is_trial, solver.trial, solver.max_steps)
            search = go_on(model, jax.tree.map(lambda leaf: leaf[place], searches), solver, most)
            searches = jax.tree.map(lambda old, new: old.at[place].set(new), searches, search)
            costs = costs.at[place].set(jnp.where(is_trial, _hopes(search, solver), jnp.inf))
            plan = lax.cond(
                is_trial,
                lambda search: best,
                lambda search: self.plan_at(case, flight, search.point, search.steps),
                search,
            )
            return k + 1, searches, costs, better_of(best, plan, jnp.asarray(True))

        def is_open(turn: tuple[Array, LevenbergState, Array, BlockPlan]) -> Array:
            return (turn[0] < total) & ~is_solved(turn[-1].status)

        searches = jax.vmap(lambda point: begun(point, solver))(points)
        turn = (jnp.zeros((), jnp.int32), searches, jnp.full(tries, jnp.inf, points.dtype), best)
        return lax.while_loop(is_open, next_one, turn)[-1]

    def _in_step(
        self, case: BlockCase, flight: Flight, points: Array, attempt: Search, best: BlockPlan
    ) -> BlockPlan:
        """Least squares from all starts (N, n) for a trial, then from those that cost least."""
        model, solver = self._model_of(case, flight), attempt.solver
        trial = lambda point: go_on(model, begun(point, solver), solver, solver.trial)  # noqa: E731
        tried = jax.vmap(trial)(points)
        _, chosen = lax.top_k(-_hopes(tried, solver), min(attempt.kept, attempt.tries))
        kept = jax.tree.map(lambda leaf: leaf[chosen], tried)
        ends = jax.vmap(lambda state: go_on(model, state, solver))(kept)
        plans = jax.vmap(lambda end: self.plan_at(case, flight, end.point, end.steps))(ends)
        least = jnp.argmin(jnp.where(jnp.isnan(plans.violation), jnp.inf, plans.violation))
        plan = jax.tree.map(lambda leaf: leaf[least], plans)
        return better_of(best, plan, ~is_solved(best.status))

    def bent(
        self, case: BlockCase, flight: Flight, point: Array, solver: LevenbergConfig
    ) -> BlockPlan:
        """The plan to which least squares lead from unknowns (n,)."""
        end = least_squares(self._model_of(case, flight), point, solver)
        return self.plan_at(case, flight, end.point, end.steps)

    def _model_of(self, case: BlockCase, flight: Flight) -> Callable[[Array], Model]:
        return lambda point: self.model(point, case, flight)

    def order(self, poses: EndPoses, num: int) -> Array:
        """Places (num,) of poses, those first that ask little, mixed so that they differ."""
        rng = np.random.default_rng(0)
        mixed = jnp.asarray(rng.random(poses.effort.shape[0]), poses.effort.dtype)
        late = jnp.where(poses.effort > 1.0 - self.slack, 10.0 * poses.effort, 0.0)
        return lax.top_k(-(poses.effort + mixed + late), num)[1]

    def straight_point(self, case: BlockCase, poses: EndPoses, place: Array) -> Array:
        """The unknowns of a straight motion."""
        time = poses.time[place]
        duration = jnp.maximum(time - case.delay, 1e-3)
        turned = poses.angles[place] - coasted(case, duration, self.pieces)
        shapes = jnp.asarray(all_profiles(self.pieces)[0], turned.dtype)
        steps = shapes[poses.profile[place]][:, None] * turned
        return jnp.append(steps.reshape(-1), time)

    def bump(self, height: Array) -> Array:
        """Steps (K, 6) that turn joints by up to so much (6,) [rad] and back: a squared sine."""
        knots = np.arange(1, self.pieces + 1) / self.pieces
        return jnp.asarray(np.pi * np.sin(2.0 * np.pi * knots), height.dtype)[:, None] * height

    def parts(self, case: BlockCase, point: Array) -> tuple[Array, Array, Array]:
        """Steps (K, 6), the first one's rates times the duration (6,), and the duration () [s]."""
        steps = point[:-1].reshape(self.pieces, 6)
        duration = jnp.maximum(point[-1] - case.delay, 1e-3)
        last = jnp.where(case.ends_at_rest, 0.0, steps[-1])
        return steps.at[-1].set(last), case.rates * duration, duration

    def model(self, point: Array, case: BlockCase, flight: Flight) -> Model:
        """Sum of squares: the contact, the joints' limits, distances, effort."""
        steps, first, duration = self.parts(case, point)
        pieces, dtype = self.pieces, point.dtype
        of_joints, joints_push, joints_stiffness, joints_excess = self.joint_terms(
            case, steps, first, duration
        )
        # Samples: the end, and those at which the arm comes nearest to something.
        shares = tuple(np.arange(1, self.samples + 1) / self.samples)
        angles = angles_at(case.angles, first, steps, shares)
        gaps = lax.optimization_barrier(clearances(case.arm, case.scene, angles))  # (R, S)
        is_of_pole = np.arange(gaps.shape[0]) < num_of_pole(case.arm)
        margins = np.where(is_of_pole, self.pole_margin, 1.3 * self.margin)[:, None]
        near, worst = lax.top_k(jnp.max(margins - gaps, axis=0), self.worst)
        slopes = clearance_slopes(case.arm, case.scene, angles[worst])  # (R, 6, W)
        short = jnp.maximum(margins - gaps[:, worst], 0.0) * self.weights.clearance  # (R, W)
        active = jnp.where(short > 0.0, -self.weights.clearance, 0.0)
        # Held, since products would work them out anew for each of their terms.
        lifts, short = lax.optimization_barrier((slopes * active[:, None], short))
        grams = jnp.einsum("riw,rjw->wij", lifts, lifts, precision=_HIGHEST)
        pushes = jnp.einsum("riw,rw->wi", lifts, short, precision=_HIGHEST)
        # Distances do not depend on the time.
        grams, pushes = jnp.pad(grams, ((0, 0), (0, 1), (0, 1))), jnp.pad(pushes, ((0, 0), (0, 1)))
        rows, row_slopes, contact_excess = self.contact_terms(case, flight, angles[-1], point[-1])
        gram = jnp.matmul(row_slopes.T, row_slopes, precision=_HIGHEST)
        push = jnp.matmul(row_slopes.T, rows, precision=_HIGHEST)
        grams = jnp.concatenate([grams, gram[None]])
        pushes = jnp.concatenate([pushes, push[None]])
        # From angles and time at samples to the unknowns.
        of_first, of_steps = (jnp.asarray(each, dtype) for each in sums(pieces, shares))
        chosen = jnp.append(worst, self.samples - 1)
        lift, drift = of_steps[chosen], of_first[chosen][:, None] * case.rates  # (W + 1, K), (., 6)
        # Later contacts carry the angles on at the rates of the beginning.
        grams_q, grams_t = grams[:, :6, :6], grams[:, :6, 6]
        carried = jnp.einsum("wij,wj->wi", grams_q, drift, precision=_HIGHEST) + grams_t
        time_stiffness = jnp.sum(grams[:, 6, 6] + jnp.sum(drift * (carried + grams_t), axis=1))
        time_push = jnp.sum(pushes[:, 6] + jnp.sum(drift * pushes[:, :6], axis=1))
        stiffness = jnp.einsum("wk,wl,wij->kilj", lift, lift, grams_q, precision=_HIGHEST)
        coupling = jnp.einsum("wk,wi->ki", lift, carried, precision=_HIGHEST)
        steps_push = jnp.einsum("wk,wi->ki", lift, pushes[:, :6], precision=_HIGHEST)
        each = jnp.eye(6, dtype=dtype)
        of_each = joints_stiffness[:, :-1, :-1]
        stiffness += jnp.einsum("ikl,ij->kilj", of_each, each, precision=_HIGHEST)
        coupling += joints_stiffness[:, :-1, -1].T
        steps_push += joints_push[:, :-1].T
        time_push += jnp.sum(joints_push[:, -1])
        time_stiffness += jnp.sum(joints_stiffness[:, -1, -1])
        size = 6 * pieces
        curvature = jnp.zeros((size + 1, size + 1), dtype)
        curvature = curvature.at[:size, :size].set(stiffness.reshape(size, size))
        curvature = curvature.at[:size, size].set(coupling.reshape(-1))
        curvature = curvature.at[size, :size].set(coupling.reshape(-1))
        curvature = curvature.at[size, size].set(time_stiffness)
        gradient = jnp.append(steps_push.reshape(-1), time_push)
        held = jnp.where(case.ends_at_rest, 0.0, 1.0)
        free = jnp.ones(size + 1, dtype).at[size - 6 : size].set(held)
        too_near = near[0] - 0.3 * self.margin
        return Model(
            cost=of_joints + jnp.sum(rows**2) + jnp.sum(short**2),
            gradient=gradient * free,
            curvature=curvature * free[:, None] * free,
            violation=_violation(joints_excess, contact_excess, too_near),
        )

    def joint_terms(
        self, case: BlockCase, steps: Array, first: Array, duration: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Limits and effort of the joints.

        Returns:
            cost: ().
            push: (6, K + 1), by each joint's steps and the time of contact.
            stiffness: (6, K + 1, K + 1).
            excess: (), relative.
        """
        pieces, dtype = self.pieces, steps.dtype
        knots = tuple(np.arange(1, pieces + 1) / pieces)
        of_first, of_steps = (jnp.asarray(each, dtype) for each in sums(pieces, knots))
        rise = jnp.asarray(np.eye(pieces) - np.eye(pieces, k=-1), dtype)
        rates = steps / duration
        risen = steps - jnp.concatenate([first[None], steps[:-1]])
        accelerations = risen * (pieces / duration**2)
        angles = angles_at(case.angles, first, steps, knots)
        middle = 0.5 * (case.arm.upper + case.arm.lower)
        half = 0.5 * (case.arm.upper - case.arm.lower)

        def row(
            value: Array, by_steps: Array, by_time: Array, slope: float | Array
        ) -> tuple[Array, Array]:
            """Residuals (6, K) and their slopes (6, K, K + 1)."""
            slopes = jnp.concatenate([by_steps, by_time.T[:, :, None]], axis=2)
            return value.T, slopes * jnp.broadcast_to(slope, value.shape).T[:, :, None]

        def hinge(
            share: Array, by_steps: Array, by_time: Array, most: float
        ) -> tuple[Array, Array]:
            over = self.weights.limits * jnp.maximum(jnp.abs(share) - most, 0.0)
            sign = self.weights.limits * jnp.sign(share) * (over > 0.0)
            return row(over, by_steps, by_time, sign)

        most = 1.0 - self.slack
        of_rate = jnp.eye(pieces, dtype=dtype) / (duration * case.limits.velocity[:, None, None])
        rate_shares = rates / case.limits.velocity
        of_rise = rise * (pieces / duration**2 / case.limits.acceleration[:, None, None])
        rise_shares = accelerations / case.limits.acceleration
        # The first of the rises falls with the duration by half as much as the others.
        carried = jnp.zeros_like(rise_shares).at[0].set(first * pieces / duration**2)
        by_time = (-2.0 * rise_shares - carried / case.limits.acceleration) / duration
        angle_shares = (angles - middle) / half
        of_angle = of_steps / half[:, None, None]
        effort = self.weights.effort
        parts = [
            hinge(rate_shares, of_rate, -rate_shares / duration, most),
            hinge(rise_shares, of_rise, by_time, most),
            hinge(angle_shares, of_angle, of_first[:, None] * case.rates / half, most),
            row(effort * rise_shares, of_rise, by_time, effort),
        ]
        values = jnp.concatenate([value for value, _ in parts], axis=1)
        slopes = jnp.concatenate([slope for _, slope in parts], axis=1)
        excess = [jnp.max(jnp.abs(each)) for each in (rate_shares, rise_shares, angle_shares)]
        return (
            jnp.sum(values**2),
            jnp.einsum("irk,ir->ik", slopes, values, precision=_HIGHEST),
            jnp.einsum("irk,irl->ikl", slopes, slopes, precision=_HIGHEST),
            jnp.max(jnp.stack(excess)) - 1.0,
        )

    def contact_terms(
        self, case: BlockCase, flight: Flight, angles: Array, time: Array
    ) -> tuple[Array, Array, Array]:
        """How the shield meets the ball.

        Returns:
            rows: (7,): off the plane, off the middle, tilted, too early or late.
            slopes: (7, 7), by the angles at the end and the time.
            excess: (), relative.
        """
        rotation, middle = shield_pose(case.arm, angles)
        jacobian = shield_jacobian(case.arm, angles)
        ball = drag_free_flight(case.ball, time, case.gravity)
        velocity = ball.vel
        normal = rotation[:, 0]
        away = ball.pos - middle
        turns = jacobian[3:].T  # (6, 3), the axes
        moves = jacobian[:3].T
        by_normal = jnp.cross(turns, normal)
        # Off the plane of the shield.
        off = jnp.sum(away * normal)
        off_slope = jnp.append(
            product(by_normal, away) - product(moves, normal), jnp.sum(velocity * normal)
        )
        # Off its middle, within the plane.
        beside = away - off * normal
        beside_slope = jnp.concatenate([-moves, velocity[None]])
        beside_slope -= jnp.sum(beside_slope * normal, axis=1)[:, None] * normal
        distance = jnp.sqrt(jnp.maximum(jnp.sum(beside**2), 1e-12))
        spare = jnp.maximum(0.95 * case.offset - 0.002, 0.0)
        beside_share = jnp.maximum(1.0 - spare / distance, 0.0)
        # Tilted against the ball's way.
        wanted = facing(velocity)
        tilt = jnp.cross(wanted, normal)
        tilt_slope = jnp.cross(wanted, by_normal)
        sine = jnp.sqrt(jnp.maximum(jnp.sum(tilt**2), 1e-12))
        angle = jnp.arctan2(sine, jnp.sum(wanted * normal))
        room = jnp.maximum(0.93 * case.tilt - np.deg2rad(0.5), 0.0)
        tilt_share = jnp.maximum(1.0 - room / angle, 0.0) * angle / sine
        frame = frame_of(wanted)[:, 1:]
        weights = self.weights
        early = jnp.maximum(flight.earliest + 2e-3 - time, 0.0)
        late = jnp.maximum(time - flight.latest + 2e-3, 0.0)
        edge = jnp.where(early > 0.0, -1.0, jnp.where(late > 0.0, 1.0, 0.0))
        # A millisecond counts as much as a centimetre.
        pace = 10.0 * weights.meeting
        across = rotation[:, 1:]
        # The ball's way bends: its direction turns with the part of gravity across it.
        pace_squared = jnp.maximum(jnp.sum(velocity**2), 1e-12)
        pull = jnp.zeros(3, angles.dtype).at[2].set(case.gravity)
        bent = (pull - wanted * jnp.sum(wanted * pull)) / jnp.sqrt(pace_squared)
        by_time = jnp.cross(bent, normal)
        rows = jnp.concatenate(
            [
                weights.meeting * off[None],
                weights.meeting * beside_share * product(beside, across),
                weights.tilt * tilt_share * product(tilt, frame),
                pace * (early + late)[None],
            ]
        )
        is_beside = jnp.where(beside_share > 0.0, weights.meeting, 0.0)
        is_tilted = jnp.where(tilt_share > 0.0, weights.tilt, 0.0)
        tilt_rows = product(jnp.concatenate([tilt_slope, by_time[None]]), frame)
        slopes = jnp.concatenate(
            [
                weights.meeting * off_slope[None],
                is_beside * product(beside_slope, across).T,
                is_tilted * tilt_rows.T,
                pace * jnp.zeros((1, 7), angles.dtype).at[0, 6].set(edge),
            ]
        )
        excess = jnp.stack(
            [
                jnp.abs(off) / _PLANE - 1.0,
                distance / case.offset - 1.0,
                angle / case.tilt - 1.0,
                jnp.maximum(flight.earliest - time, time - flight.latest) / 1e-3,
            ]
        )
        return rows, slopes, jnp.max(excess)

    def plan_at(self, case: BlockCase, flight: Flight, point: Array, steps: Array) -> BlockPlan:
        """The plan of a point, looked at more closely."""
        moves, first, duration = self.parts(case, point)
        joints = self.joint_terms(case, moves, first, duration)[3]
        shares = tuple(np.arange(1, self.checked + 1) / self.checked)
        angles = angles_at(case.angles, first, moves, shares)
        gaps = least_clearances(case.arm, case.scene, angles)
        # Between knots, too, where a joint may turn back beyond its limit.
        middle = 0.5 * (case.arm.upper + case.arm.lower)
        half = 0.5 * (case.arm.upper - case.arm.lower)
        joints = jnp.maximum(joints, jnp.max(jnp.abs(angles - middle) / half) - 1.0)
        contact = self.contact_terms(case, flight, angles[-1], point[-1])[2]
        excess = _violation(joints, contact, self.margin - jnp.min(gaps))
        violation = jnp.where(point[-1] > case.delay, excess, jnp.inf)
        plan = BlockPlan(
            motion=polynomial(case.angles, first, moves, duration),
            contact_time=point[-1],
            cost=duration,
            violation=violation,
            iterations=jnp.asarray(steps, jnp.int32),
            status=status_of(duration, violation, violation > FEASIBILITY_TOLERANCE),
        )
        return self.quickened(case, plan) if self.brisk else plan


def brisk(**fields: Any) -> OnlineBlock:
    """The default planner, of motions that end as early as may be; the arm then waits.

    Args:
        **fields: of `OnlineBlock`.
    """
    return OnlineBlock(**{"searches": _BRISK, "brisk": True, **fields})
