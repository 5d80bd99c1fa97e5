"""Named, seeded suites of thrown balls.

[Natarajan2024] throws from 6 to 12 m and says that its 200 projectiles cross both boxes (Section
V-A); it gives no other range. Those here and in `planner_jax.task.block.spec` are this library's,
and part of each suite's name: a change of a range is another suite. All draws are uniform.

| what | drawn from |
|---|---|
| launch | -60 to 60 degrees about the x axis, the suite's distance, -0.48 to 1 m high |
| aim | anywhere on those of the inner box's sides +x, +y and -y that face the launch |
| flight time to it | the distance over 7 to 10 m/s |

A throw is drawn anew unless the ball, of 0.05 m radius, gets into the outer box through a side or
the top, from there into the inner box, and touches no pole before. Robot base frame, z up, SI.
"""

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from planner_jax.core.registry import suite_named
from planner_jax.task.arguments import make_generators
from planner_jax.task.block.case import BlockCase, case
from planner_jax.task.block.scene import (
    INNER_HALF,
    INNER_HEIGHT,
    OUTER_HALF,
    OUTER_HEIGHT,
    POLE,
    POLE_RADIUS,
    paper_scene,
)
from planner_jax.task.block.spec import SUITES, TASK, Suite

GRAVITY = 9.81  # [m/s^2]
BALL_RADIUS = 0.05  # [m]
AZIMUTH = np.deg2rad(60.0)  # [rad], greatest, either way
HEIGHT = (-0.48, 1.0)  # [m], of the launch
SPEED = (7.0, 10.0)  # [m/s], distance over flight time
_LOOK = 0.002  # [s], between two places of a ball that are looked at


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    regime: str = "R2",
    wide: bool = False,
    anywhere: bool = False,
    delay: float = 0.0,
    dtype: DTypeLike = jnp.float32,
) -> BlockCase:
    """Draw throws as a batch of cases in float64, and cast it.

    The suite is "pole" by default, "open", "short", or one that another package offers. `regime`,
    `wide`, `anywhere` and `delay` [s] are those of `case`; the other arguments and the errors are
    those of `pj.hit.draw`.
    """
    suite = suite_named(suite, "pole")
    if suite not in SUITES:
        return TASK.other_suite(suite)(num, seed, first)
    own, randoms = SUITES[suite], make_generators(suite, num, seed, first)
    thrown = np.array([_throw(own, random) for random in randoms])
    return case(
        thrown[:, 0],
        thrown[:, 1],
        delay=delay,
        regime=regime,
        wide=wide,
        anywhere=anywhere,
        scene=paper_scene(has_pole=own.has_pole),
        dtype=dtype,
    )


def _throw(suite: Suite, random: np.random.Generator) -> np.ndarray:
    """Return the first draw that counts: position [m] and velocity [m/s] at the launch, (2, 3)."""
    while True:
        azimuth, distance = random.uniform(-AZIMUTH, AZIMUTH), random.uniform(*suite.distance)
        pos = np.array(
            [distance * np.cos(azimuth), distance * np.sin(azimuth), random.uniform(*HEIGHT)]
        )
        duration = distance / random.uniform(*SPEED)
        sides = [(0, 1.0)] + [(1, side) for side in (1.0, -1.0) if side * pos[1] > INNER_HALF]
        axis, side = sides[random.integers(len(sides))]
        aim = np.empty(3)
        aim[axis] = side * INNER_HALF
        aim[1 - axis] = random.uniform(-INNER_HALF, INNER_HALF)
        aim[2] = random.uniform(0.0, INNER_HEIGHT)
        vel = (aim - pos) / duration
        vel[2] += 0.5 * GRAVITY * duration
        if _counts(suite, pos, vel, duration):
            return np.stack([pos, vel])


def _counts(suite: Suite, pos: np.ndarray, vel: np.ndarray, duration: float) -> bool:
    """Return whether a ball, in the inner box at a time [s], enters both boxes past the pole."""
    times = np.linspace(0.0, duration, int(np.ceil(duration / _LOOK)) + 1)[:-1]
    places = pos + vel * times[:, None]
    places[:, 2] -= 0.5 * GRAVITY * times**2
    if suite.has_pole:
        away = np.linalg.norm(places[:, :2] - POLE, axis=1)
        if away.min() < POLE_RADIUS + BALL_RADIUS:
            return False

    def within(half: float, height: float) -> np.ndarray:
        inside = (np.abs(places[:, :2]) < half).all(axis=1)
        return inside & (places[:, 2] > 0.0) & (places[:, 2] < height)

    outer = within(OUTER_HALF, OUTER_HEIGHT)
    if not outer.any() or within(INNER_HALF, INNER_HEIGHT).any():
        return False
    entered = int(outer.argmax())
    # From there on it stays inside; what came from below was in the box's shadow just before.
    return bool(outer[entered:].all()) and entered > 0 and places[entered - 1, 2] > 0.0
