"""The baseline `rrt-connect` of [Natarajan2024]: a path by RRT-Connect, timed by TOPP-RA.

RRT-Connect [Kuffner2000], of the library OMPL, grows two trees of joint poses, from start and goal.
An edge is at most 1 rad long, as in the code that the paper's authors published. The search uses
one thread.
"""

import dataclasses
import functools
from collections.abc import Sequence
from types import ModuleType
from typing import ClassVar

import numpy as np

from planner_jax.baselines.block.free_space import FreeSpace
from planner_jax.baselines.block.path_timing import import_extra
from planner_jax.baselines.block.pose_by_pose import Clock, Goal, PathThenTime
from planner_jax.task.block.case import BlockCase

_SEED = 1  # seed of OMPL's random generator, set once per process


@functools.cache
def _ompl() -> tuple[ModuleType, ModuleType]:
    util = import_extra("ompl.util")
    util.setLogLevel(util.LOG_ERROR)
    util.RNG.setSeed(_SEED)
    return import_extra("ompl.base"), import_extra("ompl.geometric")


@dataclasses.dataclass(frozen=True)
class RrtConnectBlock(PathThenTime):
    """The planner `rrt-connect`: paths to poses that meet the ball; needs the extra `arm-peers`."""

    packages: ClassVar[tuple[str, ...]] = ("toppra", "ompl")
    reach: float = 1.0  # [rad], greatest length of a tree's edge in joint space
    shortcuts: bool = True  # whether a path is shortened before it is timed

    def path_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> np.ndarray | None:
        """Return joint angles (N, 6) [rad] along a collision-free path to the goal, or None.

        `free` checks collisions, and `left` returns the remaining search time [s].
        """
        base, geometric = _ompl()
        space = base.RealVectorStateSpace(case.arm.num)
        bounds = base.RealVectorBounds(case.arm.num)
        for k in range(case.arm.num):
            bounds.setLow(k, float(free.lower[k]))
            bounds.setHigh(k, float(free.upper[k]))
        space.setBounds(bounds)
        information = base.SpaceInformation(space)
        numbers = functools.partial(_numbers, case.arm.num)
        information.setStateValidityChecker(lambda state: bool(free.is_free(numbers(state)[None])))
        information.setMotionValidator(_validator(base, information, free))
        information.setup()
        ends = []
        for angles in (case.angles, goal.angles):
            state = space.allocState()
            for k in range(case.arm.num):
                state[k] = float(angles[k])
            ends.append(state)
        problem = base.ProblemDefinition(information)
        problem.setStartAndGoalStates(*ends)
        planner = geometric.RRTConnect(information)
        planner.setRange(self.reach)
        planner.setProblemDefinition(problem)
        planner.setup()
        if (
            (seconds := left()) <= 0.0
            or not planner.solve(seconds)
            or not problem.hasExactSolution()
        ):
            return None
        path = problem.getSolutionPath()
        if self.shortcuts:
            geometric.PathSimplifier(information).simplify(path, max(left(), 0.0))
        return np.stack([numbers(state) for state in path.getStates()])


def _numbers(num: int, state: Sequence[float]) -> np.ndarray:
    return np.array([state[k] for k in range(num)])


def _validator(base: ModuleType, information: object, free: FreeSpace) -> object:
    """Create the object that OMPL calls to check whether a straight edge is collision-free."""

    class Edges(base.MotionValidator):
        def checkMotion(self, begin: Sequence[float], end: Sequence[float]) -> bool:  # noqa: N802
            first, last = (_numbers(len(free.lower), state) for state in (begin, end))
            return bool(free.are_edges_free(first, last[None])[0])

    return Edges(information)
