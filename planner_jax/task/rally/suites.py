"""Named, seeded suites of rallies: the first ball, the robot, and the places of the hits."""

import dataclasses
import zlib
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from planner_jax.core.checks import floating, require_scalar
from planner_jax.core.choices import require_scale
from planner_jax.core.registry import suite_named
from planner_jax.robot.quadrotor_model import PAPER_HITTER, QuadrotorModel
from planner_jax.task.arguments import require_draw
from planner_jax.task.hit.court import fly
from planner_jax.task.hit.spec import DRAG
from planner_jax.task.hit.suites import GRAVITY
from planner_jax.task.quadrotor import require_own_robot
from planner_jax.task.rally.case import RallyCase, case
from planner_jax.task.rally.spec import SUITES, TASK

_COLUMNS = 8  # random numbers of one case
_HEIGHT = 1.5  # [m], of the middle of the volume
_START = (0.0, 0.0, 1.2)  # [m], hover position of the robot
_APEX = (2.2, 3.7)  # [m], range of the ball's apex


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    hits: int = 2,
    limit_scale: float = 1.0,
    robot: QuadrotorModel = PAPER_HITTER,
    wind: Sequence[float] | None = None,
    dtype: DTypeLike = jnp.float32,
) -> RallyCase:
    """Draw a batch of random rallies: the first `hits` of each, with a hovering quadrotor.

    Case k of a suite and `seed` is always the same; the batch has `num` cases from k = `first` >= 0
    on. `ValueError` is raised for an unknown suite or a number out of its range.

    * `suite`: "juggle" by default; `planner_jax.task.rally.spec.SUITES` describes all suites.
    * `hits`: number K of hits to plan, >= 1.
    * `limit_scale`: factor on the limits of speed, acceleration and body rate.
    * `robot`: quadrotor with a racket. Suites of other packages define their own robot.
    * `wind`: (3,) [m/s], velocity of the air, for a robot with drag.
    """
    suite = suite_named(suite, "juggle")
    require_draw(num, seed, first)
    require_scalar("limit_scale", limit_scale)
    require_scale(limit_scale)
    if suite not in SUITES:
        require_own_robot(robot, PAPER_HITTER, suite, wind)
        return TASK.other_suite(suite)(num, seed, first)
    random = np.random.default_rng([seed, zlib.crc32(suite.encode())])
    random.bit_generator.advance(first * _COLUMNS)  # type: ignore[attr-defined]
    pos, vel = _tosses(random.random((num, _COLUMNS)))
    cases = case(
        pos,
        vel,
        np.broadcast_to([0.0, 0.0, _HEIGHT], (hits, 3)),
        place_range=(0.5, 0.5, 0.5),
        min_contact=1.0,
        max_contact=2.0,
        min_apex=_APEX[0],
        max_apex=_APEX[1],
        robot=robot,
        start=_START,
        drag=DRAG,
        gravity=GRAVITY,
        wind=wind,
        dtype=floating(dtype),
    )
    return dataclasses.replace(cases, limits=cases.limits.scale(limit_scale, cases.gravity))


def _tosses(uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return balls (N, 3) that have just been tossed up inside the volume, and fall into it."""
    apex = _APEX[0] + uniform[:, 4] * (_APEX[1] - _APEX[0])
    fall = np.sqrt(2.0 * (apex - _HEIGHT) / GRAVITY)
    ends = uniform[:, :4].reshape(-1, 2, 2) - 0.5  # x, y of the toss and of the fall
    top, vel = np.zeros((2, len(uniform), 3))
    top[:, :2], top[:, 2] = ends.mean(axis=1), apex
    vel[:, :2] = (ends[:, 1] - ends[:, 0]) / (2.0 * fall)[:, None]
    return fly(top, vel, -fall, DRAG, GRAVITY)
