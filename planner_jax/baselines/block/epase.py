"""The baseline `epase` of paper 004: a weighted A* over steps of the joints, timed by TOPP-RA.

The steps are those of the code behind the paper: 7 degrees of joints 1 to 4 and 4 degrees of each
joint, either way, and straight to the goal, which is tried first. States within a cell of 0.05 rad
are taken for one. The heuristic is the distance to the goal in the space of the joints, the cost
the length of the way there.

ePA*SE (Mukherjee, Aine and Likhachev 2022) looks at edges in parallel, on 64 cores in the paper;
without its threads it is this search. Here all edges of a state are looked at in one batch, by one
thread. Where the paper's code stops within 0.1 rad of the goal, a way here ends at the goal.
"""

import dataclasses
import heapq
import itertools

import numpy as np

from planner_jax.baselines.block.free_space import FreeSpace
from planner_jax.baselines.block.pose_by_pose import Clock, Goal, WayThenTime
from planner_jax.task.block.case import BlockCase

CELL = 0.05  # [rad]
STEPS = np.concatenate(
    [
        sign * np.deg2rad(size) * np.eye(6)[:num]
        for num, size in ((4, 7.0), (6, 4.0))
        for sign in (1, -1)
    ]
)


@dataclasses.dataclass(frozen=True)
class Node:
    """A state that the search has come to."""

    angles: np.ndarray  # (6,) [rad]
    cost: float  # [rad], of the way there
    parent: "Node | None"

    def way(self) -> np.ndarray:
        """States (N, 6) from the start to here."""
        states, node = [], self
        while node is not None:
            states.append(node.angles)
            node = node.parent
        return np.stack(states[::-1])


def cell_of(angles: np.ndarray) -> tuple[int, ...]:
    """The cell of a state (6,)."""
    return tuple(np.round(angles / CELL).astype(int).tolist())


@dataclasses.dataclass(frozen=True)
class EpaseBlock(WayThenTime):
    """Tries end poses one after another; needs the extra `arm-peers`."""

    longest: float = 0.05  # [s]; past this few searches end, while other poses are easy
    weight: float = 10.0  # of the heuristic

    def way_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> np.ndarray | None:
        """Points of a way, or None."""
        end = np.asarray(goal.angles, float)
        start = Node(np.asarray(case.angles, float), 0.0, None)
        costs, closed = {cell_of(start.angles): 0.0}, set()
        number = itertools.count()  # equal states are taken in turn
        open_states = [(0.0, next(number), start)]
        while open_states and left() > 0.0:
            node = heapq.heappop(open_states)[2]
            cell = cell_of(node.angles)
            if cell in closed:
                continue
            closed.add(cell)
            there = np.concatenate([end[None], node.angles + STEPS])
            ahead = np.linalg.norm(there - end, axis=1)
            cost = node.cost + np.linalg.norm(there - node.angles, axis=1)
            cells = [cell_of(each) for each in there]
            news = [
                k
                for k in range(1, len(there))
                if cells[k] not in closed and cost[k] < costs.get(cells[k], np.inf)
            ]
            chosen = np.array([0, *news])
            is_free = free.are_edges_free(node.angles, there[chosen])
            if is_free[0]:
                return Node(end, cost[0], node).way()
            for k in chosen[is_free]:
                costs[cells[k]] = cost[k]
                child = Node(there[k], cost[k], node)
                entry = cost[k] + self.weight * ahead[k], next(number), child
                heapq.heappush(open_states, entry)
        return None
