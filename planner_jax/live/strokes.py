"""A quadrotor's tasks in live planning (`planner-jax serve`): to hit or to catch a ball.

Each class plans from scratch, or improves the previous plan with the newest estimate of the ball.
To save time, a plan is a single short search of the optimiser, in one compiled call. The next call
continues from its result.
"""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike
from jaxtyping import Float, PyTree

from planner_jax.ball.estimation import Flight
from planner_jax.ball.flight import BallState, rk4_step
from planner_jax.ball.linear_drag import linear_drag_flight
from planner_jax.ball.target import BallPath
from planner_jax.core import GRAVITY
from planner_jax.optimise.planner import SearchPlanner
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.planning.programs import call_packed, solve_cases
from planner_jax.planning.replan import Replanning
from planner_jax.planning.replanner import TRIALS
from planner_jax.robot.heading import with_request
from planner_jax.robot.quadrotor_model import PAPER_CATCHER, PAPER_HITTER, QuadrotorModel
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.case import case as catch_case
from planner_jax.task.catch.decide import Greedy
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.case import case as hit_case
from planner_jax.task.hit.default_planner import HitProblem
from planner_jax.task.hit.plan import HitPlan
from planner_jax.task.hit.spec import DRAG as HIT_DRAG
from planner_jax.trajectory.polynomial import evaluate

CATCH_DRAG = 0.5  # [1/s], drag of the balls in the suite of cases `throws`
TARGET = (3.0, 0.0, 0.0)  # [m], default landing position of a hit ball
_BISECTIONS = 24  # number of bisections in the search for the latest time of a catch
_LONGEST = 4.0  # [s], latest time of a catch
# Fraction of the robot's limits that a plan may use. From a plan that uses its limits fully there
# is often no trajectory to standstill within the limits, so it could not be flown.
_SHARE = 0.97
# Settings to improve the previous plan by two steps of L-BFGS; it is close to the optimum already.
_AGAIN = Attempt(starts=1, solver=LbfgsConfig(max_steps=2, memory=2, trial_steps=TRIALS))

CaseT = TypeVar("CaseT", HitCase, CatchCase)
PlanT = TypeVar("PlanT", HitPlan, CatchPlan)


class Stroke(abc.ABC, Generic[CaseT, PlanT]):
    """Base class of the tasks of live planning: to hit, or to catch, one ball at a time."""

    shortest: ClassVar[float]  # [s], time before the contact with the ball at which planning ends

    def __init__(
        self,
        case: CaseT,
        flight: Flight,
        drag: ArrayLike,
        problem: HitProblem | CatchProblem,
        solvers: tuple[Callable[..., PlanT], Callable[..., PlanT]],
    ) -> None:
        self.case: CaseT = jax.tree.map(np.asarray, case)
        limits = self.case.limits.scale(_SHARE, self.case.gravity)
        self._case = dataclasses.replace(self.case, limits=jax.tree.map(np.asarray, limits))
        self.flight, self.drag = flight, drag
        self._planner = SearchPlanner(problem)
        self._replanner = dataclasses.replace(self._planner.replanner(), attempts=(_AGAIN,))
        # Functions (optimiser's settings, planner, case) -> plan, called by `first` and `again`.
        self._solve_first, self._solve_again = solvers
        self.pieces = problem.num_pieces  # number of polynomial pieces of a plan

    def first(
        self,
        ball: BallState,
        head_state: Float[np.ndarray, "4 3"],
        yaw: Float[np.ndarray, " 2"] | None = None,
    ) -> PlanT:
        """Plan from `head_state`: the robot's position, velocity, acceleration, jerk at time 0.

        `yaw` has the heading at time 0 and its derivative; None without a requested heading.
        """
        case = dataclasses.replace(self._with_ball(ball), head_state=head_state)
        if yaw is not None and case.heading is not None:
            case = with_request(case, dataclasses.replace(case.heading, start=yaw))
        return call_packed(self._solve_first, self._planner.attempts[1], self._planner, case)

    def again(self, plan: PlanT, elapsed: float, ball: BallState) -> PlanT:
        """Improve a plan flown for `elapsed` [s], given a newer estimate of the ball."""
        since = np.asarray(elapsed, np.float32)
        task = Replanning(self._with_ball(ball), plan, since)
        return call_packed(self._solve_again, _AGAIN, self._replanner, task)

    @abc.abstractmethod
    def contact(self, plan: PlanT) -> float:
        """Return the time [s], from the plan's start, at which the robot meets the ball."""

    @abc.abstractmethod
    def _with_ball(self, ball: BallState) -> CaseT:
        """Return the planning problem (robot, limits, ball) with this estimated ball at time 0."""


def _state_in(task: Replanning) -> Array:
    path, elapsed = task.previous.trajectory, jnp.asarray(task.elapsed)
    return jnp.stack([evaluate(path, elapsed, order) for order in range(4)])


def _solve(attempt: Attempt, planner: SearchPlanner, case: PyTree) -> PyTree:
    return solve_cases(planner, case, attempt)


def _hit_again(attempt: Attempt, planner: SearchPlanner, task: Replanning) -> HitPlan:
    case = dataclasses.replace(task.case, head_state=_state_in(task))
    return _solve(attempt, planner, dataclasses.replace(task, case=case))


class HitStroke(Stroke[HitCase, HitPlan]):
    """The task to hit one ball so that it lands at a target.

    Args:
        robot: quadrotor with a racket.
        target: (3,) [m], desired landing point.
        drag: K_D [1/m], quadratic drag of the ball.
        **turn: arguments `heading` and `max_yaw_rate` of `pj.hit.case`.
    """

    shortest = 0.2

    def __init__(
        self,
        robot: QuadrotorModel = PAPER_HITTER,
        *,
        target: Sequence[float] = TARGET,
        drag: float = HIT_DRAG,
        **turn: Any,
    ) -> None:
        ball = (6.0, 0.0, 2.0), (-1.0, 0.0, 0.0)
        case = hit_case(*ball, target, robot=robot, drag=drag, **turn)
        problem = HitProblem(drag_after_impact=True)
        super().__init__(case, rk4_step, drag, problem, (_solve, _hit_again))

    def contact(self, plan: HitPlan) -> float:
        """Return the time [s] at which a plan hits the ball."""
        return float(plan.stroke.time)

    def _with_ball(self, ball: BallState) -> HitCase:
        return dataclasses.replace(self._case, ball=ball)


def _time_left(case: CatchCase) -> Array:
    height = case.limits.min_height + case.net.height
    path = jax.tree.map(lambda leaf: leaf[0], case.targets)
    start = jnp.maximum(path.ball.vel[2], 0.0) / path.gravity

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = 0.5 * (bounds[0] + bounds[1])
        above = path.at(middle).pos[2] > height
        return jnp.where(above, middle, bounds[0]), jnp.where(above, bounds[1], middle)

    low, _ = lax.fori_loop(0, _BISECTIONS, halve, (start, jnp.full_like(start, _LONGEST)))
    return jnp.where(path.at(start).pos[2] > height, low, 0.0)[None]


def _catch_first(attempt: Attempt, planner: SearchPlanner, case: CatchCase) -> CatchPlan:
    """Plan a catch from scratch; the first guess is the earliest catch within the robot's reach."""
    case = dataclasses.replace(case, horizon=_time_left(case))
    case = case.with_choice(jax.tree.map(lambda leaf: leaf[0], Greedy().propose(case)))
    return _solve(attempt, planner, case)


def _catch_again(attempt: Attempt, planner: SearchPlanner, task: Replanning) -> CatchPlan:
    previous = task.previous
    case = dataclasses.replace(
        task.case,
        horizon=_time_left(task.case),
        order=previous.order,
        times=previous.times - task.elapsed,
        head_state=_state_in(task),
    )
    return _solve(attempt, planner, dataclasses.replace(task, case=case))


class CatchStroke(Stroke[CatchCase, CatchPlan]):
    """The task to catch one ball before it falls below the net's lowest allowed height.

    Args:
        robot: quadrotor with a net.
        drag: K_i [1/s], linear drag of the ball, equal on all axes.
        **turn: arguments `heading` and `max_yaw_rate` of `pj.catch.case`.
    """

    shortest = 0.15

    def __init__(
        self, robot: QuadrotorModel = PAPER_CATCHER, *, drag: float = CATCH_DRAG, **turn: Any
    ) -> None:
        zero, gravity = jnp.zeros((1, 3)), jnp.full(1, GRAVITY, jnp.float32)
        path = BallPath(BallState(zero, zero), jnp.full((1, 3), drag, jnp.float32), gravity)
        case = catch_case(path, np.ones(1, np.float32), robot=robot, **turn)
        solvers = _catch_first, _catch_again
        super().__init__(case, linear_drag_flight, np.full(3, drag), CatchProblem(), solvers)

    def contact(self, plan: CatchPlan) -> float:
        """Return the time [s] at which a plan catches the ball."""
        return float(plan.times[0])

    def _with_ball(self, ball: BallState) -> CatchCase:
        one = BallState(pos=ball.pos[None], vel=ball.vel[None])
        path: Any = self.case.targets
        return dataclasses.replace(self._case, targets=dataclasses.replace(path, ball=one))
