"""Named, seeded suites of rallies: the first ball, the robots, and the places of the hits."""

import dataclasses
import math
import zlib
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from scipy.spatial.transform import Rotation

from planner_jax.core import GRAVITY as STANDARD_GRAVITY
from planner_jax.core.checks import floating, require_scalar
from planner_jax.core.choices import require_scale, require_size
from planner_jax.core.registry import suite_named
from planner_jax.robot.quadrotor_model import PAPER_HITTER, QuadrotorModel
from planner_jax.robot.quadrotor_models import IRIS
from planner_jax.task.arguments import require_draw
from planner_jax.task.hit.court import fly
from planner_jax.task.hit.spec import DRAG
from planner_jax.task.hit.suites import GRAVITY
from planner_jax.task.quadrotor import require_own_robot
from planner_jax.task.rally.case import RallyCase, case
from planner_jax.task.rally.spec import SUITES, TASK

_COLUMNS = 8  # random numbers of one case
_WIDE, _LEVEL = (0.5, 0.5, 0.5), (0.0, 0.0, 1.5)
_Point = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Course:
    """The robot of a suite, its first balls, and the rules of a trial in closed loop.

    The boxes repeat: hit k sends the ball to box k modulo their number. With `home` there are two
    robots, which are mirror images of each other in the plane x = 0 and hit in turn.
    """

    places: tuple[_Point, ...] = (_LEVEL, _LEVEL)  # [m], centres of the boxes
    ranges: tuple[_Point, ...] = (_WIDE, _WIDE)  # [m], half their widths
    contact: tuple[float, float] = (1.0, 2.0)  # [m], range of heights of the contacts
    apex: tuple[float, float] = (2.2, 3.7)  # [m], range of the ball's apex
    start: _Point = (0.0, 0.0, 1.2)  # [m], where the robot hovers, or the middle of its starts
    home: _Point | None = None  # [m], where a robot waits while its partner hits
    toss: _Point = _LEVEL  # [m], middle of the square of 1 m from which the first ball is tossed
    robot: QuadrotorModel = PAPER_HITTER
    drag: float = DRAG  # [1/m], K_D of the ball
    gravity: float = GRAVITY  # [m/s^2]
    # [m], height above the robot from which the first ball is dropped; None for a toss. Then the
    # start is random within `spread` [m] of its middle, and roll and pitch within `tilt` [rad].
    drop: float | None = None
    spread: _Point = (0.5, 0.5, 0.2)
    tilt: float = 0.1 * math.pi
    hits: int = 100  # number of hits after which a trial ends
    seconds: float = math.inf  # [s], duration after which a trial ends
    net: float = 0.0  # [m], height of the net in the plane x = 0; 0 for no net
    heights: tuple[float, float] = (0.0, math.inf)  # [m], between which a robot must stay
    circle: float = math.inf  # [m], radius of the circle around the last place that counts


_TARGET, _HALF = (0.8, 0.0, 1.5), 2.5  # [m], the circle of `target`; distance of homes from the net
# The tasks SingleJuggleVolleyball and SingleHitVolleyball of VolleyBots [Xu2025], whose task files
# state the ball without drag, the starts, 16 s an episode, the least mean apex of 3.5 m and the
# heights of the robot. The heights of contacts and the greatest apexes are choices of this project.
_VOLLEYBOTS = Course(
    places=((4.5, 0.0, 2.45),) * 2,
    ranges=((0.5, 0.5, 0.0),) * 2,
    contact=(2.0, 2.5),
    apex=(3.5, 3.6),
    start=(4.5, 0.0, 2.0),
    robot=IRIS,
    drag=0.0,
    gravity=STANDARD_GRAVITY,
    drop=2.0,
    hits=15,
    seconds=16.0,
    heights=(0.4, 2.5),
)
COURSES = {
    "juggle": Course(),
    "target": Course(
        places=(_LEVEL, _LEVEL, _TARGET),
        ranges=(_WIDE, _WIDE, (0.0, 0.0, 0.0)),
        circle=0.25,
    ),
    "volley": Course(
        places=((_HALF, 0.0, 1.5),),
        ranges=((0.4, 0.4, 0.3),),
        apex=(3.0, 4.5),
        start=(-_HALF, 0.0, 1.2),
        home=(-_HALF, 0.0, 1.5),
        toss=(_HALF, 0.0, 1.5),
        hits=200,
        net=1.55,
    ),
    "volleybots-juggle": _VOLLEYBOTS,
    "volleybots-hit": dataclasses.replace(
        _VOLLEYBOTS,
        places=((-1.0, 0.0, 2.0),),
        ranges=((0.0, 0.0, 0.0),),
        contact=(1.7, 2.5),
        apex=(3.5, 12.0),
        drop=3.0,
        hits=1,
        heights=(0.4, math.inf),
    ),
}


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    hits: int | None = None,
    limit_scale: float = 1.0,
    robot: QuadrotorModel | None = None,
    wind: Sequence[float] | None = None,
    dtype: DTypeLike = jnp.float32,
) -> RallyCase:
    """Draw a batch of random rallies: the first hits of each, with a hovering quadrotor.

    Case k of a suite and `seed` is always the same; the batch has `num` cases from k = `first` >= 0
    on. `ValueError` is raised for an unknown suite or a number out of its range.

    * `suite`: "juggle" by default; `planner_jax.task.rally.spec.SUITES` describes all suites.
    * `hits`: number K of hits to plan, >= 1; by default one hit for each box of the suite.
    * `limit_scale`: factor on the limits of speed, acceleration and body rate.
    * `robot`: quadrotor with a racket, by default the suite's. Suites of other packages define
      their own robot.
    * `wind`: (3,) [m/s], velocity of the air, for a robot with drag.
    """
    suite = suite_named(suite, "juggle")
    require_draw(num, seed, first)
    require_scalar("limit_scale", limit_scale)
    require_scale(limit_scale)
    if suite not in SUITES:
        own = PAPER_HITTER if robot is None else robot
        require_own_robot(own, PAPER_HITTER, suite, wind)
        return TASK.other_suite(suite)(num, seed, first)
    if hits is not None:
        require_size("hits", hits)
    course = COURSES[suite]
    random = np.random.default_rng([seed, zlib.crc32(suite.encode())])
    random.bit_generator.advance(first * _COLUMNS)  # type: ignore[attr-defined]
    uniform = random.random((num, _COLUMNS))
    balls = _tosses if course.drop is None else _drops
    pos, vel, start, attitude = balls(course, uniform)
    index = np.arange(hits or len(course.places)) % len(course.places)
    cases = case(
        pos,
        vel,
        np.asarray(course.places)[index],
        place_range=np.asarray(course.ranges)[index],
        min_contact=course.contact[0],
        max_contact=course.contact[1],
        min_apex=course.apex[0],
        max_apex=course.apex[1],
        home=course.home,
        robot=course.robot if robot is None else robot,
        start=start,
        start_attitude=attitude,
        drag=course.drag,
        gravity=course.gravity,
        wind=wind,
        dtype=floating(dtype),
    )
    return dataclasses.replace(cases, limits=cases.limits.scale(limit_scale, cases.gravity))


def _tosses(course: Course, uniform: np.ndarray) -> tuple:
    """Return balls (N, 3) that have just been tossed up and fall to the robot, and its start."""
    apex = course.apex[0] + uniform[:, 4] * (course.apex[1] - course.apex[0])
    fall = np.sqrt(2.0 * (apex - course.toss[2]) / course.gravity)
    ends = uniform[:, :4].reshape(-1, 2, 2) - 0.5  # x, y of the toss and of the fall
    ends += np.array([course.toss[:2], course.start[:2]])
    top, vel = np.zeros((2, len(uniform), 3))
    top[:, :2], top[:, 2] = ends.mean(axis=1), apex
    vel[:, :2] = (ends[:, 1] - ends[:, 0]) / (2.0 * fall)[:, None]
    return *fly(top, vel, -fall, course.drag, course.gravity), course.start, None


def _drops(course: Course, uniform: np.ndarray) -> tuple:
    """Return balls (N, 3) at rest above robots, with the robots' starts and attitudes."""
    start = np.asarray(course.start) + (2.0 * uniform[:, :3] - 1.0) * course.spread
    angles = np.array([course.tilt, course.tilt, math.pi]) * (2.0 * uniform[:, 3:6] - 1.0)
    attitude = np.roll(Rotation.from_euler("xyz", angles).as_quat(), 1, axis=1)
    return start + np.array([0.0, 0.0, course.drop]), np.zeros_like(start), start, attitude
