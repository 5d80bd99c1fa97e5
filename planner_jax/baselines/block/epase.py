"""The baseline `epase` of [Natarajan2024]: weighted A* over joint steps, timed by TOPP-RA.

A state of the search is a vector of joint angles. As in the code that the paper's authors
published, a neighbour of a state differs from it in one joint: by +-7 degrees in one of joints 1 to
4, or by +-4 degrees in any joint. A straight edge to the goal, an end pose, is tried first. States
in a grid cell of 0.05 rad count as one state. The heuristic is the distance to the goal in joint
space, and the cost is the length of the path from the start.

ePA*SE [Mukherjee2022] evaluates edges of several states in parallel, on 64 cores in the paper. Here
one batch has the edges of up to `width` states that are independent of every state before them in
the order: with path lengths g, straight distances h and the weight w, state s is independent of s'
if g(s) - g(s') <= w h(s', s). A path through s' can then shorten the path to s too little to break
the bound that a path is at most w times as long as the shortest. With a width of 1 this is weighted
A*. The authors' code stops within 0.1 rad of the goal; here a path ends at the goal.
"""

import dataclasses
import functools
import heapq
import itertools
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from planner_jax.baselines.block.free_space import FreeSpace
from planner_jax.baselines.block.pose_by_pose import Clock, Goal, PathThenTime
from planner_jax.task.block.case import BlockCase

_Found = TypeVar("_Found")
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


def is_independent(state: State, before: list[State], weight: float) -> bool:
    """Return whether g(s) - g(s') <= w h(s', s) for `state` s and all states s' in `before`."""
    if not before:
        return True
    lengths = np.array([each.length for each in before])
    apart = np.linalg.norm(np.stack([each.angles for each in before]) - state.angles, axis=1)
    return bool(np.all(state.length - lengths <= weight * apart))


class OpenStates:
    """Unexpanded states of weighted A*, by path length + weight * distance to the goal [rad]."""

    def __init__(self, start: State, goal: np.ndarray, weight: float) -> None:
        self.goal = goal
        self.bound = 0.0  # [rad], at most `weight` times the length of the shortest path
        self._weight = weight
        self._number = itertools.count()  # orders states of equal cost by insertion
        self._states, self._lengths, self._closed = [], {}, set()
        self.push(start)

    @property
    def num_expanded(self) -> int:
        """The number of states that were removed to be expanded."""
        return len(self._closed)

    def pop(self, width: int = 1) -> list[State]:
        """Remove and return up to `width` states, the first ones that are independent.

        A returned state is independent of all states before it in the order, and its grid cell has
        no expanded state. The list is empty if no state is left.
        """
        some, before, skipped = [], [], []
        while self._states and len(some) < width:
            entry = heapq.heappop(self._states)
            cost, _, state = entry
            if (cell := _cell_of(state.angles)) in self._closed:
                continue
            if not before:
                self.bound = max(self.bound, cost)
            if is_independent(state, before, self._weight):
                self._closed.add(cell)
                some.append(state)
            else:
                skipped.append(entry)
            before.append(state)
        for entry in skipped:
            heapq.heappush(self._states, entry)
        return some

    def steps_from(self, states: list[State]) -> list[State]:
        """Return neighbours in unexpanded grid cells to which no shorter path is known."""
        found = []
        for state in states:
            neighbours = state.angles + list_steps(state.angles.size)
            lengths = state.length + np.linalg.norm(neighbours - state.angles, axis=1)
            found += map(State, neighbours, lengths, itertools.repeat(state))
        return [new for new in found if self._is_shorter(new)]

    def push(self, state: State) -> None:
        """Add a state unless its grid cell has an expanded state or one with a shorter path."""
        if self._is_shorter(state):
            self._lengths[_cell_of(state.angles)] = state.length
            ahead = float(np.linalg.norm(state.angles - self.goal))
            entry = state.length + self._weight * ahead, next(self._number), state
            heapq.heappush(self._states, entry)

    def _is_shorter(self, state: State) -> bool:
        cell = _cell_of(state.angles)
        return cell not in self._closed and state.length < self._lengths.get(cell, np.inf)


def are_edges_free(free: FreeSpace, states: list[State]) -> np.ndarray:
    """Return which of N states have a free straight joint motion from their parents, (N,) bool."""
    if not states:
        return np.zeros(0, bool)
    begins, ends = ([each.angles for each in some] for some in (_parents(states), states))
    return free.are_edges_free(np.stack(begins), np.stack(ends))


def _parents(states: list[State]) -> list[State]:
    return [state.parent for state in states if state.parent]


def search(
    states: OpenStates,
    width: int,
    left: Clock,
    expand: Callable[[list[State]], tuple[float, _Found | None]],
) -> _Found | None:
    """Expand states in batches of up to `width` until a result's cost is within the bound.

    Args:
        states: open states, at first the start alone.
        width: greatest number of states in a batch.
        left: returns the remaining search time [s].
        expand: adds the neighbours of states, and returns the cost [rad] of a result and the
            result; infinity and None if there is none. A cost of 0 ends the search.

    Returns:
        The result of least cost, or None.
    """
    least, best = np.inf, None
    while left() > 0.0 and (some := states.pop(width)):
        cost, found = expand(some)
        if cost < least:
            least, best = cost, found
        if least <= states.bound:
            break
    return best


def _cell_of(angles: np.ndarray) -> tuple[int, ...]:
    return tuple(np.round(angles / CELL).astype(int).tolist())


@dataclasses.dataclass(frozen=True)
class EpaseBlock(PathThenTime):
    """The planner `epase`: weighted A* to poses that meet the ball; needs pip extra `arm-peers`."""

    # [s], longest search for one end pose. Few searches that take longer succeed.
    longest: float = 0.05
    weight: float = 10.0  # factor on the heuristic (distance to the goal) in weighted A*
    width: int = 64  # greatest number of states that are expanded at once

    def path_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> np.ndarray | None:
        """Return joint angles (N, 6) [rad] along a collision-free path to the goal, or None.

        `free` checks collisions, and `left` returns the remaining search time [s].
        """
        start = State(np.asarray(case.angles, float), 0.0)
        return find_path(start, np.asarray(goal.angles, float), free, left, self.weight, self.width)


def find_path(
    start: State, end: np.ndarray, free: FreeSpace, left: Clock, weight: float, width: int
) -> np.ndarray | None:
    """Return angles (N, n) [rad] of a path by ePA*SE from `start` to `end` (n,) [rad], or None.

    The path is at most `weight` times as long as the shortest path over states of the search.
    `free` checks collisions, `left` returns the remaining search time [s], and `width` is the
    greatest number of states that are expanded at once.
    """
    states = OpenStates(start, end, weight)

    def expand(some: list[State]) -> tuple[float, State | None]:
        goals = [
            State(end, each.length + float(np.linalg.norm(end - each.angles)), each)
            for each in some
        ]
        edges = goals + states.steps_from(some)
        free_ones = are_edges_free(free, edges)
        for new, is_free in zip(edges[len(some) :], free_ones[len(some) :], strict=True):
            if is_free:
                states.push(new)
        reached = [new for new, is_free in zip(goals, free_ones, strict=False) if is_free]
        best = min(reached, key=lambda new: new.length, default=None)
        return (best.length, best) if best else (np.inf, None)

    found = search(states, width, left, expand)
    return found and np.stack([each.angles for each in found.path()[::-1]])
