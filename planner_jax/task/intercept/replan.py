"""Re-planning: from the plan that is being driven, for what the target is now thought to do.

Between two looks at a target its expected path moves by centimetres, and so does the best way.
What is left of the previous plan is a guess from which a few steps of least squares suffice;
planning from scratch stays for what they do not mend.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.checks import require_beginning, require_kind, require_path
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.target import PlanePath
from planner_jax.planning.replan import Replanning, given_or_own, moment_of
from planner_jax.robot.car import pose_at
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.searches import Search


@dataclasses.dataclass(frozen=True)
class Warm(Attempt):
    """An attempt: steps of least squares from what is left of the previous plan; static."""

    solver: LevenbergConfig = LevenbergConfig(8)
    settling: int = 4  # steps towards less effort
    margin: float = 0.03  # as of a `Search`
    slack: float = 0.015
    discs: int = 3


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ReplanIntercept(Planner):
    """Interceptions re-planned from the previous plan, as `pj.replan` asks for them.

    With less than `shortest` left until the meeting nothing is planned: what is left of the
    previous plan comes back.
    """

    case_type: ClassVar[type] = Replanning
    is_sequential: ClassVar[bool] = True
    plan_type: ClassVar[type] = InterceptPlan
    planner: SpacetimeIntercept = SpacetimeIntercept()
    warm: Warm = Warm()
    shortest: float = 0.1  # [s]

    @property
    def attempts(self) -> tuple[Attempt, ...]:
        """From the previous plan, then the first from scratch: others take too long."""
        return (self.warm, self.planner.attempts[0])

    @property
    def inner(self) -> SpacetimeIntercept:
        """The planner of the cases that are planned again."""
        return self.planner

    def begin(
        self,
        cases: InterceptCase,
        previous: InterceptPlan,
        elapsed: Any,
        *,
        target: PlanePath,
        movers: Obstacles | None = None,
        start: Any = None,
        speed: Any = None,
        curvature: Any = None,
    ) -> Replanning:
        """What is left of a case, or of a batch, some time into its plan; see `pj.replan`.

        Args:
            cases: what `previous` was planned for.
            previous: the plan that is being driven.
            elapsed: () or (B,) [s], since it began, >= 0.
            target: its path as expected now, with times that count from now.
            movers: the moving obstacles as they are now; moved on evenly if not given.
            start: (3,) or (B, 3), where the rear axle is: x, y [m] and heading [rad].
            speed: () or (B,) [m/s], now.
            curvature: () or (B,) [1/m], now. Of these three what is not given is the plan's own;
                what is beyond the car's limits counts as at them.

        Raises:
            ValueError: a negative time.
        """
        elapsed, batch = moment_of(cases, elapsed), cases.batch_shape
        require_path("target", target, batch, 2)
        if movers is not None:
            require_kind("movers", movers, Obstacles)
            require_beginning("movers", movers, batch, f"the batch shape {batch}")
        own = (_states if cases.batch_shape else _state)(previous, elapsed)
        start, speed, curvature = (
            given_or_own(name, given, mine, elapsed)
            for name, given, mine in zip(
                ("start", "speed", "curvature"), (start, speed, curvature), own, strict=True
            )
        )
        limits = cases.limits
        speed = np.clip(speed, 0.0, limits.speed)
        curvature = np.clip(curvature, -np.asarray(limits.curvature), limits.curvature)
        if movers is None:
            passed = cases.movers.velocity * elapsed[..., None, None]
            movers = dataclasses.replace(cases.movers, centre=cases.movers.centre + passed)
        # A plan that was free to choose its time may choose a later one again.
        until = cases.time if self.planner.is_time_free else previous.time
        left = dataclasses.replace(
            cases,
            start=start,
            speed=speed,
            curvature=curvature,
            target=target,
            time=np.maximum(np.asarray(until) - elapsed, 0.5 * self.shortest).astype(elapsed.dtype),
            movers=movers,
        )
        return Replanning(case=left, previous=previous, elapsed=elapsed)

    def solve(self, task: Replanning, attempt: Any) -> InterceptPlan:
        """The plan of one case."""
        if isinstance(attempt, Search):
            return self.planner.solve(task.case, attempt)
        case, planner = task.case, self.planner
        time = jnp.maximum(task.previous.time - task.elapsed, 0.5 * self.shortest)
        point = planner.point(*self.rest(task, time), time)
        guess = planner.guess_at(point)
        grid = planner.grid(case, planner.attempts[0])
        stages = [
            dataclasses.replace(stage, steps=jnp.where(time < self.shortest, 0, stage.steps))
            for stage in planner.last_stages(attempt)
        ]
        field = planner.field(case, grid)
        return planner.refined(case, field, guess, attempt, stages)

    def solve_at_once(self, tasks: Replanning, attempt: Any) -> InterceptPlan:
        """The plans of a batch, all at once."""
        if isinstance(attempt, Search):
            return self.planner.solve_at_once(tasks.case, attempt)
        return super().solve_at_once(tasks, attempt)

    def rest(self, task: Replanning, time: Array) -> tuple[Array, Array]:
        """Speed and curvature of the previous plan at the new knots 1..K, (K,) each."""
        previous, num = task.previous, self.planner.pieces
        at = task.elapsed + time * (jnp.arange(1, num + 1) / num)
        old = previous.time * jnp.linspace(0.0, 1.0, previous.speed.shape[0])
        speed, curvature = (
            jnp.interp(at, old, values) for values in (previous.speed, previous.curvature)
        )
        return speed, curvature


@jax.jit
def _state(plan: InterceptPlan, time: Array) -> tuple[Array, Array, Array]:
    """Pose (3,), speed and curvature at one time of a plan."""
    time = jnp.minimum(time, plan.time)
    old = plan.time * jnp.linspace(0.0, 1.0, plan.speed.shape[0])
    return (
        pose_at(plan.start, plan.time, plan.speed, plan.curvature, time),
        jnp.interp(time, old, plan.speed),
        jnp.interp(time, old, plan.curvature),
    )


_states = jax.jit(jax.vmap(_state))
