"""The baseline `epase` of [Natarajan2024]: weighted A* over joint steps, timed by TOPP-RA.

The steps follow the code behind the paper: 7 degrees of joints 1 to 4 and 4 degrees of each joint,
in both directions, and a straight edge to the goal, which is tried first. States within a cell of
0.05 rad count as one state. The heuristic is the distance to the goal in joint space, and the cost
is the length of the path from the start.

ePA*SE [Mukherjee2022] evaluates edges in parallel, on 64 cores in the paper. Without its threads it
is this search. Here all edges of a state are evaluated in one batch, by one thread. The paper's
code stops within 0.1 rad of the goal; here a path ends at the goal.
"""

import dataclasses
import heapq
import itertools

import numpy as np

from planner_jax.baselines.block.free_space import FreeSpace
from planner_jax.baselines.block.pose_by_pose import Clock, Goal, PathThenTime
from planner_jax.task.block.case import BlockCase

CELL = 0.05  # [rad]
STEPS = np.concatenate(
    [
        sign * np.deg2rad(size) * np.eye(6)[:num]
        for num, size in ((4, 7.0), (6, 4.0))
        for sign in (1, -1)
    ]
)


@dataclasses.dataclass
class State:
    """A state that a search has reached."""

    angles: np.ndarray  # (6,) [rad]
    length: float  # [rad], of the path from the start
    parent: "State | None" = None
    spline: np.ndarray | None = None  # (S, 6) [rad], samples from the start, if it has a spline

    def path(self) -> list["State"]:
        """Return the states from this one back to the start."""
        return [self, *(self.parent.path() if self.parent else ())]


class OpenStates:
    """The states that a search has not expanded, sorted by length + weight * distance to goal."""

    def __init__(self, start: State, goal: np.ndarray, weight: float) -> None:
        self._goal, self._weight = goal, weight
        self._number = itertools.count()  # orders states of equal cost by insertion
        self._states = [(0.0, next(self._number), start)]
        self._lengths, self._closed = {_cell_of(start.angles): 0.0}, set()

    def pop(self) -> State | None:
        """Remove the most promising state of an open cell, close its cell, and return the state."""
        while self._states:
            state = heapq.heappop(self._states)[2]
            if (cell := _cell_of(state.angles)) not in self._closed:
                self._closed.add(cell)
                return state
        return None

    def steps_from(self, state: State) -> list[State]:
        """Return the states one step away in open cells, if no shorter path leads there."""
        neighbours = state.angles + STEPS
        lengths = state.length + np.linalg.norm(neighbours - state.angles, axis=1)
        return [
            State(angles, length, state)
            for angles, length in zip(neighbours, lengths, strict=True)
            if (cell := _cell_of(angles)) not in self._closed
            and length < self._lengths.get(cell, np.inf)
        ]

    def push(self, state: State) -> None:
        """Add a state."""
        self._lengths[_cell_of(state.angles)] = state.length
        ahead = float(np.linalg.norm(state.angles - self._goal))
        entry = state.length + self._weight * ahead, next(self._number), state
        heapq.heappush(self._states, entry)


def _cell_of(angles: np.ndarray) -> tuple[int, ...]:
    """Return the grid cell of angles (6,) as six indices."""
    return tuple(np.round(angles / CELL).astype(int).tolist())


@dataclasses.dataclass(frozen=True)
class EpaseBlock(PathThenTime):
    """A planner that tries end poses one after another; it needs the extra `arm-peers`."""

    longest: float = 0.05  # [s] per pose; few longer searches succeed
    weight: float = 10.0  # weight of the heuristic

    def path_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> np.ndarray | None:
        """Return points (N, 6) [rad] of a collision-free path, or None."""
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
