"""Which interceptions of a suite can be solved at all, and how early their target can be met.

    python -m benchmarks.intercept_oracle [--suite hard] [--num 200] [--seed 1] [--first K]
        [--workers N] [--out FILE.npz]
"""

import argparse
import functools
import multiprocessing
import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import planner_jax as pj
from planner_jax.benchmarks.intercept_lattice import (
    LAYER,
    MINIMAL,
    STRICT,
    Lattice,
    Reach,
    Rules,
    Scene,
)
from planner_jax.benchmarks.run import at_least
from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.target import PlanePath
from planner_jax.task.intercept.card import SUITES
from planner_jax.task.intercept.case import InterceptCase


def scenes(cases: InterceptCase) -> list[Scene]:
    """The cases of a batch as plain numbers."""
    ends = np.asarray(cases.time, float)
    layers = np.maximum(np.ceil(ends / LAYER - 1e-6), 1).astype(int)
    times = ends[:, None] / layers[:, None] * np.arange(layers.max() + 1)
    with jax.enable_x64(True):
        cases = jax.tree.map(
            lambda leaf: np.asarray(leaf, bool if leaf.dtype == bool else float), cases
        )
        targets = np.asarray(_places(cases.target, times))
    found = []
    for k, (num, places) in enumerate(zip(layers, targets, strict=True)):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], cases)
        movers, velocities = _polygons(one.movers)
        found.append(
            Scene(
                start=one.start,
                initial_speed=float(one.speed),
                dt=float(ends[k] / num),
                target=places[: num + 1],
                tolerance=float(one.tolerance),
                end_heading=float(one.end_heading),
                heading_tolerance=float(one.heading_tolerance),
                walls=_polygons(one.walls)[0],
                movers=movers,
                velocities=velocities,
                lower=one.lower,
                upper=one.upper,
                length=float(one.body.length),
                width=float(one.body.width),
                middle=float(one.body.middle),
                speed=float(one.limits.speed),
                acceleration=float(one.limits.acceleration),
                lateral_acceleration=float(one.limits.lateral_acceleration),
                curvature=float(one.limits.curvature),
            )
        )
    return found


@jax.jit
@jax.vmap
def _places(path: PlanePath, times: jax.Array) -> jax.Array:
    """Where a target is at times (T,) [s], (T, 2) [m]."""
    return jax.vmap(lambda time: path.at(time).pos)(times)


def _polygons(group: Obstacles) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Corners (V, 2) [m] of those that are present, and their velocities (N, 2) [m/s]."""
    corners, present = group.vertices(0.0), np.asarray(group.present)
    return tuple(np.asarray(corners)[present]), np.asarray(group.velocity)[present]
