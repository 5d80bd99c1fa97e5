"""Named, seeded suites of thrown balls for the task `block` [Natarajan2024, Section V-A].

`docs/suites.md` states the ranges of all suites. Robot base frame, z up, SI units.
"""

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from planner_jax.core.registry import suite_named
from planner_jax.robot.arm import Arm, reach_of
from planner_jax.robot.arm_file import irb1600
from planner_jax.task.arguments import make_generators
from planner_jax.task.block import scene
from planner_jax.task.block.case import BlockCase, case
from planner_jax.task.block.spec import SUITES, TASK, Suite

GRAVITY = 9.81  # [m/s^2]
BALL_RADIUS = 0.05  # [m]
AZIMUTH = np.deg2rad(60.0)  # [rad], greatest magnitude of the launch's azimuth from the x axis
HEIGHT = (-0.48, 1.0)  # [m], range of the launch's height
SPEED = (7.0, 10.0)  # [m/s], range of the horizontal distance divided by the flight time
_STEP = 0.002  # [s], time between two samples of a flight that are checked


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    regime: str | None = None,
    wide: bool = False,
    anywhere: bool = False,
    delay: float = 0.0,
    arm: Arm | None = None,
    dtype: DTypeLike = jnp.float32,
) -> BlockCase:
    """Draw a batch of cases with random throws in float64, and cast them to `dtype`.

    In the suite "pole" (default) a pole stands in front of the arm, in "open" there is none, and in
    "short" balls are launched nearer. Suites of other packages are also accepted. Case k of a suite
    and seed is always the same; the batch has the cases from k = `first` >= 0 on. `ValueError` is
    raised for an unknown suite or a number out of its range.

    * `regime`: joint limits: "R1" of [Natarajan2024], "R2" (default) of the data sheet, with rest
      at the end, "R3" as "R1" with rest at the end. It is left out for an `arm`.
    * `wide`: accept a ball 0.1 m from the shield's middle, 30 degrees from its normal; `anywhere`:
      accept every contact with the shield.
    * `delay`: [s], time at which the arm may start to move.
    * `arm`: another arm than the IRB 1600. The scene and the points at which balls are aimed are
      scaled by the ratio of both arms' reach; launch distances and speeds stay.
    """
    suite = suite_named(suite, "pole")
    if suite not in SUITES:
        return TASK.other_suite(suite)(num, seed, first)
    own, randoms = SUITES[suite], make_generators(suite, num, seed, first)
    size = _size_for(arm)
    throws = np.array([_draw_throw(own, random, size) for random in randoms])
    return case(
        throws[:, 0],
        throws[:, 1],
        delay=delay,
        regime=regime,
        wide=wide,
        anywhere=anywhere,
        scene=scene_for(arm, has_pole=own.has_pole),
        arm=arm,
        dtype=dtype,
    )


def scene_for(arm: Arm | None, *, has_pole: bool = True) -> scene.Scene:
    """Return the scene of [Natarajan2024], scaled to the reach of an arm; None: the IRB 1600."""
    return scene.paper_scene(has_pole=has_pole, size=_size_for(arm))


def _size_for(arm: Arm | None) -> float:
    return 1.0 if arm is None else reach_of(arm) / reach_of(irb1600())


def _draw_throw(suite: Suite, random: np.random.Generator, size: float) -> np.ndarray:
    """Draw throws until one is valid; return position [m] and velocity [m/s] at launch, (2, 3).

    The lengths of the scene are multiplied by `size`.
    """
    inner = size * scene.INNER_HALF
    while True:
        azimuth, distance = random.uniform(-AZIMUTH, AZIMUTH), random.uniform(*suite.distance)
        pos = np.array(
            [distance * np.cos(azimuth), distance * np.sin(azimuth), random.uniform(*HEIGHT)]
        )
        duration = distance / random.uniform(*SPEED)
        sides = [(0, 1.0)] + [(1, side) for side in (1.0, -1.0) if side * pos[1] > inner]
        axis, side = sides[random.integers(len(sides))]
        aim = np.empty(3)
        aim[axis] = side * inner
        aim[1 - axis] = random.uniform(-inner, inner)
        aim[2] = random.uniform(0.0, size * scene.INNER_HEIGHT)
        vel = (aim - pos) / duration
        vel[2] += 0.5 * GRAVITY * duration
        if _is_valid(suite, pos, vel, duration, size):
            return np.stack([pos, vel])


def _is_valid(suite: Suite, pos: np.ndarray, vel: np.ndarray, duration: float, size: float) -> bool:
    """Return whether a throw misses the pole, and stays in the outer box once it has entered."""
    times = np.linspace(0.0, duration, int(np.ceil(duration / _STEP)) + 1)[:-1]
    path = pos + vel * times[:, None]
    path[:, 2] -= 0.5 * GRAVITY * times**2
    if suite.has_pole:
        apart = np.linalg.norm(path[:, :2] - size * np.array(scene.POLE), axis=1)
        if apart.min() < size * scene.POLE_RADIUS + BALL_RADIUS:
            return False

    def within(half: float, height: float) -> np.ndarray:
        half, height = size * half, size * height
        return (np.abs(path[:, :2]) < half).all(axis=1) & (path[:, 2] > 0.0) & (path[:, 2] < height)

    outer = within(scene.OUTER_HALF, scene.OUTER_HEIGHT)
    if not outer.any() or within(scene.INNER_HALF, scene.INNER_HEIGHT).any():
        return False
    entered = int(outer.argmax())
    # The ball has to stay in the outer box after its entry, and must not enter from below: the
    # sample before the entry must have a positive height.
    return bool(outer[entered:].all()) and entered > 0 and path[entered - 1, 2] > 0.0
