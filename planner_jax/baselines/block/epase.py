"""The baseline `epase` of [Natarajan2024]: weighted A* over joint steps, timed by TOPP-RA.

A state of the search is a vector of joint angles. As in the code that the paper's authors
published, a neighbour of a state differs from it in one joint: by +-7 degrees in one of joints 1 to
4, or by +-4 degrees in any joint. A straight edge to the goal, an end pose, is tried first. States
in a grid cell of 0.05 rad count as one state. The heuristic is the distance to the goal in joint
space, and the cost is the length of the path from the start.

The paper uses ePA*SE [Mukherjee2022], which evaluates edges in parallel on 64 cores. With a single
thread, ePA*SE is weighted A*. Here one thread evaluates all edges of a state as one batch. The
authors' code stops within 0.1 rad of the goal; here a path ends at the goal.
"""

import dataclasses
import functools
import heapq
import itertools

import numpy as np

from planner_jax.baselines.block.free_space import FreeSpace
from planner_jax.baselines.block.pose_by_pose import Clock, Goal, PathThenTime
from planner_jax.task.block.case import BlockCase

CELL = 0.05  # [rad], edge length of the grid cells in which two states count as one


@functools.cache
def list_steps(joints: int) -> np.ndarray:
    """Return the steps (S, n) [rad] of a search: of 7 degrees, but for two joints, and of 4."""
    parts = ((joints - 2, 7.0), (joints, 4.0))
    each = [np.deg2rad(size) * np.eye(joints)[:num] for num, size in parts]
    return np.concatenate([sign * step for step in each for sign in (1, -1)])


@dataclasses.dataclass
class State:
    """Joint angles that the search has reached, with the path that leads to them."""

    angles: np.ndarray  # (6,) [rad], joint angles
    length: float  # [rad], length of the path from the start in joint space
    parent: "State | None" = None
    spline: np.ndarray | None = None  # (S, 6) [rad], samples of a spline from the start, or None

    def path(self) -> list["State"]:
        """Return all states on the path, from this state back to the start."""
        return [self, *(self.parent.path() if self.parent else ())]


class OpenStates:
    """Unexpanded states of weighted A*, by path length + weight * distance to the goal [rad]."""

    def __init__(self, start: State, goal: np.ndarray, weight: float) -> None:
        self._goal, self._weight = goal, weight
        self._number = itertools.count()  # orders states of equal cost by insertion
        self._states = [(0.0, next(self._number), start)]
        self._lengths, self._closed = {_cell_of(start.angles): 0.0}, set()

    def pop(self) -> State | None:
        """Remove and return the first state of the order whose grid cell has no expanded state."""
        while self._states:
            state = heapq.heappop(self._states)[2]
            if (cell := _cell_of(state.angles)) not in self._closed:
                self._closed.add(cell)
                return state
        return None

    def steps_from(self, state: State) -> list[State]:
        """Return neighbours in unexpanded grid cells to which no shorter path is known."""
        neighbours = state.angles + list_steps(state.angles.size)
        lengths = state.length + np.linalg.norm(neighbours - state.angles, axis=1)
        return [
            State(angles, length, state)
            for angles, length in zip(neighbours, lengths, strict=True)
            if (cell := _cell_of(angles)) not in self._closed
            and length < self._lengths.get(cell, np.inf)
        ]

    def push(self, state: State) -> None:
        """Add an unexpanded state, and store its path length as the least for its grid cell."""
        self._lengths[_cell_of(state.angles)] = state.length
        ahead = float(np.linalg.norm(state.angles - self._goal))
        entry = state.length + self._weight * ahead, next(self._number), state
        heapq.heappush(self._states, entry)


def _cell_of(angles: np.ndarray) -> tuple[int, ...]:
    return tuple(np.round(angles / CELL).astype(int).tolist())


@dataclasses.dataclass(frozen=True)
class EpaseBlock(PathThenTime):
    """The planner `epase`: weighted A* to poses that meet the ball; needs pip extra `arm-peers`."""

    # [s], longest search for one end pose. Few searches that take longer succeed.
    longest: float = 0.05
    weight: float = 10.0  # factor on the heuristic (distance to the goal) in weighted A*

    def path_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> np.ndarray | None:
        """Return joint angles (N, 6) [rad] along a collision-free path to the goal, or None.

        `free` checks collisions, and `left` returns the remaining search time [s].
        """
        end = np.asarray(goal.angles, float)
        states = OpenStates(State(np.asarray(case.angles, float), 0.0), end, self.weight)
        while left() > 0.0 and (state := states.pop()) is not None:
            neighbours = states.steps_from(state)
            ends = np.stack([end, *(new.angles for new in neighbours)])
            is_goal_free, *are_free = free.are_edges_free(state.angles, ends)
            if is_goal_free:
                return np.stack([*(each.angles for each in state.path()[::-1]), end])
            for new, is_free in zip(neighbours, are_free, strict=True):
                if is_free:
                    states.push(new)
        return None
