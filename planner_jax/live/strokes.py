"""What is planned in a live loop: one hit, or one catch, of the ball that is seen.

Each plan is one compiled call. Of every search there is one round alone, since the next look begins
where it ended.
"""

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.ball.estimation import Flight
from planner_jax.ball.flight import BallState, linear_drag_flight, rk4_step
from planner_jax.ball.target import BallPath
from planner_jax.live.export_cache import traced
from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.problem import Round
from planner_jax.planning.programs import solve_cases
from planner_jax.planning.replan import Replanning
from planner_jax.planning.single_call import call_packed
from planner_jax.robot.quadrotor_model import QuadrotorModel
from planner_jax.robot.quadrotor_models import PAPER_CATCHER, PAPER_HITTER
from planner_jax.task.catch.case import GRAVITY as CATCH_GRAVITY
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.case import case as catch_case
from planner_jax.task.catch.decide import Greedy
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.catch.replan import ReplanCatch
from planner_jax.task.hit.case import DRAG as HIT_DRAG
from planner_jax.task.hit.case import GRAVITY as HIT_GRAVITY
from planner_jax.task.hit.case import case as hit_case
from planner_jax.task.hit.default_planner import ExactHit
from planner_jax.task.hit.replan import ReplanHit
from planner_jax.trajectory.polynomial import evaluate

CATCH_DRAG = 0.5  # [1/s], of the suite `throws`
TARGET = (3.0, 0.0, 0.0)  # [m], where a hit ball is to land
_BISECTIONS = 24
_LONGEST = 4.0  # [s], until when a ball is waited for
_TRIALS = (1.0, 0.2, 0.04)  # step lengths, as of the re-planners
# Of the robot's limits, what a plan may use. Where one uses them whole, there is often no way to
# rest from its end that keeps them, so that it cannot be flown.
_SHARE = 0.97
_AGAIN = Round(starts=1, solver=LbfgsConfig(max_steps=2, memory=2, trial_steps=_TRIALS))


class Stroke(Protocol):
    """What a live loop asks of a task."""

    case: Any  # NumPy leaves: robot, its limits, and whatever does not change
    flight: Flight
    drag: Any
    shortest: float  # [s], least time to the contact that is planned anew
    pieces: int  # of a plan's trajectory

    def first(self, ball: BallState, head_state: np.ndarray) -> Any:
        """A plan from scratch; NumPy leaves."""
        ...

    def again(self, plan: Any, elapsed: float, ball: BallState) -> Any:
        """A plan made anew some time [s] into another one; its times count from now."""
        ...

    def contact(self, plan: Any) -> float:
        """When a plan meets the ball [s]."""
        ...


def _on_host(case: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf), case)


def _within(case: Any) -> Any:
    """A case with the share of its limits that plans may use."""
    limits = case.limits.scaled(_SHARE, case.gravity)
    return dataclasses.replace(case, limits=_on_host(limits))


class HitStroke:
    """One hit of the ball to a target.

    Args:
        robot: with a racket.
        target: (3,) [m].
        drag: K_D [1/m] of the ball.
    """

    def __init__(
        self, robot: QuadrotorModel = PAPER_HITTER, *, target: Any = TARGET, drag: float = HIT_DRAG
    ) -> None:
        far = (6.0, 0.0, 2.0)
        self.case = _on_host(hit_case(far, (-1.0, 0.0, 0.0), target, robot=robot, drag=drag))
        self._case = _within(self.case)
        self.flight, self.drag, self.gravity = rk4_step, drag, HIT_GRAVITY
        self.shortest = 0.2
        self._planner = ExactHit(drag_after_impact=True)
        self._again = ReplanHit(self._planner, rounds=(_AGAIN,))
        self.pieces = self._planner.num_pieces

    def first(self, ball: BallState, head_state: np.ndarray) -> Any:
        """See `Stroke`."""
        case = dataclasses.replace(self._case, ball=ball, head_state=head_state)
        return call_packed(_planned, self._planner.rounds[1], self._planner, case, compiler=traced)

    def again(self, plan: Any, elapsed: float, ball: BallState) -> Any:
        """See `Stroke`."""
        task = _left(dataclasses.replace(self._case, ball=ball), plan, elapsed)
        return call_packed(_hit_again, _AGAIN, self._again, task, compiler=traced)

    def contact(self, plan: Any) -> float:
        """See `Stroke`."""
        return float(plan.stroke.time)


class CatchStroke:
    """One catch of the ball, which may be caught until it is too low for the net.

    Args:
        robot: with a net.
        drag: K_i [1/s] of the ball, the same along all axes.
    """

    def __init__(self, robot: QuadrotorModel = PAPER_CATCHER, *, drag: float = CATCH_DRAG) -> None:
        zero, drags = jnp.zeros((1, 3)), jnp.full((1, 3), drag, jnp.float32)
        path = BallPath(BallState(zero, zero), drags, jnp.full(1, CATCH_GRAVITY, jnp.float32))
        self.case = _on_host(catch_case(path, np.ones(1, np.float32), robot=robot))
        self._case = _within(self.case)
        self.flight, self.drag, self.gravity = linear_drag_flight, np.full(3, drag), CATCH_GRAVITY
        self.shortest = 0.15
        self._planner = ExactCatch()
        self._again = ReplanCatch(self._planner, rounds=(_AGAIN,))
        self.pieces = self._planner.num_pieces

    def first(self, ball: BallState, head_state: np.ndarray) -> Any:
        """See `Stroke`."""
        case = dataclasses.replace(self._case, targets=self._path(ball), head_state=head_state)
        return call_packed(_decided, self._planner.rounds[1], self._planner, case, compiler=traced)

    def again(self, plan: Any, elapsed: float, ball: BallState) -> Any:
        """See `Stroke`."""
        case = dataclasses.replace(self._case, targets=self._path(ball))
        task = _left(case, plan, elapsed)
        return call_packed(_caught_again, _AGAIN, self._again, task, compiler=traced)

    def contact(self, plan: Any) -> float:
        """See `Stroke`."""
        return float(plan.times[0])

    def _path(self, ball: BallState) -> BallPath:
        one = BallState(pos=ball.pos[None], vel=ball.vel[None])
        return dataclasses.replace(self.case.targets, ball=one)


def _left(case: Any, plan: Any, elapsed: float) -> Replanning:
    """What is left some time [s] into a plan; where the robot is, the plan says."""
    since: Any = np.float32(elapsed)
    return Replanning(case=case, previous=plan, elapsed=since)


def _where(task: Replanning) -> Array:
    """Position to jerk (4, 3) of a robot that flies its plan."""
    path = task.previous.trajectory
    return jnp.stack([evaluate(path, task.elapsed, order) for order in range(4)])


def _planned(attempt: Round, planner: Any, case: Any) -> Any:
    return solve_cases(planner, case, attempt)


def _hit_again(attempt: Round, planner: ReplanHit, task: Replanning) -> Any:
    case = dataclasses.replace(task.case, head_state=_where(task))
    return _planned(attempt, planner, dataclasses.replace(task, case=case))


def _decided(attempt: Round, planner: ExactCatch, case: CatchCase) -> Any:
    """As `_planned`, at the time at which the ball can first be caught."""
    case = dataclasses.replace(case, horizon=_time_left(case))
    choice = jax.tree.map(lambda leaf: leaf[0], Greedy().propose(case))
    return _planned(attempt, planner, case.decided(choice))


def _caught_again(attempt: Round, planner: ReplanCatch, task: Replanning) -> Any:
    previous = task.previous
    case = dataclasses.replace(
        task.case,
        horizon=_time_left(task.case),
        order=previous.order,
        times=previous.times - task.elapsed,
        head_state=_where(task),
    )
    return _planned(attempt, planner, dataclasses.replace(task, case=case))


def _time_left(case: CatchCase) -> Array:
    """When the ball falls below what an upright net reaches (1,) [s]; 0 if it is there."""
    height = case.limits.min_height + case.net.height
    path = jax.tree.map(lambda leaf: leaf[0], case.targets)
    # Before its apex a ball may be below that height.
    start = jnp.maximum(path.ball.vel[2], 0.0) / path.gravity

    def halved(_: Any, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = 0.5 * (bounds[0] + bounds[1])
        above = path.at(middle).pos[2] > height
        return jnp.where(above, middle, bounds[0]), jnp.where(above, bounds[1], middle)

    low, _ = lax.fori_loop(0, _BISECTIONS, halved, (start, jnp.full_like(start, _LONGEST)))
    return jnp.where(path.at(start).pos[2] > height, low, 0.0)[None]
