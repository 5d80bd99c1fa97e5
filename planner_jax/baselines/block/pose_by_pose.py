"""Planners on the host that try one end pose after another [Natarajan2024, Section IV-C].

Its goals are poses at equidistant points of a tunnel, "sequentially until it succeeds". Here they
are at points of the ball's own way, each with the eight branches of inverse kinematics; poses at
which the arm would touch something or be too late whatever its way are left out, and those come
first to which a bang-bang motion takes the least share of the time there is. A motion that comes
too late ends the search only if the planner is not `patient`. In the paper it must have: there
RRT-Connect takes 18 ms of 2 s, and less than half of the motions that it finds are in time.
"""

import abc
import dataclasses
import functools
import time
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.baselines.block.direct import poses_in_time
from planner_jax.baselines.block.free_space import FreeSpace
from planner_jax.baselines.block.path_timing import DEGREE, PIECES, required, timed_way
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt, Status, require_settings, take
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan, explain_status
from planner_jax.trajectory.polynomial import PiecewisePolynomial

Clock = Callable[[], float]  # seconds that are left


@dataclasses.dataclass(frozen=True)
class Goal:
    """An end pose that is tried."""

    angles: np.ndarray  # (6,) [rad]
    available: float  # [s], from the delay until the ball is there


@dataclasses.dataclass(frozen=True)
class HostMotion:
    """A motion of the joints from the delay on; no more pieces than its planner's."""

    coeffs: np.ndarray  # (M, D + 1, 6) [rad/s^k]
    durations: np.ndarray  # (M,) [s]
    execution: float  # [s], how long the arm moves; before that it may wait


@dataclasses.dataclass(frozen=True)
class PoseByPose(Planner, abc.ABC):
    """What such planners share; the cost of a plan is how long its motion takes [s].

    A plan's `violation` is by how much the motion is longer than the time there is, relative, and
    infinite if no motion was found; `iterations` are the poses that were tried. Motions begin at
    rest: an arm that is moving at the start is given none.
    """

    case_type: ClassVar[type] = BlockCase
    attempts: ClassVar[tuple[Attempt, ...]] = (Attempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    pieces: ClassVar[int]
    degree: ClassVar[int]
    points: int = 12  # of the ball's way, where end poses are looked at
    budget: float = 2.0  # [s], of the search of each case; the paper's
    longest: float = 0.25  # [s] of it, for one pose; twice as much whenever all were tried
    patient: bool = True  # whether poses are tried on until a motion is in time, not only found
    margin: float = 0.003  # [m], kept from everything

    def __post_init__(self) -> None:
        require_settings(self)
        if not (self.budget > 0.0 and self.longest > 0.0):
            raise ArgumentError(
                "budget and longest", "> 0", shown=f"{self.budget:g} and {self.longest:g}"
            )

    @abc.abstractmethod
    def motion_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> HostMotion | None:
        """Return a motion to one end pose that touches nothing, or None if time runs out."""

    def solve_on_host(self, cases: BlockCase, attempt: Attempt) -> BlockPlan:
        """Return the plans of a batch, one case after another."""
        plans = [self.plan_of(take(cases, k)) for k in range(cases.batch_shape[0])]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *plans)

    def plan_of(self, case: BlockCase) -> BlockPlan:
        """Return the plan of one case with NumPy leaves."""
        hopeless, angles, contacts, shares = (np.asarray(x) for x in _goals(case, self.points))
        if hopeless != Status.NO_PATH:
            return self._plan(case, Status(int(hopeless)))
        order = np.argsort(shares)[: np.isfinite(shares).sum()]
        if np.any(case.rates != 0.0) or not order.size:
            return self._plan(case, Status.INFEASIBLE)
        free = FreeSpace(case, self.margin)
        until = time.perf_counter() + self.budget
        is_free = free.is_free(np.concatenate([case.angles[None], angles[order]]))
        if not (is_free[0] and is_free[1:].any()):
            return self._plan(case, Status.BLOCKED)
        best, least, contact, tries = None, np.inf, case.delay, 0
        enough = 0.0 if self.patient else np.inf
        places = order[is_free[1:]]
        while (begin := time.perf_counter()) < until and (best is None or least > enough):
            again, turn = divmod(tries, len(places))
            place, tries = places[turn], tries + 1
            end = min(until, begin + self.longest * 2.0 ** min(again, 30))
            goal = Goal(angles[place], float(contacts[place] - case.delay))
            found = self.motion_to(case, free, goal, lambda end=end: end - time.perf_counter())
            late = np.inf if found is None else found.execution / goal.available - 1.0
            if late < least:
                best, least, contact = found, late, contacts[place]
        return self._plan(case, Status.NO_PATH, best, contact, tries)

    def _plan(
        self,
        case: BlockCase,
        status: Status,
        motion: HostMotion | None = None,
        contact: ArrayLike = 0.0,
        tries: int = 0,
    ) -> BlockPlan:
        """Return the plan of a motion to a contact [s]; without a motion, a plan to stay."""
        dtype = np.asarray(case.angles).dtype
        if motion is None:
            stay = np.zeros((1, self.degree + 1, 6))
            stay[0, 0] = case.angles
            coeffs, durations = stay, np.ones(1)
            contact, cost, violation = case.delay + 1.0, np.inf, np.inf
        else:
            coeffs, durations, cost = motion.coeffs, motion.durations, motion.execution
            violation = cost / (np.asarray(contact) - case.delay) - 1.0
            status = Status.FEASIBLE if violation <= 0.0 else Status.INFEASIBLE
        rest = np.zeros((self.pieces - len(durations), self.degree + 1, 6))
        rest[:, 0] = sum(coeffs[-1, k] * durations[-1] ** k for k in range(self.degree + 1))
        return BlockPlan(
            motion=PiecewisePolynomial(
                coeffs=host_leaf(np.concatenate([coeffs, rest]), dtype),
                durations=host_leaf(np.append(durations, np.zeros(len(rest))), dtype),
            ),
            contact_time=host_leaf(contact, dtype),
            cost=host_leaf(cost, dtype),
            violation=host_leaf(violation, dtype),
            iterations=host_leaf(tries, np.int32),
            status=host_leaf(status, np.int32),
        )


@functools.partial(jax.jit, static_argnames="points")
def _goals(case: BlockCase, points: int) -> tuple[Array, Array, Array, Array]:
    """Return why there can be no plan, and end poses.

    Returns:
        status: () int32, NO_PATH unless the case itself says that there is none.
        angles: (C, 6) [rad].
        contact: (C,) [s].
        share: (C,) of the time there is that a bang-bang motion takes; infinite if it is too late.
    """
    poses, times = poses_in_time(case, points)
    share = times / jnp.maximum(poses.time - case.delay, 1e-6)
    status = explain_status(case, poses, jnp.asarray(Status.NO_PATH))
    return status, poses.angles, poses.time, share


@dataclasses.dataclass(frozen=True)
class WayThenTime(PoseByPose):
    """A planner that finds a way of the joints, which is timed by TOPP-RA then.

    Raises `MissingExtra` unless its packages are installed.
    """

    pieces: ClassVar[int] = PIECES
    degree: ClassVar[int] = DEGREE
    packages: ClassVar[tuple[str, ...]] = ("toppra",)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.packages:
            required(name)

    @abc.abstractmethod
    def way_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> np.ndarray | None:
        """Return points (N, 6) [rad] of a free way from the case's angles to a goal, or None."""

    def motion_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> HostMotion | None:
        """Return the way with its timing; none at all where the arm is at the goal already.

        The spline through a way's points may leave the way: where it then touches something,
        points are put half-way between the others, so that it follows the way more closely.
        """
        points = self.way_to(case, free, goal, left)
        if points is not None:
            apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6
            points = points[np.append(apart, True)]
            if len(points) == 1:
                stay = points[:, None] * (np.arange(DEGREE + 1) == 0)[:, None]
                return HostMotion(stay, np.zeros(1), 0.0)
        limits = (np.asarray(x, float) for x in (case.limits.velocity, case.limits.acceleration))
        velocity, acceleration = limits
        while points is not None and 2 * len(points) <= PIECES:
            motion = timed_way(points, velocity, acceleration)
            if motion is not None and free.is_motion_free(*motion):
                coeffs, durations = motion
                return HostMotion(coeffs, durations, float(durations.sum()))
            between = 0.5 * (points[1:] + points[:-1])
            points = np.insert(points, np.arange(1, len(points)), between, axis=0)
        return None
