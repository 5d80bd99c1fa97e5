"""Named, seeded suites of thrown balls for the task `block` [Natarajan2024, Section V-A].

`docs/suites.md` states the ranges of all suites. Robot base frame, z up, SI units.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from scipy.spatial.transform import Rotation

from planner_jax.core import GRAVITY
from planner_jax.core.checks import require_kind
from planner_jax.core.errors import ArgumentError
from planner_jax.core.registry import suite_named
from planner_jax.referee import solids
from planner_jax.robot import arm_scene
from planner_jax.robot.arm import Arm, reach_of
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_scene import Scene
from planner_jax.task.arguments import make_generators
from planner_jax.task.block.case import BlockCase, case
from planner_jax.task.block.spec import SUITES, TASK, Suite

BALL_RADIUS = 0.05  # [m]
AZIMUTH = np.deg2rad(60.0)  # [rad], greatest magnitude of the launch's azimuth from the x axis
HEIGHT = (-0.48, 1.0)  # [m], range of the launch's height
SPEED = (7.0, 10.0)  # [m/s], range of the horizontal distance divided by the flight time
_PASSES = 0.5  # [s], time in which a ball passes the protected body
_TRIES = 2000  # greatest number of random throws for one case
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
    scene: Scene | None = None,
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
    * `scene`: another scene. Balls are aimed at the box around its protected body, and miss its
      obstacles.
    """
    suite = suite_named(suite, "pole")
    if suite not in SUITES:
        return TASK.other_suite(suite)(num, seed, first)
    if arm is not None:
        require_kind("arm", arm, Arm)
    own, randoms = SUITES[suite], make_generators(suite, num, seed, first)
    size = _size_for(arm)
    inner, outer = (
        size * np.array([(-half, -half, 0.0), (half, half, height)])
        for half, height in (
            (arm_scene.INNER_HALF, arm_scene.INNER_HEIGHT),
            (arm_scene.OUTER_HALF, arm_scene.OUTER_HEIGHT),
        )
    )
    if scene is None:
        scene = scene_for(arm, has_pole=own.has_pole)
    else:
        require_kind("scene", scene, Scene)
        radius = float(scene.inner_radius) * np.array([[-1.0], [1.0]])
        inner = np.array([scene.inner.lower, scene.inner.upper], float) + radius
        outer = np.array([scene.outer.lower, scene.outer.upper], float)
    throws = np.array([_draw_throw(own, random, scene, inner, outer) for random in randoms])
    return case(
        throws[:, 0],
        throws[:, 1],
        delay=delay,
        regime=regime,
        wide=wide,
        anywhere=anywhere,
        scene=scene,
        arm=arm,
        dtype=dtype,
    )


def scene_for(arm: Arm | None, *, has_pole: bool = True) -> Scene:
    """Return the scene of [Natarajan2024], scaled to the reach of an arm; None: the IRB 1600."""
    return arm_scene.paper_scene(has_pole=has_pole, size=_size_for(arm))


def _size_for(arm: Arm | None) -> float:
    return 1.0 if arm is None else reach_of(arm) / reach_of(irb1600())


def _draw_throw(
    suite: Suite,
    random: np.random.Generator,
    scene: Scene,
    inner: np.ndarray,
    outer: np.ndarray,
) -> np.ndarray:
    """Draw throws until one is valid; return position [m] and velocity [m/s] at launch, (2, 3).

    `inner` and `outer` are the lowest and highest corners (2, 3) [m] of the scene's boxes.
    """
    for _ in range(_TRIES):
        azimuth, distance = random.uniform(-AZIMUTH, AZIMUTH), random.uniform(*suite.distance)
        pos = np.array(
            [distance * np.cos(azimuth), distance * np.sin(azimuth), random.uniform(*HEIGHT)]
        )
        duration = distance / random.uniform(*SPEED)
        sides = [(0, 1)] + [(1, k) for k in (1, 0) if (pos[1] - inner[k, 1]) * (k - 0.5) > 0.0]
        axis, side = sides[random.integers(len(sides))]
        aim = np.empty(3)
        aim[axis] = inner[side, axis]
        aim[1 - axis] = random.uniform(*inner[:, 1 - axis])
        aim[2] = random.uniform(*inner[:, 2])
        vel = (aim - pos) / duration
        vel[2] += 0.5 * GRAVITY * duration
        if _is_valid(scene, pos, vel, duration, inner, outer):
            return np.stack([pos, vel])
    raise ArgumentError("scene", f"reached by one of {_TRIES} random throws", shown="none")


def _is_valid(
    scene: Scene,
    pos: np.ndarray,
    vel: np.ndarray,
    duration: float,
    inner: np.ndarray,
    outer: np.ndarray,
) -> bool:
    """Return whether a throw misses the obstacles, and stays in the outer box after its entry."""
    times = np.linspace(0.0, duration, int(np.ceil(duration / _STEP)) + 1)[:-1]
    path = pos + vel * times[:, None]
    path[:, 2] -= 0.5 * GRAVITY * times**2
    if np.min(_gaps(scene, path), initial=np.inf) < BALL_RADIUS:
        return False
    if scene.inner_radius > 0.0:  # a ball may pass the rounded edges of the body
        later = np.arange(duration, duration + _PASSES, _STEP)[:, None]
        beyond = pos + vel * later - 0.5 * GRAVITY * later**2 * np.array([0.0, 0.0, 1.0])
        away = beyond - np.clip(beyond, scene.inner.lower, scene.inner.upper)
        gaps = np.linalg.norm(away, axis=1)
        if (ends := scene.inner_ends) is not None:
            gaps = solids.from_segment(beyond.T, *ends[..., None])
        if np.min(gaps) > scene.inner_radius:
            return False
    is_outer, is_inner = (
        (path > box[0]).all(axis=1) & (path < box[1]).all(axis=1) for box in (outer, inner)
    )
    if not is_outer.any() or is_inner.any():
        return False
    entered = int(is_outer.argmax())
    # The ball has to stay in the outer box after its entry, and must not enter from below: the
    # sample before the entry must be above the bottom of the box.
    return bool(is_outer[entered:].all()) and entered > 0 and path[entered - 1, 2] > outer[0, 2]


def _gaps(scene: Scene, path: np.ndarray) -> np.ndarray:
    """Return the distances (K, N) [m] of points (N, 3) from the K obstacles of a scene."""
    point, scene = path.T, scene.without_meshes()

    def ends_of(rods: tuple) -> Iterator[tuple]:
        for ends, radius in zip(*rods, strict=True):
            yield *np.asarray(ends, float)[..., None], float(radius)

    rods = ends_of((scene.capsule_ends, scene.capsule_radius))
    found = [solids.from_segment(point, first, second) - r for first, second, r in rods]
    for middle, turn, half in zip(scene.box_middle, scene.box_turn, scene.box_half, strict=True):
        inside = Rotation.from_quat(turn, scalar_first=True).inv().apply(path - middle)
        found.append(np.linalg.norm(np.maximum(np.abs(inside) - half, 0.0), axis=1))
    for cylinder in ends_of((scene.cylinder_ends, scene.cylinder_radius)):
        found.append(solids.length(solids.from_cylinder(point, *cylinder)))
    return np.array(found)
