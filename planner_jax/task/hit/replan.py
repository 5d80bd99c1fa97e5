"""Re-planning of hits for a new estimate of the ball, while a plan is being flown.

The search starts at the previous plan's impact and the smoothest trajectory to it from the
quadrotor's state. A few iterations suffice. [Yu2023bat, Section VI-C] plans once, because "even
minor updates in the terminal state could lead to drastic deformations". In this planner the impact
is part of the search, and it changes as little as the estimate of the ball does.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.ball.flight import BallState
from planner_jax.core.checks import require_kind
from planner_jax.core.paths import require_beginning
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, Round
from planner_jax.planning.replan import Replanning, check_elapsed, planned_state, resolve_argument
from planner_jax.robot.heading import continue_heading
from planner_jax.robot.quadrotor import add_drag, net_thrust, tangent_basis
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.context import HitContext
from planner_jax.task.hit.default_planner import ExactHit
from planner_jax.task.hit.plan import HitPlan
from planner_jax.trajectory.polynomial import evaluate, total_duration

_SHORTEST = 0.01  # [s] least time to the impact in a starting point
# Step lengths that L-BFGS tries, relative to its proposed step. Small lengths are needed, because
# the first step ignores the cost's curvature and is too long.
_TRIALS = (1.0, 0.2, 0.04)


@struct.dataclass
class ReplanHitContext:
    """Data of a re-plan: the remaining hit, and the starting point from the previous plan."""

    hit: HitContext
    start: Array  # (n,), values of the n decision variables for the previous plan's impact


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ReplanHit(OptimisedPlanner):
    """A planner that re-plans hits for `pj.replan`, from previous plans of any hit planner."""

    case_type = Replanning
    plan_type = HitPlan
    planner: ExactHit = ExactHit()
    rounds: tuple[Round, ...] = (
        Round(starts=1, solver=LbfgsConfig(max_steps=2, memory=2, trial_steps=_TRIALS)),
        Round(starts=1, solver=LbfgsConfig(max_steps=40, trial_steps=_TRIALS)),
    )

    @property
    def inner(self) -> ExactHit:
        """The planner of hits that plans what remains of each hit."""
        return self.planner

    def begin(
        self,
        cases: HitCase,
        previous: HitPlan,
        elapsed: ArrayLike,
        *,
        ball: BallState,
        drag: ArrayLike | None = None,
        head_state: ArrayLike | None = None,
    ) -> Replanning:
        """Return what remains of hits `elapsed` [s] after the start of their plans `previous`.

        `cases` are one hit or a batch of B hits as they were planned. `ball` is the new estimate of
        the ball's state, leaves (3,) or (B, 3), and `drag` [1/m] its drag coefficient, by default
        as in `cases`. `head_state` (..., 4, 3) has position, velocity, acceleration and jerk of the
        quadrotor, by default as planned, after the end of a plan as at its end.
        """
        elapsed = check_elapsed(cases, elapsed)
        own = planned_state(previous.trajectory, elapsed)
        head_state = resolve_argument("head_state", head_state, own, elapsed)
        drag = resolve_argument("drag", drag, cases.drag, elapsed)
        require_kind("ball", ball, BallState)
        require_beginning("ball", ball, cases.batch_shape, f"the batch shape {cases.batch_shape}")
        now = dataclasses.replace(cases, ball=ball, drag=drag, head_state=head_state)
        return Replanning(case=now, previous=previous, elapsed=elapsed)

    def prepare(self, task: Replanning) -> ReplanHitContext:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the data of the remaining hit, and a starting point from the previous impact."""
        case = continue_heading(task.case, task.previous, task.elapsed)
        return ReplanHitContext(hit=self.planner.prepare(case), start=self._start(task))

    def _start(self, task: Replanning) -> Array:
        planner, stroke = self.planner, task.previous.stroke
        path = task.previous.trajectory
        vel, acc, jerk = (evaluate(path, total_duration(path), order) for order in (1, 2, 3))
        pull = net_thrust(add_drag(task.case.limits.air, vel, acc), task.case.gravity)
        across = jnp.stack([jnp.sum(vel * each) for each in tangent_basis(stroke.normal)])
        times = jnp.stack([stroke.time - task.elapsed, stroke.flight_time])
        sizes = jnp.append(times, jnp.sqrt(jnp.sum(pull**2)))
        natural = jnp.concatenate([jnp.log(jnp.maximum(sizes, _SHORTEST)), across, jerk])
        return planner.join(jnp.zeros((1, planner.num_offsets // 3, 3), sizes.dtype), natural[None])

    def guesses(self, context: ReplanHitContext, num: int) -> Array:
        """Return `num` starting points: the previous plan's impact, then guesses for a new hit."""
        first = context.start[None]
        if num == 1:
            return first
        return jnp.concatenate([first, self.planner.guesses(context.hit, num - 1)])

    def objective(self, point: Array, context: ReplanHitContext) -> Evaluation:
        """Return the cost, and the largest relative excess over a limit, at n variables `point`."""
        return self.planner.objective(point, context.hit)

    def decode(self, point: Array, context: ReplanHitContext) -> HitPlan:
        """Return the plan of the remaining hit that the n decision variables `point` describe."""
        return self.planner.decode(point, context.hit)
