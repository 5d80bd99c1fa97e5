"""Planners on the host that try one end pose after another [Natarajan2024, Section IV-C].

In the paper the end poses hold the shield at equidistant points of a tunnel, the space through
which a ball may come. Here they hold it at points of the ball's own trajectory, with the eight
solutions of inverse kinematics at each point. Poses that collide, or that no motion reaches in
time, are left out. Poses are tried in the order of (duration of a bang-bang motion) / (time until
the ball arrives). If the planner is `patient`, the search continues after a motion that arrives too
late.
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
from planner_jax.baselines.block.path_timing import DEGREE, PIECES, import_extra, time_path
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.choices import require
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import BaseAttempt, Status, require_settings, take
from planner_jax.robot.arm_dynamics import measure_torques
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan, explain_status, mark_blocked
from planner_jax.trajectory.polynomial import PiecewisePolynomial

_TORQUES = 96  # number of times, besides the ends of pieces, at which torques are computed
Clock = Callable[[], float]  # returns the remaining search time [s]


@dataclasses.dataclass(frozen=True)
class Goal:
    """An end pose of the arm to which a motion is planned."""

    angles: np.ndarray  # (6,) [rad], joint angles of the end pose
    available: float  # [s], time from the start of the motion until the ball reaches the shield


@dataclasses.dataclass(frozen=True)
class HostMotion:
    """A joint motion of M polynomial pieces; time 0 is when the arm may start to move."""

    coeffs: np.ndarray  # (M, D + 1, n), of degree D for n joints [rad], lowest power first
    durations: np.ndarray  # (M,) [s], durations of the pieces
    execution: float  # [s], duration of the motion without an initial wait


@dataclasses.dataclass(frozen=True)
class PoseByPose(Planner, abc.ABC):
    """Base class of planners that try end poses; a plan's cost is its motion's duration [s].

    A plan's `violation` is (duration / time until the ball arrives) - 1, or infinite if no motion
    was found. The plan's `iterations` is the number of tried poses. If the arm moves at the start
    of a case, no motion is found.
    """

    case_type: ClassVar[type] = BlockCase
    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    pieces: ClassVar[int]
    degree: ClassVar[int]
    points: int = 12  # number of points of the ball's trajectory, each with eight end poses
    budget: float = 2.0  # [s], search time of each case [Natarajan2024]
    # [s], search time of one pose in the first pass over all poses; each next pass doubles it.
    longest: float = 0.25
    patient: bool = True  # whether the search continues after a motion that arrives too late
    margin: float = 0.003  # [m], least distance from obstacles and from the arm itself

    def __post_init__(self) -> None:
        require_settings(self)
        shown = f"{self.budget:g} and {self.longest:g}"
        require(min(self.budget, self.longest) > 0.0, "budget and longest", "> 0", shown=shown)

    @abc.abstractmethod
    def motion_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> HostMotion | None:
        """Return a collision-free motion to one end pose, or None if the search time ends.

        `free` checks collisions, and `left` returns the remaining search time [s].
        """

    def solve_on_host(self, cases: BlockCase, attempt: BaseAttempt) -> BlockPlan:
        """Return the plans of a batch, one case after another."""
        plans = [self.plan_of(take(cases, k)) for k in range(cases.batch_shape[0])]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *plans)

    def plan_of(self, case: BlockCase) -> BlockPlan:
        """Return one case's plan: the first motion that is in time, else the least late motion."""
        hopeless, angles, contacts, shares = (np.asarray(x) for x in _list_goals(case, self.points))
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
        indices = order[is_free[1:]]
        while (begin := time.perf_counter()) < until and (best is None or least > enough):
            again, turn = divmod(tries, len(indices))
            index, tries = indices[turn], tries + 1
            end = min(until, begin + self.longest * 2.0 ** min(again, 30))
            goal = Goal(angles[index], float(contacts[index] - case.delay))
            found = self.motion_to(case, free, goal, lambda end=end: end - time.perf_counter())
            late = np.inf if found is None else found.execution / goal.available - 1.0
            if late < least:
                best, least, contact = found, late, contacts[index]
        return self._plan(case, Status.NO_PATH, best, contact, tries)

    def _plan(
        self,
        case: BlockCase,
        status: Status,
        motion: HostMotion | None = None,
        contact: ArrayLike = 0.0,
        tries: int = 0,
    ) -> BlockPlan:
        """Return the plan of a motion, None for standstill, with the contact time `contact` [s]."""
        dtype = np.asarray(case.angles).dtype
        if motion is None:
            stay = np.zeros((1, self.degree + 1, case.arm.num))
            stay[0, 0] = case.angles
            coeffs, durations = stay, np.ones(1)
            contact, cost, violation = case.delay + 1.0, np.inf, np.inf
        else:
            coeffs, durations, cost = motion.coeffs, motion.durations, motion.execution
            violation = cost / (np.asarray(contact) - case.delay) - 1.0
            if case.limits.torque is not None:
                path = PiecewisePolynomial(jnp.asarray(coeffs), jnp.asarray(durations))
                of_case = case.arm, case.limits, case.gravity
                violation = max(violation, float(measure_torques(*of_case, path, _TORQUES)[0]))
            status = Status.FEASIBLE if violation <= 0.0 else Status.INFEASIBLE
        rest = np.zeros((self.pieces - len(durations), self.degree + 1, case.arm.num))
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
def _list_goals(case: BlockCase, points: int) -> tuple[Array, Array, Array, Array]:
    """Return C end poses of a case, eight for each point of the ball's trajectory.

    Returns:
        status: () int32, NO_PATH (the status until a path is found), or why no plan can exist.
        angles: (C, 6) [rad], joint angles of the end poses.
        contact: (C,) [s], when the ball arrives at each pose.
        share: (C,), (duration of a bang-bang motion) / (time until the ball arrives); infinite if
            the arm arrives after the ball.
    """
    poses, times = poses_in_time(case, points)
    share = times / jnp.maximum(poses.time - case.delay, 1e-6)
    status = explain_status(poses, mark_blocked(case, jnp.asarray(Status.NO_PATH)))
    return status, poses.angles, poses.time, share


@dataclasses.dataclass(frozen=True)
class PathThenTime(PoseByPose):
    """A planner that searches a path of the joints, then the quickest motion along it by TOPP-RA.

    The constructor raises `MissingExtra` unless the packages that the planner needs are installed.
    """

    pieces: ClassVar[int] = PIECES
    degree: ClassVar[int] = DEGREE
    packages: ClassVar[tuple[str, ...]] = ("toppra",)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.packages:
            import_extra(name)

    @abc.abstractmethod
    def path_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> np.ndarray | None:
        """Return joint angles (N, 6) [rad] along a collision-free path to the goal, or None.

        `free` checks collisions, and `left` returns the remaining search time [s].
        """

    def motion_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> HostMotion | None:
        """Return the quickest motion along a path to the goal, or None if none is found.

        The motion lasts 0 s if the arm already is at the goal. The spline through the path's points
        deviates from the path and may collide. Then midpoints are inserted between the points, so
        that the spline follows the path more closely.
        """
        points = self.path_to(case, free, goal, left)
        if points is not None:
            apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6
            points = points[np.append(apart, True)]
            if len(points) == 1:
                stay = points[:, None] * (np.arange(DEGREE + 1) == 0)[:, None]
                return HostMotion(stay, np.zeros(1), 0.0)
        limits = (np.asarray(x, float) for x in (case.limits.velocity, case.limits.acceleration))
        velocity, acceleration = limits
        while points is not None and 2 * len(points) <= PIECES:
            motion = time_path(points, velocity, acceleration)
            if motion is not None and free.is_motion_free(*motion):
                coeffs, durations = motion
                return HostMotion(coeffs, durations, float(durations.sum()))
            between = 0.5 * (points[1:] + points[:-1])
            points = np.insert(points, np.arange(1, len(points)), between, axis=0)
        return None
