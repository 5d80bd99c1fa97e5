"""Seeded random cases of the task `reach`; `docs/suites.md` lists the ranges."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from planner_jax.core.registry import suite_named
from planner_jax.robot.arm_scene import FLOOR, make_scene
from planner_jax.task.arguments import make_generators
from planner_jax.task.reach.case import ReachCase, case
from planner_jax.task.reach.spec import SUITES, TASK

# [rad], ranges of the joint angles at start and goal. The first joint turns the arm to the right of
# the box at the start, and to the left of it at the goal.
_SIDE = (1.1, 1.7)
_ANGLES = np.array([(-0.3, 0.5), (-0.5, 0.3), (-1.0, 1.0), (0.2, 1.0), (-1.0, 1.0)])
# Ranges of the box: distance [m] and azimuth [rad] of its middle, halves [m] of its edges, and
# rotation [rad] about the vertical axis. It stands on the floor.
_DISTANCE, _AZIMUTH = (0.7, 0.9), (-0.2, 0.2)
_HALF = np.array([(0.05, 0.12), (0.05, 0.12), (0.5, 1.0)])
_TURN = (-0.8, 0.8)


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    dtype: DTypeLike = jnp.float32,
) -> ReachCase:
    """Draw a batch of random motions of an IRB 1600 around an obstacle.

    Case k of a suite and `seed` is always the same; the batch has `num` cases from k = `first` >= 0
    on. The suite is "pillar" by default, or a suite of another package. `ValueError` is raised for
    an unknown suite or a number out of its range.
    """
    suite = suite_named(suite, "pillar")
    if suite not in SUITES:
        return TASK.other_suite(suite)(num, seed, first)
    rows = [_draw_one(random) for random in make_generators(suite, num, seed, first)]
    start, goal, middle, turn, half = (np.array(each) for each in zip(*rows, strict=True))
    scene = make_scene(boxes=[(middle[0], 2.0 * half[0], turn[0])], floor=FLOOR)
    cases = case(goal, angles=start, scene=scene, dtype=dtype)
    boxes = {"box_middle": middle, "box_turn": turn, "box_half": half}
    leaves = {name: jnp.asarray(each[:, None].astype(dtype), dtype) for name, each in boxes.items()}
    return dataclasses.replace(cases, scene=dataclasses.replace(cases.scene, **leaves))


def _draw_one(random: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Return the angles (6,) [rad] at start and goal, and a box.

    The box has a middle (3,) [m], a quaternion (4,), and halves of its edges (3,) [m].
    """
    sides = random.uniform(*_SIDE, 2) * (-1.0, 1.0)
    start, goal = (np.append(side, random.uniform(*_ANGLES.T)) for side in sides)
    distance, azimuth = random.uniform(*_DISTANCE), random.uniform(*_AZIMUTH)
    half, turn = random.uniform(*_HALF.T), 0.5 * random.uniform(*_TURN)
    flat = distance * np.array([np.cos(azimuth), np.sin(azimuth)])
    middle = np.append(flat, FLOOR + half[2])
    return start, goal, middle, np.array([np.cos(turn), 0.0, 0.0, np.sin(turn)]), half
