"""The planner of [Qu2022]: Hybrid A*, gradient descent, dynamic programming, Bezier pieces.

The search runs on the host, one case after another; all that follows is a compiled program. What
the paper leaves open: sizes and limits are those of the case, and the car drives beside the
smoothed path, with a curvature that begins as the case has it and does not jump.
"""

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.baselines.intercept.hybrid_astar import HybridAstar, HybridPath, hybrid_astar
from planner_jax.baselines.intercept.path import FollowConfig, Path, path_beside
from planner_jax.baselines.intercept.path_smoothing import Smoothing, smooth_path
from planner_jax.baselines.intercept.path_then_speed import SpeedStep
from planner_jax.baselines.intercept.speed import SPEED_PLANNERS
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Status, take
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan, explain
from planner_jax.task.intercept.searches import Search
from planner_jax.task.intercept.terms import ends_of

_PACE = 1.2  # times those speeds, at which the steering angle can still follow a path


def printed_speed(end_weight: float | None = None) -> SpeedStep:
    """The speed step as [Qu2022] has it: edges of polygons continued, pieces of a tenth.

    Args:
        end_weight: of a soft end, w_2 T^3 / w_1: 300 for the paper's weights and T = 10 s. By
            default the end is exact.
    """
    speed = dataclasses.replace(SPEED_PLANNERS["trapezoid-edges"], end_weight=end_weight)
    return SpeedStep(speed=speed)


@dataclasses.dataclass(frozen=True)
class PaperIntercept(Planner):
    """Meets the target at the case's time along one searched path."""

    case_type: ClassVar[type] = InterceptCase
    search: HybridAstar = HybridAstar()
    smoothing: Smoothing = Smoothing()
    follow: FollowConfig = FollowConfig()
    step: SpeedStep = printed_speed()
    attempts: ClassVar[tuple[Search, ...]] = (Search(1),)  # pyright: ignore[reportIncompatibleMethodOverride]

    def solve_on_host(self, cases: InterceptCase, attempt: Search) -> InterceptPlan:
        """The plans of a batch."""
        num = len(np.asarray(cases.time))
        found = [self.searched(take(cases, k)) for k in range(num)]
        poses, bends, length, is_found = (np.stack(each) for each in zip(*found, strict=True))
        plans = _driven(self, cases, poses, bends, length, is_found)
        return jax.tree.map(np.array, plans)

    def searched(self, case: InterceptCase) -> tuple[np.ndarray, ...]:
        """Poses (N, 3), curvatures (N,) and length () of a path, and whether there is one."""
        way = self.way(case)
        dtype = np.asarray(case.time).dtype
        if way is None or not way.found:
            shape = (self.search.poses, 3)
            poses = np.broadcast_to(np.asarray(case.start), shape).astype(dtype)
            return poses, np.zeros(shape[0], dtype), np.ones((), dtype), np.zeros((), bool)
        return (
            way.poses.astype(dtype),
            way.curvature.astype(dtype),
            np.asarray(way.length, dtype),
            np.ones((), bool),
        )

    def way(self, case: InterceptCase) -> HybridPath | None:
        """What Hybrid A* finds; None of a case that is not finite."""
        goal = np.asarray(case.target.at(case.time).pos)
        numbers = [case.start, goal, case.limits.curvature, case.lower, case.upper]
        numbers += jax.tree.leaves((case.body, case.walls.corners, case.walls.centre))
        if not all(np.isfinite(each).all() for each in numbers):
            return None
        behind, ahead, half = (float(end) for end in ends_of(case.body))
        has_heading = case.heading_tolerance < np.pi
        return hybrid_astar(
            case.start,
            goal,
            case.walls,
            curvature=float(case.limits.curvature),
            body=(behind, ahead, half),
            lower=case.lower,
            upper=case.upper,
            end_heading=float(case.end_heading) if has_heading else None,
            settings=self.search,
        )

    def path(self, case: InterceptCase, poses: Array, bends: Array, length: Array) -> Path:
        """The path that the car drives, of a searched one."""
        smooth = smooth_path(
            poses,
            bends,
            length,
            case.walls,
            curvature=case.limits.curvature,
            body=ends_of(case.body),
            lower=case.lower,
            upper=case.upper,
            settings=self.smoothing,
        )
        # Slow enough a change for the speeds that the car has at the start and needs on average.
        pace = _PACE * jnp.maximum(case.speed, smooth.length / case.time)
        rate = case.limits.steering_rate / (case.body.wheelbase * pace)
        return path_beside(
            case.start,
            case.curvature,
            smooth.poses[:, :2],
            smooth.curvature,
            smooth.length,
            case.limits.curvature,
            rate,
            self.follow,
        )


@functools.partial(jax.jit, static_argnums=0)
def _driven(
    planner: PaperIntercept,
    cases: InterceptCase,
    poses: Array,
    bends: Array,
    length: Array,
    is_found: Array,
) -> InterceptPlan:
    """The plans along searched paths, leaves with a leading axis B."""

    def one(given: tuple) -> InterceptPlan:
        case, poses, bends, length, is_found = given
        path = planner.path(case, poses, bends, length)
        plan = planner.step.drive(case, path, planner.step.problem(case, path))
        worst = jnp.where(is_found, plan.violation, jnp.inf)
        status = jnp.where(is_found, plan.status, Status.NO_PATH)
        plan = dataclasses.replace(plan, violation=worst, status=status)
        return explain(case, status, plan)

    return lax.map(one, (cases, poses, bends, length, is_found))
