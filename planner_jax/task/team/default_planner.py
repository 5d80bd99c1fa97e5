"""The `exact` planner of teams: robots share targets, and keep their distance from each other."""

import dataclasses
import functools
import itertools
import operator
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.ball.prediction import PathTable
from planner_jax.core.errors import NotOffered
from planner_jax.core.origin import without_origin
from planner_jax.core.planner import Drive, Planner
from planner_jax.core.protocol import is_solved
from planner_jax.cost.moving import MovingKeepOut
from planner_jax.recovery.with_recovery import RecoveringPlanner
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.team.case import TeamCase
from planner_jax.task.team.decide import PER_SECOND, SWEEPS, assign
from planner_jax.task.team.meeting import (
    TIMES,
    hover_recovery,
    sample_positions,
    with_stricter_limits,
)
from planner_jax.task.team.plan import TeamPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

if TYPE_CHECKING:
    from planner_jax.task.team.smooth import SmoothTeam

_NODES = 256  # number of nodes of the table of a robot's path
_SPARE = 1.01  # planned least distance between robots, relative to the least distance of the case
_WIDTH = 128  # number of sequences of each length in the joint decision
# Factors on the agility of robots in the joint decision, in the order of trial. Plans nearly always
# fulfil the choices of the first one. Greater factors find more catches, which some plans miss.
_HASTES = (1.3, 1.5, 1.7, 1.6, 1.4, 1.9, 1.8, 1.15, 1.0)


@struct.dataclass
class ExactTeam(Planner[TeamCase, TeamPlan]):
    """A planner of teams: joint decisions on the targets, and plans of every robot for them.

    For each of several joint decisions every robot plans its catches. Then one plan is selected for
    each robot: of all combinations without a common target, in which the robots keep their
    distance, the one that catches most. A robot may also hover. If a combination would catch more
    without the distance, the robots plan again in turn, with the other robots' trajectories as
    moving keep-outs. A robot then may catch all targets that no other robot catches. A new plan
    replaces the old one if it catches more. The distance is therefore kept after every step.

    Attributes:
        planner: planner of the catches and the recovery of one robot.
        turns: number of times that a robot plans in turn.
    """

    case_type: ClassVar[type] = TeamCase

    planner: RecoveringPlanner[CatchCase, CatchPlan]
    turns: int = struct.field(pytree_node=False, default=3)

    @property
    def inner(self) -> Planner:
        """The planner of one robot's catches, behind its decision and its recovery."""
        return self.planner.inner.inner

    def plan_once(self, cases: TeamCase) -> PyTree:
        """Raise `TypeError`, because teams are planned on the host."""
        raise NotOffered("ExactTeam works on the host, so that optimal_plan cannot plan teams")

    def smooth(self) -> "SmoothTeam":
        """Return the problem whose minima are near this planner's plans."""
        from planner_jax.task.team.smooth import SmoothTeam  # only gradients need it

        catcher: PyTree = self.inner
        return SmoothTeam(catcher.problem, self.planner.recovery_planner.problem)

    def plan_by(self, drive: Drive, cases: TeamCase) -> TeamPlan:
        """Return plans of teams, by the loop over searches `drive`."""
        if drive.is_pure:
            raise NotOffered("ExactTeam works on the host: call pj.plan outside compiled functions")
        if cases.batch_shape == ():
            one = self.plan_by(drive, jax.tree.map(lambda leaf: np.asarray(leaf)[None], cases))
            return jax.tree.map(lambda leaf: leaf[0], one)
        origin = cases.shared.origin
        cases = dataclasses.replace(cases, shared=without_origin(cases.shared))
        if cases.num_robots == 1:
            robots = [drive(self.planner, cases.of_robot(0))[0]]
        else:
            cases = jax.tree.map(np.asarray, with_stricter_limits(cases))
            robots, wanting = self._plan_jointly(drive, cases)
            lanes = np.flatnonzero(wanting)
            if lanes.size:
                some = jax.tree.map(lambda leaf: leaf[lanes], (cases, robots))
                _put(robots, self._plan_in_turn(drive, *some), lanes)
        plans: CatchPlan = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *robots)
        return TeamPlan(
            cost=plans.cost.sum(axis=1),
            violation=plans.violation.max(axis=1),
            iterations=plans.iterations.sum(axis=1),
            status=plans.status.max(axis=1),
            robots=dataclasses.replace(plans, origin=origin),
        )

    def _plan_jointly(self, drive: Drive, cases: TeamCase) -> tuple[list[PyTree], np.ndarray]:
        """Return N robots' plans of B cases, and in which cases the distance costs catches."""
        num, batch = cases.num_robots, len(cases.head_states)
        choices = jax.tree.map(np.asarray, assign(cases, _WIDTH, np.array(_HASTES, np.float32)))
        alone = dataclasses.replace(self.planner, planner=self.inner, slower=())
        # Plans of each robot, leaves (B, ...): to hover, then for each joint decision. A robot
        # hovers where it has no plan.
        pool = [[self._hover(drive, cases, k)] * (1 + len(_HASTES)) for k in range(num)]
        pool: list[list[PyTree]] = jax.tree.map(np.array, pool)
        most, within = np.zeros(batch, int), np.zeros((num, num, *[len(pool[0])] * 2, batch), bool)
        for h in range(len(_HASTES)):
            choice = jax.tree.map(lambda leaf: leaf[:, h], choices)  # noqa: B023
            lanes = np.flatnonzero(choice.taken.sum(axis=(1, 2)) > most)
            if drive.is_over or not lanes.size:
                continue
            own = [
                cases.of_robot(k).with_choice(jax.tree.map(lambda leaf: leaf[:, k], choice))  # noqa: B023
                for k in range(num)
            ]
            some = jax.tree.map(lambda *x: np.concatenate([leaf[lanes] for leaf in x]), *own)  # noqa: B023
            found = jax.tree.map(np.asarray, drive(alone, some)[0])
            for k, part in enumerate(np.split(np.arange(num * lanes.size), num)):
                solved = is_solved(found.status[part])
                new = jax.tree.map(lambda leaf: leaf[part[solved]], found)  # noqa: B023
                _put(pool[k][1 + h], new, lanes[solved])
            most = _select(pool, within)[1]
        apart = _SPARE * np.asarray(cases.least_distance)
        chosen, best = _select(pool, _near(pool, apart))
        number = np.arange(batch)
        pick = lambda at: lambda *leaves: np.stack(leaves)[at, number]  # noqa: E731
        return [jax.tree.map(pick(chosen[k]), *pool[k]) for k in range(num)], most > best

    def _hover(self, drive: Drive, cases: TeamCase, k: int) -> PyTree:
        """Return plans (B, ...) in which robot k hovers at its start and catches nothing."""
        idle = cases.of_robot(k, present=np.zeros_like(cases.shared.present))
        plans: PyTree = drive(self.inner, idle)[0]
        pieces = self.planner.recovery_planner.problem.num_pieces
        return plans.replace(recovery=hover_recovery(cases.head_states[:, k, 0], pieces))

    def _plan_in_turn(self, drive: Drive, cases: TeamCase, plans: list[PyTree]) -> list[PyTree]:
        """Return the plans of N robots, leaves (B, ...), after new plans with more catches."""
        present, robots = cases.shared.present, range(cases.num_robots)
        plans, apart = list(plans), _SPARE * cases.least_distance
        paths: list[tuple[PathTable, Array]] = [_tabulate(plan.whole) for plan in plans]
        tried = [np.zeros_like(present) for _ in robots]  # targets that a robot might catch before
        for _, k in itertools.product(range(self.turns), robots):
            taken = [np.asarray(plan.choice.taken) for plan in plans]
            free = present & ~functools.reduce(operator.or_, taken[:k] + taken[k + 1 :])
            # A robot that may catch nothing more plans to hover, which takes little time.
            free &= (free & ~taken[k] & ~tried[k]).any(axis=1, keepdims=True)
            if drive.is_over or not free.any():
                continue
            tried[k] |= free
            others = paths[:k] + paths[k + 1 :]
            near = [MovingKeepOut(path, apart, 0.0 * until, until) for path, until in others]
            own = cases.of_robot(k, present=free, extras=(*cases.shared.extras, *near))
            new, old = drive(self.planner, jax.tree.map(np.asarray, own))[0], plans[k]
            more = is_solved(new.status) & np.asarray(new.num_taken > old.num_taken)
            pick = lambda a, b: np.where(more.reshape(-1, *[1] * (a.ndim - 1)), a, b)  # noqa: B023, E731
            plans[k] = jax.tree.map(pick, new, old)
            paths[k] = _tabulate(plans[k].whole)
        return plans


def _put(old: PyTree, new: PyTree, lanes: np.ndarray) -> None:
    """Replace some cases' plans in a tree of NumPy arrays (B, ...)."""
    for ours, theirs in zip(jax.tree.leaves(old), jax.tree.leaves(new), strict=True):
        ours[lanes] = theirs


def _select(pool: list[list[PyTree]], near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the best combination of plans, (N, B) int, and its number of catches, (B,).

    `pool` has K plans of each of N robots for B cases. Plans p and q of the robots i and j are not
    combined if they have a common target, or `near[i, j, p, q]` (B,) is true.
    """
    taken = np.array([[np.asarray(plan.choice.taken) for plan in plans] for plans in pool])
    count, (num, size, batch) = taken.sum(axis=3), taken.shape[:3]
    ends = np.array([[np.asarray(plan.times)[:, -1] for plan in plans] for plans in pool])
    value = count - PER_SECOND * ends
    chosen, lanes, robots = np.zeros((num, batch), int), np.arange(batch), np.arange(num)
    pairs = list(itertools.combinations(range(num), 2))
    for i, j in pairs * (SWEEPS if num > 2 else 1):
        own = []
        for k in (i, j):
            clash = np.zeros((size, batch), bool)
            for other in set(range(num)) - {i, j}:
                mate = chosen[other]
                clash |= (taken[k] & taken[other, mate, lanes]).any(axis=2)
                clash |= near[k, other][:, mate, lanes]
            own.append(np.where(clash, -np.inf, value[k]))
        clash = (taken[i][:, None] & taken[j][None]).any(axis=3) | near[i, j]
        total = np.where(clash, -np.inf, own[0][:, None] + own[1][None])
        best = total.reshape(size * size, batch).argmax(axis=0)
        chosen[i], chosen[j] = np.divmod(best, size)
    return chosen, count[robots[:, None], chosen, lanes].sum(axis=0)


def _near(pool: list[list[PyTree]], apart: np.ndarray) -> np.ndarray:
    """Return which plans come nearer to each other than `apart` (B,) [m], (N, N, K, K, B) bool."""
    paths = [jax.tree.map(lambda *x: np.stack(x), *[plan.whole for plan in row]) for row in pool]
    whole = jax.tree.map(lambda *leaves: np.stack(leaves), *paths)
    ends = whole.durations.sum(axis=3)
    times = np.linspace(0.0, ends.max(axis=(0, 1)), TIMES, axis=1, dtype=ends.dtype)
    pos = np.asarray(sample_positions(whole, times))
    near = np.zeros((len(pool), len(pool), *ends.shape[1:2] * 2, len(apart)), bool)
    for (i, p), (j, q) in itertools.combinations(np.ndindex(ends.shape[:2]), 2):
        if i != j:
            squared = ((pos[i, p] - pos[j, q]) ** 2).sum(axis=2).min(axis=1)
            near[i, j, p, q] = near[j, i, q, p] = squared < apart**2
    return near


@jax.jit
def _tabulate(whole: PiecewisePolynomial) -> tuple[PathTable, Array]:
    """Return tables of B robots' paths, and the times (B,) [s] from which the robots stand."""
    ends = jnp.sum(whole.durations, axis=1)

    def at(path: PiecewisePolynomial, end: Array, index: Array) -> tuple[Array, Array]:
        time = jnp.minimum(index * end / (_NODES - 3), end)
        moves = jnp.where(index < _NODES - 3.5, 1.0, 0.0)  # standstill exactly from the end on
        return evaluate(path, time), moves * evaluate(path, time, 1)

    nodes = jnp.arange(-1.0, _NODES - 1.0, dtype=ends.dtype)
    pos, vel = jax.vmap(jax.vmap(at, (None, None, 0)), (0, 0, None))(whole, ends, nodes)
    return PathTable(pos, vel, ends / (_NODES - 3)), ends
