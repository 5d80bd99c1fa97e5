"""The `exact` planner of teams: robots plan in turn, and keep their distance from each other."""

import dataclasses
import functools
import operator
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.ball.prediction import PathTable
from planner_jax.core.origin import without_origin
from planner_jax.core.planner import Drive, Planner
from planner_jax.core.protocol import is_solved
from planner_jax.cost.moving import MovingKeepOut
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.decide import Best
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.team.case import TeamCase
from planner_jax.task.team.decide import assign
from planner_jax.task.team.plan import TeamPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

_NODES = 256  # number of nodes of the table of a robot's path
_HOVER = 1.0  # [s], duration of the recovery of a robot that catches nothing
_SPARE = 1.01  # planned least distance between robots, relative to the least distance of the case
# For teams: greatest distances [m] by which estimated flights may miss a target that is still
# tried, and the numbers of orders and of partial orders for each distance.
_MARGINS, _FINALISTS, _WIDTH = (0.0, 0.8, 1.6), 3, 128


@struct.dataclass
class ExactTeam(Planner[TeamCase, TeamPlan]):
    """A planner of teams: a joint decision on the targets, then one robot's plan after another.

    At first every robot hovers. The robots then plan in turn. The trajectories of the others are
    moving keep-outs. A robot may catch the targets that the decision assigns to it or to nobody,
    and in later rounds all targets that no other robot catches. A new plan is selected if it
    catches more. The distance is therefore kept after every step.
    """

    case_type: ClassVar[type] = TeamCase

    planner: Planner[CatchCase, CatchPlan]  # plans the catches and the recovery of one robot
    turns: int = struct.field(pytree_node=False, default=3)  # how often each robot plans

    @property
    def inner(self) -> Planner:
        """The planner of one robot's catches, behind its decision and its recovery."""
        return self.planner.inner.inner

    def plan_by(self, drive: Drive, cases: TeamCase) -> TeamPlan:
        """Return plans of teams, by the loop over searches `drive`."""
        if drive.is_pure:
            raise TypeError("ExactTeam works on the host: call pj.plan outside compiled functions")
        if cases.batch_shape == ():
            one = self.plan_by(drive, jax.tree.map(lambda leaf: np.asarray(leaf)[None], cases))
            return jax.tree.map(lambda leaf: leaf[0], one)
        origin = cases.shared.origin
        cases = dataclasses.replace(cases, shared=without_origin(cases.shared))
        if cases.num_robots == 1:
            robots = [drive(self.planner, cases.of_robot(0))[0]]
        else:
            robots = self._plan_in_turn(drive, cases)
        plans: CatchPlan = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *robots)
        return TeamPlan(
            cost=plans.cost.sum(axis=1),
            violation=plans.violation.max(axis=1),
            iterations=plans.iterations.sum(axis=1),
            status=plans.status.max(axis=1),
            robots=dataclasses.replace(plans, origin=origin),
        )

    def _plan_in_turn(self, drive: Drive, cases: TeamCase) -> list[CatchPlan]:
        cases = jax.tree.map(np.asarray, cases)
        present, robots = cases.shared.present, range(cases.num_robots)
        planner, apart = _with_reach(self.planner), _SPARE * cases.least_distance
        pieces, heads = planner.recovery_planner.num_pieces, jnp.asarray(cases.head_states)
        still = jnp.zeros((*heads.shape[:2], pieces, 8, 3)).at[..., 0, :].set(heads[:, :, None, 0])
        rests = PiecewisePolynomial(still, jnp.full(still.shape[:3], _HOVER / pieces))
        rests = [jax.tree.map(lambda leaf: np.asarray(leaf)[:, k], rests) for k in robots]  # noqa: B023
        paths: list[tuple[PathTable, Array]] = [_tabulate(rest) for rest in rests]

        def plan_with(k: int, allowed: PyTree, by: PyTree) -> PyTree:
            """Plan robot k, with the targets (B, M) that it may catch, by a planner."""
            others = paths[:k] + paths[k + 1 :]
            near = [MovingKeepOut(path, apart, 0.0 * until, until) for path, until in others]
            own = cases.of_robot(k, present=allowed, extras=(*cases.shared.extras, *near))
            return drive(by, jax.tree.map(np.asarray, own))[0]

        plans: list[PyTree] = [
            plan_with(k, present & False, planner.planner).replace(recovery=rests[k])
            for k in robots
        ]
        assigned = np.asarray(assign(cases, _WIDTH, max(_MARGINS)))
        for turn in range(self.turns):
            for k in robots:
                taken = [np.asarray(plan.choice.taken) for plan in plans]
                later = [assigned[:, j] for j in robots[k + 1 :] if turn == 0]
                gone = functools.reduce(operator.or_, taken[:k] + taken[k + 1 :] + later)
                free = present & ~gone
                # A robot that may catch nothing more plans to hover, which takes little time.
                free &= (free & ~taken[k]).any(axis=1, keepdims=True)
                if drive.is_over or not free.any():
                    continue
                new, old = plan_with(k, free, planner), plans[k]
                more = is_solved(new.status) & np.asarray(new.num_taken > old.num_taken)
                pick = lambda a, b: np.where(more.reshape(-1, *[1] * (a.ndim - 1)), a, b)  # noqa: B023, E731
                plans[k] = jax.tree.map(pick, new, old)
                paths[k] = _tabulate(plans[k].whole)
        return plans


def _with_reach(planner: PyTree) -> PyTree:
    """Return a robot's planner whose decision, if it is `Best()`, also tries farther targets."""
    decided, bold = planner.planner, Best(_FINALISTS, _WIDTH, _MARGINS)
    usual = decided.decision == Best()
    return planner.replace(planner=decided.replace(decision=bold)) if usual else planner


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
