"""Catches planned anew during a flight."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.prediction import PathTable, predict_path
from planner_jax.core.protocol import is_better
from planner_jax.optimise.settings import LbfgsConfig, Round
from planner_jax.planning.replan import Replanning
from planner_jax.sims.loop_state import Outlook
from planner_jax.sims.scoring import passage
from planner_jax.task.arguments import find_decision
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.replan import ReplanCatch
from planner_jax.task.catch.spec import DECISIONS, TRAINED

_TABLE_NODES = 36
BORNE = 0.1  # share of a limit by which a plan may break it and is still flown
_KEPT = 0.01  # relative excess up to which limits count as kept by a plan of the loop
_CHEAPER = 0.95  # share of the cost below which a plan from scratch replaces one that keeps them
_INSTANT = 1e-3  # [s], shorter than any look
LIFT = 0.1  # of guesses in flight, at every catch: a little more thrust than the weight


@dataclasses.dataclass(frozen=True)
class CatchPilot:
    """Plans catches anew from the plan that is flown, and from order and times decided anew."""

    # Later than 0.2 s before a catch a new plan shakes more than the news of the ball is worth.
    planner: ReplanCatch = ReplanCatch(ExactCatch(lift=LIFT), shortest=0.2)
    # By which share of a limit a new plan may break it and is still flown; one that breaks it by
    # more is flown only if the old plan breaks its limits by as much. The first share holds for
    # the last catch, the second while several are left: then most of the excess lies on the
    # way to catches that will be planned from scratch later, and keeping the old plan would miss
    # the ball that comes first.
    excess: tuple[float, float] = (BORNE, 1.0)
    # The name of a decision about catches, or "policy:FILE"; "given" keeps order and times of the
    # plan that is flown, and only its way is searched for from scratch.
    decide: str = "greedy"
    redecide: float = (
        100.0  # [Hz], of deciding anew, a divisor of the rate of planning; 0 for never
    )
    search: Round = Round(starts=1, solver=LbfgsConfig(max_steps=25))  # of what is decided anew
    passage = staticmethod(passage)

    def times(self, plan: CatchPlan) -> Array:
        """When each ball is to be caught (N,) [s], in the balls' order."""
        return jnp.zeros_like(plan.times).at[plan.order].set(plan.times)

    def plan_shapes(self, cases: CatchCase) -> CatchPlan:
        """Those of the planner behind the re-planner."""
        return self.planner.planner.plan_shapes(cases)

    def pose_problem(
        self, case: CatchCase, plan: CatchPlan, outlook: Outlook
    ) -> Replanning[CatchCase, CatchPlan]:
        """What is still to be caught, while a plan is flown."""
        made = plan.times <= outlook.elapsed
        first = jnp.argsort(made, stable=True)  # what is still to be caught
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
        """From the plan that is flown, and from scratch as is decided for this moment.

        The first is a short round of the re-planner.
        """
        from_last = lambda task: self.planner.solve(task, self.planner.rounds[0])  # noqa: E731
        return (from_last, self._decide_again) if self.redecide > 0.0 else (from_last,)

    def choose(
        self,
        asked: Replanning[CatchCase, CatchPlan],
        outlook: Outlook,
        found: tuple[CatchPlan, ...],
    ) -> tuple[CatchPlan, Array]:
        """The better of the plans, and whether it is good enough.

        One from scratch is taken where it breaks the limits less, or keeps them at a cost that is
        clearly lower.
        """
        plan, left = found[0], asked.case
        if self.redecide > 0.0:
            fresh = found[1]
            since = jnp.mod(outlook.time + _INSTANT, 1.0 / self.redecide)  # the last time was due
            take = (since < 2.0 * _INSTANT) & (fresh.times[0] >= self.planner.shortest)
            take &= is_worth_flying(fresh, plan)
            plan = jax.tree.map(lambda new, old: jnp.where(take, new, old), fresh, plan)
        good = left.present[left.order[0]] & (left.times[0] >= self.planner.shortest)
        excess = jnp.where(jnp.sum(left.present) > 1, self.excess[1], self.excess[0])
        return plan, good & (plan.violation <= jnp.maximum(excess, asked.previous.violation))

    def _decide_again(self, asked: Replanning[CatchCase, CatchPlan]) -> CatchPlan:
        """A plan from scratch of what is left, with the decision's first choice."""
        left = asked.case
        choices = find_decision(DECISIONS, self.decide, TRAINED).propose(left)
        choice = jax.tree.map(lambda leaf: leaf[0], choices)
        return self.planner.planner.solve(left.with_choice(choice), self.search)


def is_worth_flying(fresh: CatchPlan, warm: CatchPlan) -> Array:
    """Whether () bool a plan from scratch is to be preferred to one from the plan that is flown."""
    return jnp.isfinite(fresh.cost) & is_better(fresh, warm, tolerance=_KEPT, share=_CHEAPER)


def tables(balls: BallState, drag: Array, horizon: Array, gravity: Array) -> PathTable:
    """Predicted paths with quadratic drag of balls (N, ...) up to a horizon (N,) [s]."""
    predict = functools.partial(predict_path, num_nodes=_TABLE_NODES)
    horizon = jnp.maximum(horizon, 0.1)
    return jax.vmap(predict, in_axes=(0, 0, 0, None))(balls, horizon, drag, gravity)
