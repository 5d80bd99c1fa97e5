"""Motions of the arm that block the balls of one pair of cells [Natarajan2024, Algorithm 1].

A pair is one cell of the outer and one cell of the inner box around the arm that a ball passes.
`build` calls these planners for every pair. The paper plans to equidistant points of the line
between the two cells' centres, and stores the motion of least duration, as `insat_pairs` does. Here
a ball flies from centre to centre, and the planners store the motion with which this ball may enter
the outer box earliest after the start of the motion.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.ball.flight import drag_free_flight
from planner_jax.baselines.block.library.cells import farthest_crossing, nominal_ball
from planner_jax.baselines.block.library.table import Setting
from planner_jax.core import GRAVITY
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import (
    FEASIBILITY_TOLERANCE,
    BaseAttempt,
    Plan,
    Status,
    is_solved,
    status_of,
)
from planner_jax.optimise.levenberg import LevenbergConfig, Model, least_squares
from planner_jax.robot.arm import product, shield_inradius, shield_jacobian, shield_pose
from planner_jax.robot.arm_clearance import least_clearances
from planner_jax.robot.arm_ik import inverse_kinematics
from planner_jax.robot.arm_motion import angles_at, bump_steps, step_weights
from planner_jax.task.block.case import STRICT, BlockCase
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.problem.end_poses import EndPoses, face_ball, frame_of, profile_peaks
from planner_jax.task.block.problem.flight import Flight
from planner_jax.task.block.search.attempts import read_learned_starts

# Greatest distance [m] between ball and shield centre, and greatest angle [rad] between ball
# direction and shield normal, at the end of a stored motion. COARSE applies if no motion keeps FINE
# (2 mm, 0.5 degrees), since a shield that blocks some balls is better than no shield.
FINE, COARSE = STRICT, (0.08, np.deg2rad(20.0))
# [s], how much later than without obstacles a ball may come; if not even this ball can be blocked,
# no motion is stored for the two cells through which it flies.
_PATIENCE = 0.8
# [rad], greatest angle of a shield's edge from horizontal, if it must block all balls of a pair.
_ROLL = np.deg2rad(1.0)
# [s] Penalty of end poses that collide. It is added to a time in seconds by which end poses are
# sorted, so that these poses are tried last.
_TOUCHING = 10.0
# Least distance of a shield from each of the two cells that the ball passes, as a fraction of the
# distance between the cells: for accurate contacts (FINE), and for other contacts (COARSE).
_NEAREST = (0.1, 0.02)


@struct.dataclass
class PairCase:
    """Two cells, on two boxes, that a ball passes, and an initial guess of a motion to block it."""

    outer: Array  # (2, 3) [m], corners of the outer cell's part in front of the inner cell
    inner: Array  # (2, 3) [m], corners of the inner cell
    is_coarse: Array  # () bool, whether blocking some balls through both cells suffices
    best: Array  # () [s], earliest entry of a ball that a known motion blocks; or infinite
    start: Array  # () int32, index of a stored initial guess; -1 selects the guess `given`
    # (6 K + 1,): rates of 6 joints at K knots, times the duration [rad]; then the duration [s].
    given: Array

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The shape of the batch: () for one pair of cells, (B,) for a batch of pairs."""
        return np.shape(self.best)


@struct.dataclass
class PairPlan(Plan):
    """A motion that blocks a ball; its cost is the earliest time [s] at which the ball may enter.

    The time counts from the motion's start to the ball's entry into the outer box around the arm.
    """

    # (6 K + 1,): rates of 6 joints at K knots, times the duration [rad]; then the duration [s].
    point: Array
    quickest: Array  # () [s], entry time that the quickest motion without obstacles allows


@struct.dataclass
class PairPlanner(Planner):
    """Base class of the two planners whose motions block balls that pass two cells.

    The shield ends with a horizontal edge. Quarter turns of a square shield make no difference; the
    planner selects the one that turns the last joint least from the start pose `home`.
    """

    setting: Setting
    home: Array  # (6,) [rad], joint angles at which motions start
    online: OnlineBlock = struct.field(pytree_node=False, default=OnlineBlock())
    points: int = struct.field(pytree_node=False, default=5)  # points tried between the cells

    case_type: ClassVar[type] = PairCase
    is_sequential: ClassVar[bool] = True

    def case_of(self, pair: PairCase, entry: Array) -> tuple[BlockCase, Flight]:
        """Return a case whose ball enters the outer box at `entry` [s], and its contact window."""
        ball, span = nominal_ball(pair.outer, pair.inner)
        gravity = jnp.asarray(GRAVITY, span.dtype)
        case = BlockCase(
            ball=drag_free_flight(ball, -entry, gravity),
            gravity=gravity,
            ball_radius=jnp.zeros_like(span),
            delay=jnp.zeros_like(span),
            angles=self.home,
            rates=jnp.zeros_like(self.home),
            arm=self.setting.arm,
            limits=self.setting.limits,
            ends_at_rest=self.setting.ends_at_rest,
            offset=jnp.where(pair.is_coarse, COARSE[0], FINE[0]).astype(span.dtype),
            tilt=jnp.where(pair.is_coarse, COARSE[1], FINE[1]).astype(span.dtype),
            scene=self.setting.scene,
        )
        here = jnp.asarray(True)
        near = span * jnp.where(pair.is_coarse, *_NEAREST[::-1]).astype(span.dtype)
        flight = Flight(earliest=entry + near, latest=entry + span - near, comes=here)
        return case, flight

    def poses(self, pair: PairCase) -> EndPoses:
        """Return eight end poses at each of several points between the cells' centres.

        Returns:
            End poses. Their `time` [s] is the duration of the quickest motion with all joints in
            proportion. Their `effort`, by which poses are sorted, is the time [s] at which the ball
            may enter the outer box so that this motion blocks it. It is `_TOUCHING` greater if the
            arm touches something in this pose, and infinite if the pose does not exist or balls
            through both cells can miss the shield.
        """
        online, arm, limits = self.online, self.setting.arm, self.setting.limits
        ball, span = nominal_ball(pair.outer, pair.inner)
        shares = (np.arange(self.points) + 1.0) / (self.points + 1.0)

        def of_point(time: Array) -> tuple[Array, Array]:
            there = drag_free_flight(ball, time, jnp.asarray(GRAVITY, time.dtype))
            rotation = frame_of(face_ball(there.vel))
            far = farthest_crossing(pair.outer, pair.inner, there.pos, rotation)
            angles, found = inverse_kinematics(arm, rotation, there.pos)
            return angles, found & (pair.is_coarse | (far < shield_inradius(arm)))

        after = jnp.asarray(shares, span.dtype) * span
        angles, found = jax.vmap(of_point)(after)
        angles, found = angles.reshape(-1, 6), found.reshape(-1)
        quarter = 0.5 * jnp.pi
        roll = angles[:, 5] + quarter * jnp.round((self.home[5] - angles[:, 5]) / quarter)
        angles = angles.at[:, 5].set(roll)
        found = found & (roll >= arm.lower[5]) & (roll <= arm.upper[5])
        rates, rises, rests = profile_peaks(online.pieces)
        most = 1.0 - online.slack
        turned = jnp.abs(angles - self.home)
        of_rate = jnp.max(turned / limits.velocity, axis=1) / most
        of_rise = jnp.sqrt(jnp.max(turned / limits.acceleration, axis=1) / most)
        durations = jnp.maximum(of_rate[:, None] * rates, of_rise[:, None] * np.sqrt(rises))
        durations = jnp.where(rests | ~self.setting.ends_at_rest, durations, jnp.inf)
        duration = jnp.maximum(jnp.min(durations, axis=1), 1e-3)
        near = least_clearances(arm, self.setting.scene, angles)
        entry = duration - jnp.repeat(after, 8)
        entry = jnp.where(near >= online.margin, entry, entry + _TOUCHING)
        return EndPoses(
            angles=angles,
            time=duration,
            effort=jnp.where(found, entry, jnp.inf),
            profile=jnp.argmin(durations, axis=1).astype(jnp.int32),
            is_found=found,
        )

    def model(self, pair: PairCase, point: Array, case: BlockCase, flight: Flight) -> Model:
        """Return a quadratic model of the cost at `point`, encoded as `PairPlan.point`.

        The cost is the planner `online`'s, plus the square of the roll: the angle [rad] of the
        square shield's nearest edge from horizontal. With `is_coarse` the roll has no cost.
        """
        online = self.online
        model = online.model(point, case, flight)
        moves, first, _ = online.decode(case, point)
        angles = angles_at(case.angles, first, moves, (1.0,))[0]
        rotation, _ = shield_pose(case.arm, angles)
        ball = drag_free_flight(case.ball, point[-1], case.gravity)
        frame = frame_of(face_ball(ball.vel))
        cosine = jnp.sum(rotation[:, 1] * frame[:, 1])
        roll = jnp.arctan2(jnp.sum(rotation[:, 1] * frame[:, 2]), cosine)
        roll = roll - 0.5 * jnp.pi * jnp.round(roll / (0.5 * jnp.pi))
        by_angles = product(shield_jacobian(case.arm, angles)[3:].T, rotation[:, 0])
        of_steps = jnp.asarray(step_weights(online.pieces, (1.0,))[1][0], point.dtype)
        held = jnp.where(case.ends_at_rest, 0.0, of_steps[-1])
        slope = jnp.append((of_steps.at[-1].set(held)[:, None] * by_angles[None]).reshape(-1), 0.0)
        weight = jnp.where(pair.is_coarse, 0.0, online.weights.tilt**2)
        off = jnp.where(pair.is_coarse, -1.0, jnp.abs(roll) / _ROLL - 1.0)
        return Model(
            cost=model.cost + weight * roll**2,
            gradient=model.gradient + weight * roll * slope,
            curvature=model.curvature + weight * slope[:, None] * slope[None],
            violation=jnp.maximum(model.violation, off),
        )

    def plan_at(self, pair: PairCase, point: Array, entry: Array, steps: Array) -> PairPlan:
        """Return the plan of the motion `point` (6 K + 1,), encoded as `PairPlan.point`.

        The ball enters the outer box at time `entry` () [s]. Balls through both cells cross the
        shield's plane at most a distance d from its centre; d / (half its edge) - 1 counts as a
        violation. `steps` is the plan's number of solver iterations.
        """
        case, flight = self.case_of(pair, entry)
        plan = self.online.finish(case, flight, point, steps)
        moves, first, _ = self.online.decode(case, point)
        rotation, middle = shield_pose(case.arm, angles_at(case.angles, first, moves, (1.0,))[0])
        far = farthest_crossing(pair.outer, pair.inner, middle, rotation)
        beyond = jnp.where(pair.is_coarse, 0.0, far / shield_inradius(case.arm) - 1.0)
        violation = jnp.maximum(plan.violation, beyond)
        return PairPlan(
            cost=entry,
            violation=violation,
            iterations=plan.iterations,
            status=status_of(plan.cost, violation, violation > FEASIBILITY_TOLERANCE),
            point=point,
            quickest=entry,
        )


@struct.dataclass
class StraightPair(PairPlanner):
    """A planner that selects among motions with all joints in proportion (straight motions).

    The plan is the first collision-free motion, ordered by when the ball may enter the outer box.
    """

    @property
    def attempts(self) -> tuple[BaseAttempt, ...]:
        """The only attempt, which checks all straight motions in turn."""
        return (BaseAttempt(),)

    def solve(self, pair: PairCase, attempt: BaseAttempt) -> PairPlan:
        """Return the plan of a pair of cells: the best straight motion that keeps all limits."""
        poses = self.poses(pair)
        order = jnp.argsort(poses.effort)
        possible = jnp.sum(poses.effort < 0.5 * _TOUCHING)
        case, _ = self.case_of(pair, jnp.zeros_like(pair.best))

        def next_one(state: tuple) -> tuple:
            k, _ = state
            place = order[k]
            point = self.online.encode_straight(case, poses, place)
            entry = jnp.where(k < possible, poses.effort[place], 0.0)
            return k + 1, self.plan_at(pair, point, entry, jnp.zeros((), jnp.int32))

        def is_open(state: tuple) -> Array:
            k, plan = state
            return (k < possible) & ~is_solved(plan.status)

        still = jnp.zeros((6 * self.online.pieces + 1,), pair.best.dtype)
        none = jnp.full_like(pair.best, jnp.inf)
        nothing = PairPlan(
            cost=none,
            violation=none,
            iterations=jnp.zeros((), jnp.int32),
            status=jnp.full((), Status.OUT_OF_REACH, jnp.int32),
            point=still,
            quickest=none,
        )
        _, plan = lax.while_loop(is_open, next_one, (0, nothing))
        solved = is_solved(plan.status)
        return dataclasses.replace(
            plan,
            cost=jnp.where(solved, plan.cost, jnp.inf),
            violation=jnp.where(solved, plan.violation, jnp.inf),
            quickest=_entry(jnp.min(poses.effort)),
        )


def _entry(effort: Array) -> Array:
    return jnp.where(effort > 0.5 * _TOUCHING, effort - _TOUCHING, effort)


@dataclasses.dataclass(frozen=True)
class Bends(BaseAttempt):
    """Settings of a bisection of the ball's entry time; least squares plans for each time."""

    rounds: int = 4
    solver: LevenbergConfig = LevenbergConfig(
        16, damping=1e-2, ease=0.25, tighten=6.0, settled=1, tolerance=1.0
    )


@struct.dataclass
class BentPair(PairPlanner):
    """A planner that bends motions around obstacles by the least squares of the planner `online`.

    The initial guess is a stored guess, or the motion `PairCase.given`. The planner bisects the
    time at which the ball enters the outer box around the arm. The lower bound is the time that
    the quickest motion without obstacles allows. The upper bound is the entry time of the best
    motion so far, or 0.8 s after the lower bound if no motion has been found.
    """

    search: Bends = struct.field(pytree_node=False, default=Bends())

    @property
    def attempts(self) -> tuple[Bends, ...]:
        """The only attempt: a bisection of the ball's entry time, with the settings `search`."""
        return (self.search,)

    def solve(self, pair: PairCase, attempt: Bends) -> PairPlan:
        """Return the plan of a pair of cells: the motion found for the ball that comes earliest."""
        online, dtype = self.online, pair.best.dtype
        poses = self.poses(pair)
        order = jnp.argsort(poses.effort)
        possible = jnp.sum(jnp.isfinite(poses.effort))
        ranks, bumps = (jnp.asarray(each) for each in read_learned_starts())
        number = pair.start % len(ranks)
        place = order[jnp.clip(ranks[number], 0, jnp.maximum(possible - 1, 0))]
        of_place = jnp.where(possible > 0, _entry(poses.effort[place]), 0.0)
        quickest = jnp.where(possible > 0, _entry(jnp.min(poses.effort)), 0.0)
        case, _ = self.case_of(pair, jnp.zeros_like(of_place))
        bump = bump_steps(bumps[number], online.pieces).reshape(-1)
        learned = online.encode_straight(case, poses, place).at[:-1].add(bump.astype(dtype))
        is_given = pair.start < 0
        start = jnp.where(is_given, pair.given, learned)
        span = nominal_ball(pair.outer, pair.inner)[1]
        entry = jnp.where(is_given, pair.given[-1] - 0.5 * span, of_place)
        none = jnp.isinf(pair.best)
        high = jnp.where(none, quickest + _PATIENCE, pair.best)
        first = jnp.where(none, high, 0.5 * (quickest + high))

        def shift(point: Array, old: Array, new: Array) -> Array:
            return point.at[-1].set(jnp.maximum(point[-1] + new - old, 0.02))

        def one_round(k: Array, state: tuple) -> tuple:
            low, high, tried, point, of_point, best = state
            case, flight = self.case_of(pair, tried)
            model = lambda point: self.model(pair, point, case, flight)  # noqa: E731
            end = least_squares(model, shift(point, of_point, tried), attempt.solver)
            plan = self.plan_at(pair, end.point, tried, end.steps)
            good = is_solved(plan.status)
            best = jax.tree.map(lambda new, old: jnp.where(good, new, old), plan, best)
            low, high = jnp.where(good, low, tried), jnp.where(good, tried, high)
            point, of_point = jnp.where(good, end.point, point), jnp.where(good, tried, of_point)
            return low, high, 0.5 * (low + high), point, of_point, best

        nothing = PairPlan(
            cost=jnp.full_like(entry, jnp.inf),
            violation=jnp.full_like(entry, jnp.inf),
            iterations=jnp.zeros((), jnp.int32),
            status=jnp.full((), Status.NO_PATH, jnp.int32),
            point=jnp.zeros_like(start),
            quickest=quickest,
        )

        def is_open(state: tuple) -> Array:
            k, (_, _, _, _, _, best) = state
            continues = (k == 0) | ~none | is_solved(best.status)
            return (k < attempt.rounds) & continues & (possible > 0)

        state = (quickest, high, first, start, entry, nothing)
        _, state = lax.while_loop(
            is_open, lambda s: (s[0] + 1, one_round(s[0], s[1])), (jnp.zeros((), jnp.int32), state)
        )
        return dataclasses.replace(state[-1], quickest=quickest)
