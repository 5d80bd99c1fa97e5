"""Sizes to which the planners of interceptions pad cases, so that many cases share one program."""

import dataclasses

import numpy as np

from planner_jax.ball.prediction import PathTable
from planner_jax.core.arithmetic import numpy_of
from planner_jax.core.compiled import has_only_cpu
from planner_jax.core.shapes import next_size, on_host, resize
from planner_jax.plane.obstacle_sizes import count_present, fit_obstacles
from planner_jax.plane.target import LaterPath, PlanePath
from planner_jax.task.intercept.case import InterceptCase

# Numbers of walls and moving obstacles. Each pair has a program. On a CPU absent walls hardly take
# time, so that the number of walls may be large; absent moving obstacles take as long as others.
PAIRS = ((16, 4), (64, 12), (64, 64))
WALLS, MOVERS = (16, 64), (4, 12, 64)  # sizes on other devices, for every combination
REGION = (8, 64)  # numbers of corners of the region around the target
NODES = (64,)  # numbers of nodes of a target's table; they do not change the computing time


def fit_case(case: InterceptCase) -> InterceptCase:
    """Return a case, or a batch, that has the same plans and is padded to one of few shapes.

    Walls, moving obstacles, their corners and poses, corners of the region, and nodes of a
    `PathTable` are padded. On a CPU an unlimited jerk becomes the limit infinity. Arrays of a batch
    that are on a device stay there.
    """
    batch, limits = case.batch_shape, case.limits
    region, is_cpu = on_host(case.region, batch), has_only_cpu()
    if limits.jerk is None and is_cpu:
        xp, dtype = numpy_of(on_host(case.time, batch)), case.time.dtype
        limits = dataclasses.replace(limits, jerk=xp.full(batch, np.inf, dtype))
    walls, movers = _choose_sizes(case, is_cpu=is_cpu)
    return dataclasses.replace(
        case,
        walls=fit_obstacles(case.walls, walls, batch),
        movers=fit_obstacles(case.movers, movers, batch),
        region=resize(region, -2, next_size(region.shape[-2], REGION), None),
        target=_fit_target(case.target, batch),
        limits=limits,
    )


def _choose_sizes(case: InterceptCase, *, is_cpu: bool) -> tuple[int, int]:
    """Return the sizes of the arrays of walls and moving obstacles."""
    walls, movers = (count_present(each, case.batch_shape) for each in (case.walls, case.movers))
    apart = next_size(walls, WALLS), next_size(movers, MOVERS)
    fits = (pair for pair in PAIRS if is_cpu and pair[0] >= walls and pair[1] >= movers)
    return next(fits, apart)


def _fit_target(target: PlanePath, batch: tuple[int, ...]) -> PlanePath:
    """Return a target whose table of positions, if it has one, is padded; times are unchanged."""
    if isinstance(target, LaterPath):
        return dataclasses.replace(target, path=_fit_target(target.path, batch))
    if not isinstance(target, PathTable):
        return target
    pos, vel = on_host(target.pos, batch), on_host(target.vel, batch)
    num = pos.shape[-2]
    size = next_size(num, NODES)
    xp, count = numpy_of(pos), target.count
    dtype = target.resolution.dtype
    return dataclasses.replace(
        target,
        pos=resize(pos, -2, size, None),
        vel=resize(vel, -2, size, None),
        count=xp.full(batch, num, dtype) if count is None else on_host(count, batch),
    )
