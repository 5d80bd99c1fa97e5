"""Replanning of a quadrotor's remaining catches in every period of the simulated closed loop."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.linear_drag import linear_drag_flight
from planner_jax.ball.prediction import PathTable, predict_path
from planner_jax.core.protocol import is_better
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.planning.replan import Replanning
from planner_jax.planning.replanner import Replanner
from planner_jax.robot.heading import continue_heading
from planner_jax.sims.loop_state import Outlook, shapes_of_plans
from planner_jax.sims.scoring import passage
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.replan import REMAINDER
from planner_jax.task.catch.spec import DECISIONS, TRAINED
from planner_jax.task.decisions import find_decision

_TABLE_NODES = 36  # number of nodes at which a ball's predicted trajectory is tabulated
BORNE = 0.1  # greatest relative violation of a limit by a plan that is flown
_KEPT = 0.01  # relative violation up to which a plan of the loop counts as feasible
_CHEAPER = 0.95  # cost ratio below which a plan from scratch replaces a feasible warm-started plan
_INSTANT = 1e-3  # [s], time shorter than any observation period
# [s], time before a catch in which the plan is not changed. A change would cost more accuracy than
# new observations of the ball gain.
_SHORTEST = 0.2
LIFT = 0.1  # thrust at every catch in initial guesses: 0 is hover, 1 the greatest thrust


@dataclasses.dataclass(frozen=True)
class CatchPilot:
    """The part of the closed loop that replans catches in flight, and may change their order."""

    planner: Replanner = REMAINDER.planner_of(CatchProblem(lift=LIFT), _SHORTEST)
    # Greatest relative violations of a limit with which a new plan is always flown: with one
    # remaining catch, and with several. A plan that violates a limit more is flown only if the old
    # plan violates limits as much. The second number is larger, because most of the violation then
    # lies in later catches, which will be planned again.
    excess: tuple[float, float] = (BORNE, 1.0)
    # Method that decides order and times of catches, such as "greedy", or "policy:FILE" for a
    # neural network. "given" keeps the current order and times, and plans the trajectory anew.
    decide: str = "greedy"
    redecide: float = 100.0  # [Hz], rate of new decisions; divides the replanning rate; 0: never
    search: Attempt = Attempt(
        starts=1, solver=LbfgsConfig(max_steps=25)
    )  # search after a new decision
    passage = staticmethod(passage)

    def times(self, plan: CatchPlan) -> Array:
        """Return the planned catch times of N balls, (N,) [s] since the plan's start."""
        return jnp.zeros_like(plan.times).at[plan.order].set(plan.times)

    def plan_shapes(self, cases: CatchCase) -> CatchPlan:
        """Return the shapes of the plans of a batch of cases, as `jax.ShapeDtypeStruct`."""
        return shapes_of_plans(self.planner.inner.problem, cases)

    def pose_problem(
        self, case: CatchCase, plan: CatchPlan, outlook: Outlook
    ) -> Replanning[CatchCase, CatchPlan]:
        """Return the problem of replanning remaining catches from predicted robot and balls."""
        made = plan.times <= outlook.elapsed
        first = jnp.argsort(made, stable=True)  # indices of catches, the remaining catches first
        order, times = plan.order[first], plan.times[first] - outlook.elapsed
        horizon = case.horizon - outlook.time
        left = dataclasses.replace(
            case,
            targets=tables(outlook.balls, outlook.drag, horizon, case.gravity),
            present=outlook.present,
            horizon=horizon,
            order=order,
            times=jnp.maximum(times, 0.01),
            head_state=outlook.head_state,
        )
        return Replanning(case=left, previous=plan, elapsed=outlook.elapsed)

    @property
    def searches(self) -> tuple[Callable[[Replanning[CatchCase, CatchPlan]], CatchPlan], ...]:
        """Two searches: a short one from the current plan, and one with new order and times.

        The second search, from scratch, is left out if the setting `redecide` is 0.
        """
        from_last = lambda task: self.planner.solve(task, self.planner.attempts[0])  # noqa: E731
        return (from_last, self._decide_again) if self.redecide > 0.0 else (from_last,)

    def choose(
        self,
        asked: Replanning[CatchCase, CatchPlan],
        outlook: Outlook,
        found: tuple[CatchPlan, ...],
    ) -> tuple[CatchPlan, Array]:
        """Return one of the found plans, and whether it replaces the current plan.

        At the rate `redecide`, the plan from scratch, with newly chosen order, is returned if it is
        cheaper or violates limits less than the plan that continues the current plan.
        """
        plan, left = found[0], asked.case
        if self.redecide > 0.0:
            fresh = found[1]
            # [s], time since a new order was last due. `_INSTANT` absorbs rounding errors.
            since = jnp.mod(outlook.time + _INSTANT, 1.0 / self.redecide)
            take = (since < 2.0 * _INSTANT) & (fresh.times[0] >= _SHORTEST)
            take &= is_worth_flying(fresh, plan)
            plan = jax.tree.map(lambda new, old: jnp.where(take, new, old), fresh, plan)
        good = left.present[left.order[0]] & (left.times[0] >= _SHORTEST)
        excess = jnp.where(jnp.sum(left.present) > 1, self.excess[1], self.excess[0])
        return plan, good & (plan.violation <= jnp.maximum(excess, asked.previous.violation))

    def _decide_again(self, asked: Replanning[CatchCase, CatchPlan]) -> CatchPlan:
        left = continue_heading(asked.case, asked.previous, asked.elapsed)
        choices = find_decision(DECISIONS, self.decide, TRAINED).propose(left)
        choice = jax.tree.map(lambda leaf: leaf[0], choices)
        planner, case = self.planner.inner, left.with_choice(choice)
        return planner.solve(case, self.search)


def is_worth_flying(fresh: CatchPlan, warm: CatchPlan) -> Array:
    """Return whether `fresh`, a plan from scratch, is preferred to `warm`, a warm-started plan.

    If the warm-started plan is feasible, `fresh` must be feasible at a cost that is 5 % lower.
    Otherwise it is enough that `fresh` violates the limits less.
    """
    return jnp.isfinite(fresh.cost) & is_better(fresh, warm, tolerance=_KEPT, share=_CHEAPER)


def tables(balls: BallState, drag: Array, horizon: Array, gravity: Array) -> PathTable:
    """Predict the paths of N balls, up to times `horizon` (N,) [s].

    `drag` is (N,) K_D [1/m] of quadratic drag, or (N, 3) K_i [1/s] of linear drag.
    """
    horizon = jnp.maximum(horizon, 0.1)
    if drag.ndim == 1:
        predict = functools.partial(predict_path, num_nodes=_TABLE_NODES)
        return jax.vmap(predict, in_axes=(0, 0, 0, None))(balls, horizon, drag, gravity)

    def one(ball: BallState, drag: Array, resolution: Array) -> PathTable:
        times = resolution * (jnp.arange(_TABLE_NODES, dtype=resolution.dtype) - 1.0)
        path = jax.vmap(linear_drag_flight, (None, 0, None, None))(ball, times, drag, gravity)
        return PathTable(pos=path.pos, vel=path.vel, resolution=resolution)

    return jax.vmap(one)(balls, drag, horizon / (_TABLE_NODES - 3))
