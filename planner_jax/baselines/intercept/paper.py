"""The planner `paper` [Qu2022]: a car meets a moving target by a path, then a speed along the path.

Hybrid A* searches paths on the host, one after another. One compiled program smooths the paths by
gradient descent, and plans the speeds by dynamic programming and Bezier curves. If the paper does
not report a limit, the limit of the case is used. The curvature of a searched path jumps, and
differs from the car's curvature at the start. The car therefore drives a path close to the smoothed
path, without jumps of the curvature.
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
from planner_jax.task.intercept.problem.clearance import ends_of
from planner_jax.task.intercept.searches import Search

_PACE = 1.2  # the path must be drivable, within the steering rate limit, at 1.2 times mean speed


def paper_speed_step(end_weight: float | None = None) -> SpeedStep:
    """Return the settings with which [Qu2022] plans the speed along a path.

    The paper does not state the number of pieces, which is 20 here.

    Args:
        end_weight: weight of the squared distance from the path's end at the meeting time, 300 in
            [Qu2022] for a meeting after 10 s. By default the path's end is reached exactly.
    """
    lines = SPEED_PLANNERS["trapezoid-edges"]
    speed = dataclasses.replace(lines, pieces=20, end_weight=end_weight)
    return SpeedStep(speed=speed)


@dataclasses.dataclass(frozen=True)
class PaperIntercept(Planner):
    """The planner of [Qu2022]; the car reaches the target at the case's time on a searched path."""

    case_type: ClassVar[type] = InterceptCase
    search: HybridAstar = HybridAstar()
    smoothing: Smoothing = Smoothing()
    follow: FollowConfig = FollowConfig()
    step: SpeedStep = paper_speed_step()
    # Greatest curvature of searched and smoothed paths, as a fraction of the car's limit. Beside
    # them a path without curvature jumps turns more sharply, within the whole limit.
    curvature_share: float = 0.7
    attempts: ClassVar[tuple[Search, ...]] = (Search(1),)  # pyright: ignore[reportIncompatibleMethodOverride]

    def solve_on_host(self, cases: InterceptCase, attempt: Search) -> InterceptPlan:
        """Return the plans of a batch: search paths one by one, then plan all speeds together."""
        num = len(np.asarray(cases.time))
        found = [self.search_path(take(cases, k)) for k in range(num)]
        poses, curvatures, length, is_found = (np.stack(each) for each in zip(*found, strict=True))
        plans = _drive_paths(self, cases, poses, curvatures, length, is_found)
        return jax.tree.map(np.array, plans)

    def search_path(self, case: InterceptCase) -> tuple[np.ndarray, ...]:
        """Search a path; return its poses (N, 3), curvatures (N,), length and whether it exists."""
        found = self.find_path(case)
        dtype = np.asarray(case.time).dtype
        if found is None or not found.found:
            shape = (self.search.poses, 3)
            poses = np.broadcast_to(np.asarray(case.start), shape).astype(dtype)
            return poses, np.zeros(shape[0], dtype), np.ones((), dtype), np.zeros((), bool)
        return (
            found.poses.astype(dtype),
            found.curvature.astype(dtype),
            np.asarray(found.length, dtype),
            np.ones((), bool),
        )

    def find_path(self, case: InterceptCase) -> HybridPath | None:
        """Search a path by Hybrid A*; return None if a number of the case is not finite."""
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
            curvature=self.curvature_share * float(case.limits.curvature),
            body=(behind, ahead, half),
            lower=case.lower,
            upper=case.upper,
            end_heading=float(case.end_heading) if has_heading else None,
            settings=self.search,
        )

    def path(self, case: InterceptCase, poses: Array, curvatures: Array, length: Array) -> Path:
        """Smooth a searched path, and return the nearest path without jumps of the curvature."""
        smooth = smooth_path(
            poses,
            curvatures,
            length,
            case.walls,
            curvature=self.curvature_share * case.limits.curvature,
            body=ends_of(case.body),
            lower=case.lower,
            upper=case.upper,
            settings=self.smoothing,
        )
        # The planned speed varies: the limit of the steering rate must hold at 1.2 times the mean
        # speed, or at 1.2 times the initial speed if this is greater.
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
def _drive_paths(
    planner: PaperIntercept,
    cases: InterceptCase,
    poses: Array,
    curvatures: Array,
    length: Array,
    is_found: Array,
) -> InterceptPlan:
    """Plan a speed along the searched path of each case; arrays have a leading axis of cases."""

    def plan_one(lane: tuple) -> InterceptPlan:
        case, poses, curvatures, length, is_found = lane
        path = planner.path(case, poses, curvatures, length)
        plan = planner.step.drive(case, path, planner.step.problem(case, path))
        worst = jnp.where(is_found, plan.violation, jnp.inf)
        status = jnp.where(is_found, plan.status, Status.NO_PATH)
        plan = dataclasses.replace(plan, violation=worst, status=status)
        return explain(case, status, plan)

    return lax.map(plan_one, (cases, poses, curvatures, length, is_found))
