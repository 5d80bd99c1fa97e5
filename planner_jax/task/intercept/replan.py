"""Re-planning of interceptions for a new expected path of the target, while a plan is driven.

Between two observations the expected path of a target moves by centimetres, and so does the best
trajectory. From the remainder of the previous plan a few steps of least squares suffice. Cases that
remain unsolved are planned from scratch.
"""

import dataclasses
from typing import ClassVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from planner_jax.core.errors import ArgumentTypeError
from planner_jax.core.paths import require_beginning, require_path
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import BaseAttempt
from planner_jax.plane.obstacles import Obstacles, move_on
from planner_jax.plane.target import LaterPath, PlanePath
from planner_jax.planning.replan import ReplanAround, Replanning, check_elapsed, resolve_arguments
from planner_jax.robot.car import pose_at
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.problem.motion_problem import MotionProblem
from planner_jax.task.intercept.searches import Search, Warm, make_field, make_grid
from planner_jax.task.intercept.units import enter_units, leave_units, units_of


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ReplanIntercept(ReplanAround[InterceptPlan]):
    """Planner for `pj.replan` that continues interceptions from the plans that are being driven.

    If less than `shortest` [s] remains until the meeting, the remainder of the plan is returned.
    """

    is_sequential: ClassVar[bool] = True
    plan_type: ClassVar[type] = InterceptPlan
    planner: Planner[InterceptCase, InterceptPlan]  # plans from scratch, by a `Search`
    search: Search  # the attempt of `planner` from scratch
    problem: MotionProblem  # the least-squares problem of `planner`
    warm: Warm = Warm()
    shortest: float = 0.1  # [s] least time to the meeting for which a new plan is made

    @property
    def attempts(self) -> tuple[BaseAttempt, ...]:
        """The attempts at a new plan: from the previous plan, then by one search from scratch."""
        return (self.warm, self.search)

    def begin(
        self,
        cases: InterceptCase,
        previous: InterceptPlan,
        elapsed: ArrayLike,
        *,
        target: PlanePath | None = None,
        walls: Obstacles | None = None,
        movers: Obstacles | None = None,
        start: ArrayLike | None = None,
        speed: ArrayLike | None = None,
        curvature: ArrayLike | None = None,
    ) -> Replanning:
        """Return what remains of interceptions `elapsed` [s] after the start of their plans.

        Args:
            cases: one case or a batch of B cases, as they were planned.
            previous: the plans that are being driven.
            elapsed: () [s], time since the start of the plans, or (B,) for B cases.
            target: the expected path of the target; its time 0 is the moment of re-planning. By
                default it is the path of the case.
            walls: the static obstacles known at this moment, by `pj.obstacles`; by default the
                walls of the cases.
            movers: the moving obstacles at this moment; by default the obstacles of the cases,
                moved at their velocities.
            start: (3,) or (B, 3) x, y [m], heading [rad] of the rear axle; by default as planned.
            speed: () or (B,) [m/s]; by default as planned; clipped to the car's limits.
            curvature: () or (B,) [1/m]; by default as planned; clipped to the car's limits.
        """
        elapsed, batch = check_elapsed(cases, elapsed), cases.batch_shape
        if target is None:
            begin = cast(Array, np.broadcast_to(elapsed, batch))
            target = LaterPath(path=cases.target, begin=begin)
        require_path("target", target, batch, 2)
        for name, group in (("walls", walls), ("movers", movers)):
            if group is not None:
                if not isinstance(group, Obstacles):
                    shown = f"a {type(group).__name__}"
                    raise ArgumentTypeError(name, "made by pj.obstacles", shown=shown)
                require_beginning(name, group, batch, f"the batch shape {batch}")
        pose, rate, bend = (_states if cases.batch_shape else _state)(previous, elapsed)
        now = resolve_arguments(
            elapsed, start=(start, pose), speed=(speed, rate), curvature=(curvature, bend)
        )
        limits = cases.limits
        now["speed"] = np.clip(now["speed"], limits.least_speed, limits.speed)
        least = -np.asarray(limits.curvature)
        now["curvature"] = np.clip(now["curvature"], least, limits.curvature)
        if movers is None:
            movers = move_on(cases.movers, elapsed)
        # If the meeting time is free, the new plan may meet the target later than the old plan.
        until = cases.time if self.problem.is_time_free else previous.time
        remainder = dataclasses.replace(
            cases,
            **now,
            target=target,
            time=np.maximum(np.asarray(until) - elapsed, 0.5 * self.shortest).astype(elapsed.dtype),
            earliest=np.maximum(np.asarray(cases.earliest) - elapsed, 0.0).astype(elapsed.dtype),
            walls=cases.walls if walls is None else walls,
            movers=movers,
        )
        return Replanning(case=remainder, previous=previous, elapsed=elapsed)

    def load_attempt(self, attempt: Search | Warm, tasks: Replanning) -> PyTree:
        """Return settings of an attempt in the form of an argument of the compiled `solve`.

        Settings of a `Search` become arrays, so that its compiled program serves other searches,
        too. `Warm` settings are constants of their own compiled program.
        """
        if isinstance(attempt, Search):
            return self.planner.load_attempt(attempt, tasks.case)
        return super().load_attempt(attempt, tasks)

    def solve(self, task: Replanning, attempt: Search | Warm) -> InterceptPlan:
        """Plan one case: by `Warm` from the previous plan, or by `Search` without that plan."""
        if isinstance(attempt, Search):
            return self.planner.solve(task.case, attempt)
        problem, units = self.problem, units_of(task.case)
        case = enter_units(task.case, units)
        time = jnp.maximum(task.previous.time - task.elapsed, 0.5 * self.shortest)
        point = problem.pack(*self._sample_previous(task, time), time)
        guess = problem.guess_at(problem.enter_units(point, units))
        grid = make_grid(case, self.search.lattice, is_time_free=problem.is_time_free)
        stages = [
            dataclasses.replace(stage, steps=jnp.where(time < self.shortest, 0, stage.steps))
            for stage in problem.list_last_stages(attempt)
        ]
        plan = problem.refine(case, make_field(case, grid), guess, attempt, stages)
        return leave_units(plan, task.case, units, is_early=problem.meet == "early")

    def solve_at_once(self, tasks: Replanning, attempt: Search | Warm) -> InterceptPlan:
        """Plan all cases of a batch together; a `Search` also tries all its paths together."""
        if isinstance(attempt, Search):
            return self.planner.solve_at_once(tasks.case, attempt)
        return super().solve_at_once(tasks, attempt)

    def _sample_previous(self, task: Replanning, time: Array) -> tuple[Array, Array]:
        previous, num = task.previous, self.problem.pieces
        at = task.elapsed + time * (jnp.arange(1, num + 1) / num)
        old = previous.time * jnp.linspace(0.0, 1.0, previous.speed.shape[0])
        return jnp.interp(at, old, previous.speed), jnp.interp(at, old, previous.curvature)


@jax.jit
def _state(plan: InterceptPlan, time: Array) -> tuple[Array, Array, Array]:
    time = jnp.minimum(time, plan.time)
    old = plan.time * jnp.linspace(0.0, 1.0, plan.speed.shape[0])
    return (
        pose_at(plan.start, plan.time, plan.speed, plan.curvature, time),
        jnp.interp(time, old, plan.speed),
        jnp.interp(time, old, plan.curvature),
    )


_states = jax.jit(jax.vmap(_state))
