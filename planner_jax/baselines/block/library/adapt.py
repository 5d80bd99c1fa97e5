"""The planner that warps stored motions to a given ball, for better blocks than a pure lookup.

A ball passes a pair of cells: one cell of the outer and one cell of the inner box around the arm. A
stored motion ends where a nominal ball of its pair passes. This planner takes the motions stored
for the cells around the given ball, and warps each until it ends where the given ball passes. A
warp changes all joint angles by a profile in time, such that the end pose becomes a pose that meets
the ball (by inverse kinematics). A warped motion lasts until the ball arrives. Motions with the
smallest warp are evaluated first. If no warped motion is collision-free, the warped motions are the
initial guesses of the planner `online`.
"""

import dataclasses
import os
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.ball.flight import drag_free_flight
from planner_jax.baselines.block.direct import select_first_solved
from planner_jax.baselines.block.library.cells import Face, cells_around
from planner_jax.baselines.block.library.file import load_library
from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.baselines.block.library.table import pieces_of, unpack_rows
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt, Status
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.clearance import clearances, num_of_obstacles
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.end_poses import EndPoses, Flight, end_poses, flight_of
from planner_jax.task.block.motion import angles_at, profiles, step_weights
from planner_jax.task.block.plan import BlockPlan, explain_status, make_empty_plan, mark_blocked
from planner_jax.task.block.scene import Box

_HIGHEST = lax.Precision.HIGHEST
# Weights of six joints in the squared change of a stored motion's end pose. The wrist joints have
# low weights, since they carry little mass; the last joint keeps its stored angles.
_WEIGHTS = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.0])
# [rad^2], weight of the squared distance, in cell sizes, between the point where a ball enters a
# box around the arm and the centre of the box's cell for which a motion was stored.
_AWAY = 0.02
_LATE = 10.0  # [rad^2], penalty of a motion that exceeds a joint limit by 100 %
_NEAR = 30.0  # [rad^2/m], penalty per metre by which the arm is too close to an obstacle


@dataclasses.dataclass(frozen=True)
class Effort(Attempt):
    """Settings of one search: how many stored motions are changed (warped), checked, optimised."""

    neighbours: int = 8  # number of stored motions that are warped, up to 16
    points: int = 6  # number of points of the ball's trajectory to which each motion is warped
    screened: int = 8  # number of warped motions whose distances from obstacles are computed
    samples: int = (
        12  # number of samples of a motion at which its distance from obstacles is tested
    )
    checks: int = 1  # greatest number of motions checked for all collisions, least penalty first
    checked: int = 48  # number of samples of a motion in this check
    refined: int = 0  # greatest number of motions that are refined by least squares
    solver: LevenbergConfig = LevenbergConfig(
        *(12, 1e-2, 0.25, 6.0), settled=1, tolerance=1.0, trial=4, hope=500.0, fade=0.7
    )


@struct.dataclass
class Warped:
    """C stored motions, warped to meet the given ball, in the order in which they are checked."""

    # (C, 6 K + 1): rates of 6 joints at K knots, times the duration [rad]; then contact time [s].
    points: Array
    # (C,) [rad^2], squared change of the end pose, plus penalties; infinite if none is stored.
    penalty: Array
    is_open: Array  # (C,) bool, whether joint limits and the least distance from obstacles are kept


@struct.dataclass
class AdaptBlock(Planner):
    """A planner that warps a stored motion so that it meets the ball; the cost is its duration [s].

    Arm, limits and scene must equal the library's, and the arm must stand at one of the library's
    start poses. Otherwise the status is BLOCKED, and the method `check` raises an error. The status
    is OUT_OF_REACH for a ball that does not pass both boxes around the arm, and INFEASIBLE if no
    motion was found.
    """

    stored: LibraryBlock
    online: OnlineBlock = struct.field(pytree_node=False, default=OnlineBlock())
    efforts: tuple[Effort, ...] = struct.field(
        pytree_node=False,
        default=(
            Effort(),
            Effort(neighbours=16, points=8, screened=16, checks=6, checked=96, refined=6),
        ),
    )

    case_type: ClassVar[type] = BlockCase
    is_sequential: ClassVar[bool] = True

    @property
    def attempts(self) -> tuple[Effort, ...]:
        """The attempts: a quick search, then a longer search for the unsolved cases."""
        return self.efforts

    def check(self, cases: BlockCase) -> None:
        """Raise `ArgumentError` unless arm, limits, scene and start of case 0 fit the library.

        Other cases of a batch that do not fit get plans with the status BLOCKED.
        """
        self.stored.check(cases)

    def solve(self, case: BlockCase, attempt: Effort) -> BlockPlan:
        """Return a plan: the first warped motion that keeps all limits, or else a refined one."""
        flight = flight_of(case)
        home, fits = self.stored.home_of(case)
        poses = end_poses(case, flight, attempt.points, self.online.pieces)
        candidates = self.warp(case, flight, home, poses, attempt)
        is_possible = flight.comes & fits
        tries = jnp.where(is_possible, jnp.minimum(jnp.sum(candidates.is_open), attempt.checks), 0)
        online = dataclasses.replace(self.online, checked=attempt.checked)

        def check_one(k: Array) -> BlockPlan:
            return online.finish(case, flight, candidates.points[k], jnp.zeros((), jnp.int32))

        def refine_one(k: Array) -> BlockPlan:
            return online.refine(case, flight, candidates.points[k], attempt.solver)

        best = select_first_solved(check_one, tries, make_empty_plan(case, online.pieces))
        if attempt.refined:
            there = jnp.sum(jnp.isfinite(candidates.penalty))
            most = jnp.where(is_possible, jnp.minimum(there, attempt.refined), 0)
            best = select_first_solved(refine_one, most, best)
        status = mark_blocked(case, jnp.where(fits, best.status, Status.BLOCKED))
        return dataclasses.replace(best, status=explain_status(poses, status))

    def warp(
        self, case: BlockCase, flight: Flight, home: Array, poses: EndPoses, effort: Effort
    ) -> Warped:
        """Return stored motions, changed (warped) such that they end in poses that meet the ball.

        `flight` has the times at which the ball enters both boxes, `home` is the index of the start
        pose, and `poses` has eight end poses at each of `effort.points` points of the ball's path.
        The result has `effort.screened` motions.
        """
        online, dtype = self.online, case.angles.dtype
        pieces, num = online.pieces, effort.points
        steps, away, found = self.neighbours(case, flight, home, effort.neighbours)
        total = jnp.asarray(step_weights(pieces, (1.0,))[1][0], dtype)
        ends = case.angles[None] + jnp.einsum("k,nki->ni", total, steps, precision=_HIGHEST)
        angles, is_pose = poses.angles.reshape(num, 8, 6), jnp.isfinite(poses.effort)
        # Of the eight solutions of inverse kinematics, select the one nearest to the stored end
        # pose; full turns make no difference.
        turn = angles - ends[:, None, None]
        turn = turn - 2.0 * jnp.pi * jnp.round(turn / (2.0 * jnp.pi))
        weights = jnp.asarray(_WEIGHTS, dtype)[None, None, None]
        far = jnp.sum(weights * turn**2, axis=-1)  # (N, P, 8)
        far = jnp.where(is_pose.reshape(num, 8), far, jnp.inf)
        branch = jnp.argmin(far, axis=-1)[..., None]
        turn = jnp.take_along_axis(turn, branch[..., None], axis=2)[:, :, 0].at[..., 5].set(0.0)
        time = poses.time.reshape(num, 8)[:, 0]
        duration = jnp.maximum(time - case.delay, 1e-3)[None]
        shape = jnp.asarray(profiles(pieces, True)[0], dtype)[None, None, :, None]
        moves = steps[:, None] + shape * turn[:, :, None]  # (N, P, K, 6)
        rise = moves - jnp.pad(moves, ((0, 0), (0, 0), (1, 0), (0, 0)))[:, :, :-1]
        fastest, steepest = case.limits.velocity, case.limits.acceleration
        of_rate = jnp.max(jnp.abs(moves) / fastest[None, None, None], axis=(2, 3)) / duration
        of_rise = jnp.max(jnp.abs(rise) / steepest[None, None, None], axis=(2, 3))
        share = jnp.maximum(of_rate, of_rise * (pieces / duration**2))
        late = jnp.maximum(share - (1.0 - online.slack), 0.0)
        penalty = jnp.min(far, axis=-1) + _AWAY * away[:, None] + _LATE * late
        penalty = jnp.where(found[:, None], penalty, jnp.inf).reshape(-1)
        least, place = lax.top_k(-penalty, effort.screened)
        moves = moves.reshape(-1, pieces, 6)[place]
        short = self.obstacle_shortfall(case, moves, effort.samples)
        cost = _NEAR * jnp.maximum(short, 0.0) - least
        order = lax.top_k(-cost, effort.screened)[1]
        place, moves = place[order], moves[order]
        points = moves.reshape(effort.screened, -1)
        return Warped(
            points=jnp.concatenate([points, time[place % num][:, None]], axis=1),
            penalty=-least[order],
            is_open=(late.reshape(-1)[place] <= 0.0) & (short[order] <= 0.0),
        )

    def neighbours(
        self, case: BlockCase, flight: Flight, home: Array, num: int
    ) -> tuple[Array, Array, Array]:
        """Return the N = `num` motions from start pose `home` for the cells nearest to the ball.

        Returns:
            steps: (N, K, 6) [rad], rates of the joints at K knots of the motion, times its
                duration; zero if no motion is stored.
            away: (N,), sum of the squared distances between the centres of the motion's two cells
                and the points where the ball enters the two boxes, in cell sizes.
            found: (N,) bool, whether a motion is stored.
        """
        table = self.stored.library.table
        layout = table.layout

        def around(faces: tuple[Face, ...], box: Box, time: Array) -> tuple[Array, Array, Array]:
            place = drag_free_flight(case.ball, time, case.gravity).pos
            return cells_around(faces, box, tuple(place))

        first, first_away, is_first = around(layout.outer, table.outer, flight.earliest)
        last, last_away, is_last = around(layout.inner, table.inner, flight.latest)
        away = (first_away[:, None] + last_away[None]).reshape(-1)
        pairs = (first[:, None] * layout.num_inner + last[None]).reshape(-1)
        away, nearest = lax.top_k(-away, num)
        rows = jnp.asarray(table.rows)
        indices = home * rows.shape[1] + pairs[nearest]
        flat = rows.reshape(-1, rows.shape[2])  # one index gathers faster than two
        row = unpack_rows(flat.at[indices].get(mode="promise_in_bounds"))
        found = jnp.isfinite(row.duration) & is_first & is_last
        return jnp.where(found[:, None, None], row.steps, 0.0), -away, found

    def obstacle_shortfall(self, case: BlockCase, moves: Array, samples: int) -> Array:
        """Return the required minus the least distance from obstacles, (C,) [m], of C motions.

        `moves` (C, K, 6) [rad] has the joints' rates at K knots, times the duration. Distances are
        computed at `samples` times of each motion.
        """
        shares = tuple(np.arange(1, samples + 1) / samples)
        rest = jnp.zeros_like(case.angles)
        angles = jax.vmap(lambda steps: angles_at(case.angles, rest, steps, shares))(moves)
        gaps = clearances(case.arm, case.scene, angles.reshape(-1, 6))[
            : num_of_obstacles(case.arm, case.scene)
        ]
        return self.online.obstacle_margin - jnp.min(
            gaps.reshape(-1, len(moves), samples), axis=(0, 2)
        )


def adapt_planner(file: str | os.PathLike) -> AdaptBlock:
    """Return the adapting planner for a file that `planner-jax library build` wrote.

    The library's motions are read completely and stored on the default device.

    Raises:
        ArgumentError: the file is not a complete library, or its motions have another number of
            pieces than the motions of the planner `online`.
    """
    library, own = load_library(file), OnlineBlock().pieces
    if (pieces := pieces_of(library.table.rows)) != own:
        raise ArgumentError(
            "library",
            f"motions of {own} pieces",
            verb="have",
            shown=f"{pieces} in {os.fspath(file)!r}",
        )
    rows = jnp.asarray(np.asarray(library.table.rows))
    table = dataclasses.replace(library.table, rows=rows)
    return AdaptBlock(LibraryBlock(dataclasses.replace(library, table=table)))
