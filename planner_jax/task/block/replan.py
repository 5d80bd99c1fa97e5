"""Re-planning of blocks for a new estimate of the ball, while a motion is being executed.

Between two observations the estimated flight changes by centimetres, and so does the best motion.
The remainder of the previous motion, with its contact moved along with the ball, is a start from
which a few steps of least squares suffice. Cases that remain unsolved are planned from scratch.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.checks import require_kind
from planner_jax.core.paths import require_beginning
from planner_jax.core.planner import Drive
from planner_jax.core.protocol import BaseAttempt, is_unsolved
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.planning.replan import ReplanAround, Replanning, check_elapsed, resolve_arguments
from planner_jax.robot.arm import shield_pose
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.plan import BlockPlan, append_braking
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.trajectory.polynomial import evaluate

_SHORTEST = 0.02  # [s] least duration of a start, for previous motions that have nearly ended


@dataclasses.dataclass(frozen=True)
class Warm(BaseAttempt):
    """An attempt of least squares that starts from the remainder of the previous motion."""

    solver: LevenbergConfig = LevenbergConfig(*(12, 1e-2, 0.25, 6.0), settled=1, tolerance=1.0)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class WarmBlock(ReplanAround[BlockPlan]):
    """Planner that refines the motion being executed; its cases come from `ReplanBlock.begin`."""

    is_sequential: ClassVar[bool] = True
    planner: OnlineBlock = OnlineBlock()  # its unknowns, limits and weights are used
    attempts: tuple[Warm, ...] = (Warm(),)  # pyright: ignore[reportIncompatibleMethodOverride]

    def solve(self, task: Replanning, attempt: Warm) -> BlockPlan:
        """Return the plan of one case, refined from the remainder of the previous motion."""
        case, planner = task.case, self.planner
        return planner.refine(case, flight_of(case), self.encode_remainder(task), attempt.solver)

    def encode_remainder(self, task: Replanning) -> Array:
        """Return the unknowns that describe the remainder of the previous motion until contact.

        The contact is moved to the time at which the newly estimated ball is nearest to the
        previous position of contact.
        """
        case, previous = task.case, task.previous
        ends = jnp.sum(previous.motion.durations)
        _, middle = shield_pose(case.arm, evaluate(previous.motion, ends))
        ball = drag_free_flight(case.ball, previous.contact_time, case.gravity)
        square = jnp.maximum(jnp.sum(ball.vel**2), 1e-12)
        time = previous.contact_time + jnp.sum(ball.vel * (middle - ball.pos)) / square
        time = jnp.maximum(time, case.delay + _SHORTEST)
        left = jnp.maximum(ends - task.elapsed, 0.0)
        shares = np.arange(1, self.planner.pieces + 1) / self.planner.pieces
        motion = append_braking(case, previous.motion)
        at = lambda share: evaluate(motion, task.elapsed + left * share, 1)  # noqa: E731
        steps = left * jax.vmap(at)(jnp.asarray(shares, time.dtype))
        return jnp.append(steps.reshape(-1), time)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ReplanBlock(ReplanAround[BlockPlan]):
    """Planner for `pj.replan` that starts from the motion being executed.

    `pj.block.planner().replanner()` returns it, and `pj.replan(pj.block.planner(), cases, plans,
    elapsed, ball=...)` uses it.

    In every re-plan, times of cases and plans count from the first observation of the ball. The new
    motion starts at the case's `delay`, which grows from one re-plan to the next.

    Attributes:
        warm: planner that starts from the previous plan.
        planner: planner of cases that `warm` does not solve.
    """

    plan_type: ClassVar[type] = BlockPlan
    warm: WarmBlock = WarmBlock()
    planner: OnlineBlock = OnlineBlock()

    def begin(
        self,
        cases: BlockCase,
        previous: BlockPlan,
        elapsed: ArrayLike,
        *,
        ball: BallState | None = None,
        angles: ArrayLike | None = None,
        rates: ArrayLike | None = None,
    ) -> Replanning:
        """Return the case, or the batch, as it remains `elapsed` seconds into its motion.

        `previous` is the plan of `cases` that is executed, `elapsed` () or (B,) [s] >= 0 the time
        since its start. `ball` is the estimated ball at time 0 of the cases, by default the ball of
        the cases. `angles` [rad] and `rates` [rad/s] at the start of the new motion are (n,), or
        (B, n) for B cases. By default they are taken from the previous plan, whose motion is
        followed by braking.
        """
        elapsed, batch = check_elapsed(cases, elapsed), cases.batch_shape
        if ball is not None:
            require_kind("ball", ball, BallState)
            require_beginning("ball", ball, batch, f"the batch shape {batch}")
        pose, turn = (_states if cases.batch_shape else _state)(cases, previous, elapsed)
        left = dataclasses.replace(
            cases,
            ball=cases.ball if ball is None else ball,
            delay=np.asarray(cases.delay) + elapsed,
            **resolve_arguments(elapsed, angles=(angles, pose), rates=(rates, turn)),
        )
        return Replanning(case=left, previous=previous, elapsed=host_leaf(elapsed))

    def plan_by(self, drive: Drive, tasks: Replanning) -> BlockPlan:
        """Refine motions, or plan from scratch if this fails; `drive` runs compiled planners."""
        plans, _ = drive(self.warm, tasks)
        unsolved, cases = is_unsolved(plans.status), tasks.case
        if not tasks.batch_shape:
            return drive(self.planner, cases)[0] if unsolved else plans
        if not drive.is_pure:
            plans, cases = jax.tree.map(np.array, (plans, cases))
        return drive.plan_again(lambda some: drive(self.planner, some)[0], cases, plans, unsolved)


@jax.jit
def _state(case: BlockCase, plan: BlockPlan, elapsed: Array) -> tuple[Array, Array]:
    motion = append_braking(case, plan.motion)
    is_over = elapsed >= jnp.sum(motion.durations)
    elapsed = jnp.minimum(elapsed, jnp.sum(motion.durations))
    return evaluate(motion, elapsed), jnp.where(is_over, 0.0, evaluate(motion, elapsed, 1))


_states = jax.jit(jax.vmap(_state))
