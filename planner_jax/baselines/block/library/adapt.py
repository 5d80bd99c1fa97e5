"""The planner that warps stored motions to the very ball.

A library's motion ends where a nominal ball of its pair of cells comes along. Here the motions of
the pairs around the ball's own are bent until they end where this ball does: the new end pose, by
inverse kinematics on the branch of the old one, less the old end, times one shape in time, is
added. Both are steps of `planner_jax.task.block.motion`, so limits at knots stay exact, and the
motion takes all the time that there is. Those that turn the joints least are looked at first. Where
none is free, least squares of `OnlineBlock` begin with them.
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
from planner_jax.baselines.block.library.cells import Face, cells_around
from planner_jax.baselines.block.library.file import load_library
from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.baselines.block.library.table import pieces_of, unpacked
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt, Status, first_solved
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.clearance import clearances, num_of_pole
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.end_poses import EndPoses, Flight, end_poses, flight_of
from planner_jax.task.block.motion import angles_at, profiles, sums
from planner_jax.task.block.plan import BlockPlan, explain_status, make_empty_plan
from planner_jax.task.block.scene import Box

_HIGHEST = lax.Precision.HIGHEST
# How far joints are to be turned, squared, counts less for those of the wrist, which carry little;
# the joint at the flange stays as it is stored.
_WEIGHTS = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.0])
_AWAY = 0.02  # [rad^2], of a motion whose pair's cells are one cell off
_LATE = 10.0  # [rad^2], of a whole limit exceeded
_NEAR = 30.0  # [rad^2/m], of a pole that is too near at a sample


@dataclasses.dataclass(frozen=True)
class Effort(Attempt):
    """An attempt: so many stored motions warped, some of them checked, some bent; static."""

    neighbours: int = 8  # motions that are warped, up to 16
    points: int = 6  # of the ball's way, to each of which they are
    screened: int = 8  # of the warped ones, whose distances from the pole are looked at
    samples: int = 12  # of each then
    checks: int = 1  # of them at most, closely, those first that promise most
    checked: int = 48  # samples of a check
    bent: int = 0  # least squares that begin with them at most
    solver: LevenbergConfig = LevenbergConfig(
        *(12, 1e-2, 0.25, 6.0), settled=1, tolerance=1.0, trial=4, hope=500.0, fade=0.7
    )


@struct.dataclass
class Warped:
    """C warped motions, those first that promise most."""

    points: Array  # (C, 6 K + 1), unknowns of `OnlineBlock`
    promise: Array  # (C,) [rad^2], less is better; infinite without a motion
    is_open: Array  # (C,) bool, whether limits hold at knots and, at a few samples, off the pole


@struct.dataclass
class AdaptBlock(Planner):
    """Meets the very ball with a stored motion that is warped; the cost is its duration [s].

    Arm, limits and scene have to be those of the library, and the arm has to stand at one of its
    homes: else the status is BLOCKED, as `check` says on the host. It is OUT_OF_REACH for a ball
    that does not come through both boxes, and INFEASIBLE where no motion was found.
    """

    stored: LibraryBlock
    online: OnlineBlock = struct.field(pytree_node=False, default=OnlineBlock())
    efforts: tuple[Effort, ...] = struct.field(
        pytree_node=False,
        default=(
            Effort(),
            Effort(neighbours=16, points=8, screened=16, checks=6, checked=96, bent=6),
        ),
    )

    case_type: ClassVar[type] = BlockCase
    is_sequential: ClassVar[bool] = True

    @property
    def attempts(self) -> tuple[Effort, ...]:
        """The efforts: at once, and for longer."""
        return self.efforts

    def check(self, cases: BlockCase) -> None:
        """Raise `ArgumentError` unless the first of the cases is what the library was built for."""
        self.stored.check(cases)

    def solve(self, case: BlockCase, attempt: Effort) -> BlockPlan:
        """Return the plan of one case."""
        flight = flight_of(case)
        home, fits = self.stored.home_of(case)
        poses = end_poses(case, flight, attempt.points, self.online.pieces)
        warped = self.warped(case, flight, home, poses, attempt)
        goes = flight.comes & fits
        tries = jnp.where(goes, jnp.minimum(jnp.sum(warped.is_open), attempt.checks), 0)
        online = dataclasses.replace(self.online, checked=attempt.checked)

        def as_warped(k: Array) -> BlockPlan:
            return online.finish(case, flight, warped.points[k], jnp.zeros((), jnp.int32))

        def bent(k: Array) -> BlockPlan:
            return online.refine(case, flight, warped.points[k], attempt.solver)

        best = first_solved(as_warped, tries, make_empty_plan(case, online.pieces))
        if attempt.bent:
            there = jnp.sum(jnp.isfinite(warped.promise))
            most = jnp.where(goes, jnp.minimum(there, attempt.bent), 0)
            best = first_solved(bent, most, best)
        status = explain_status(case, poses, jnp.where(fits, best.status, Status.BLOCKED))
        return dataclasses.replace(best, status=status)

    def warped(
        self, case: BlockCase, flight: Flight, home: Array, poses: EndPoses, effort: Effort
    ) -> Warped:
        """Return stored motions from a home, warped to end poses at points of the ball's way."""
        online, dtype = self.online, case.angles.dtype
        pieces, num = online.pieces, effort.points
        steps, away, found = self.neighbours(case, flight, home, effort.neighbours)
        total = jnp.asarray(sums(pieces, (1.0,))[1][0], dtype)
        ends = case.angles + jnp.einsum("k,nki->ni", total, steps, precision=_HIGHEST)
        angles, is_pose = poses.angles.reshape(num, 8, 6), jnp.isfinite(poses.effort)
        # To the branch that is nearest to the stored end; a whole turn is none.
        turn = angles - ends[:, None, None]
        turn = turn - 2.0 * jnp.pi * jnp.round(turn / (2.0 * jnp.pi))
        far = jnp.sum(jnp.asarray(_WEIGHTS, dtype) * turn**2, axis=-1)  # (N, P, 8)
        far = jnp.where(is_pose.reshape(num, 8), far, jnp.inf)
        branch = jnp.argmin(far, axis=-1)[..., None]
        turn = jnp.take_along_axis(turn, branch[..., None], axis=2)[:, :, 0].at[..., 5].set(0.0)
        time = poses.time.reshape(num, 8)[:, 0]
        duration = jnp.maximum(time - case.delay, 1e-3)
        shape = jnp.asarray(profiles(pieces, True)[0], dtype)[:, None]
        moves = steps[:, None] + shape * turn[:, :, None]  # (N, P, K, 6)
        rise = moves - jnp.pad(moves, ((0, 0), (0, 0), (1, 0), (0, 0)))[:, :, :-1]
        of_rate = jnp.max(jnp.abs(moves) / case.limits.velocity, axis=(2, 3)) / duration
        of_rise = jnp.max(jnp.abs(rise) / case.limits.acceleration, axis=(2, 3))
        share = jnp.maximum(of_rate, of_rise * (pieces / duration**2))
        late = jnp.maximum(share - (1.0 - online.slack), 0.0)
        promise = jnp.min(far, axis=-1) + _AWAY * away[:, None] + _LATE * late
        promise = jnp.where(found[:, None], promise, jnp.inf).reshape(-1)
        least, place = lax.top_k(-promise, effort.screened)
        moves = moves.reshape(-1, pieces, 6)[place]
        short = self.short_of_pole(case, moves, effort.samples)
        cost = _NEAR * jnp.maximum(short, 0.0) - least
        order = lax.top_k(-cost, effort.screened)[1]
        place, moves = place[order], moves[order]
        points = moves.reshape(effort.screened, -1)
        return Warped(
            points=jnp.concatenate([points, time[place % num][:, None]], axis=1),
            promise=-least[order],
            is_open=(late.reshape(-1)[place] <= 0.0) & (short[order] <= 0.0),
        )

    def neighbours(
        self, case: BlockCase, flight: Flight, home: Array, num: int
    ) -> tuple[Array, Array, Array]:
        """Return motions stored for the cells around the ball's own.

        Returns:
            steps: (N, K, 6) [rad]; zero without one.
            away: (N,), squares of how many cells they are off, in all directions.
            found: (N,) bool.
        """
        table = self.stored.library.table
        layout = table.layout

        def around(faces: tuple[Face, ...], box: Box, time: Array) -> tuple[Array, Array, Array]:
            place = drag_free_flight(case.ball, time, case.gravity).pos
            return cells_around(faces, box, tuple(place))

        first, first_away, is_first = around(layout.outer, table.outer, flight.earliest)
        last, last_away, is_last = around(layout.inner, table.inner, flight.latest)
        away = (first_away[:, None] + last_away).reshape(-1)
        pairs = (first[:, None] * layout.num_inner + last).reshape(-1)
        away, nearest = lax.top_k(-away, num)
        rows = jnp.asarray(table.rows)
        places = home * rows.shape[1] + pairs[nearest]
        flat = rows.reshape(-1, rows.shape[2])  # gathered quicker than by two places
        row = unpacked(flat.at[places].get(mode="promise_in_bounds"))
        found = jnp.isfinite(row.duration) & is_first & is_last
        return jnp.where(found[:, None, None], row.steps, 0.0), -away, found

    def short_of_pole(self, case: BlockCase, moves: Array, samples: int) -> Array:
        """Return how much nearer to the pole than they may some motions (C, K, 6) get, (C,) [m]."""
        shares = tuple(np.arange(1, samples + 1) / samples)
        rest = jnp.zeros_like(case.angles)
        angles = jax.vmap(lambda steps: angles_at(case.angles, rest, steps, shares))(moves)
        gaps = clearances(case.arm, case.scene, angles.reshape(-1, 6))[: num_of_pole(case.arm)]
        return self.online.pole_margin - jnp.min(gaps.reshape(-1, len(moves), samples), axis=(0, 2))


def adapt_planner(file: str | os.PathLike) -> AdaptBlock:
    """Return the planner of a file that `planner-jax library build` wrote.

    The table is read, and kept on the default device.

    Raises:
        ArgumentError: the file is no whole library, or one of motions with another number of
            pieces than the planner's; one line.
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
