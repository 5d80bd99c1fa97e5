"""The words of the task: `pj.block.draw`, `planner` and `judge`; `case` stands beside."""

import jax.numpy as jnp
from jax.typing import DTypeLike

from planner_jax.core.planner import Planner
from planner_jax.core.registry import suite_named
from planner_jax.referee.block import BlockVerdict, referee_blocks
from planner_jax.task.arguments import judge_by
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.spec import SUITES, TASK
from planner_jax.task.block.suites import draw_cases


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
    """Draw throws as a batch of cases.

    Args:
        num: how many, >= 1.
        suite: "pole", the default, "open" or "short"; or one that another package offers.
        seed: >= 0. Throw k of a suite and seed is always the same one.
        first: place of the first one, >= 0.
        regime: "R1", "R2" or "R3"; see `case`.
        wide: whether balls may be met off the shield's middle and aslant; see `case`.
        anywhere: whether any place on the shield will do, at any angle.
        delay: [s], until the arm may start.
        dtype: of every floating leaf.

    Raises:
        ValueError: an argument is out of its range, or there is no such suite.
    """
    suite = suite_named(suite, "pole")
    if suite not in SUITES:
        return TASK.other_suite(suite)(num, seed, first)
    return draw_cases(
        suite,
        num,
        seed,
        first,
        regime=regime,
        wide=wide,
        anywhere=anywhere,
        delay=delay,
        dtype=dtype,
    )


def planner(name: str = "online", **options: object) -> Planner[BlockCase, BlockPlan]:
    """Return the block planner of a name, with some of its fields set.

    * `library:FILE`: the motion that a file of `planner-jax library build` has for the two cells
      through which the ball comes.
    * `adapt:FILE`: motions of that file warped to the very ball, then least squares from these.
    * `online`: a straight motion of the joints if one is free, else end pose, time of contact and
      motion together, by least squares from many starts.
    * `brisk`: as `online`, but of motions from rest to rest the quickest; the arm then stands and
      waits for the ball, at the price of torque.
    * `direct`: all joints as fast as they may turn, to the end pose that is reached soonest of
      those to which that touches nothing.
    * `rrt-connect`, `epase`: ways by OMPL's RRT-Connect, or by a weighted A* over steps of the
      joints, to one end pose after another, timed by TOPP-RA; on the host, with the extra
      `arm-peers`.
    * `insat`: that A* interleaved with B-splines, Algorithm 2 of paper 004; on the host.

    Args:
        name: one of these, or one that another package offers.
        **options: fields of that planner's dataclass, for example `points` of `online`.

    Returns:
        A planner for `pj.plan`: `OnlineBlock`, `LibraryBlock`, `AdaptBlock`, `DirectBlock`,
        `RrtConnectBlock`, `EpaseBlock` or `InsatBlock`.

    Raises:
        ValueError: there is no planner of that name.
        TypeError: the planner has no such field.
        ModuleNotFoundError: the planner needs an extra that is not installed.
    """
    return TASK.make_planner(name, options)


def judge(cases: BlockCase, plans: BlockPlan, **settings: object) -> BlockVerdict:
    """Judge one plan, or a batch: kinematics and geometry alone decide.

    Args:
        cases: one case, or a batch.
        plans: of them.
        **settings: such as `tolerance`; see `referee_blocks`.

    Returns:
        A verdict with the batch shape of the cases: `success`, `sentence(k)`, and what was
        measured.

    Raises:
        TypeError: the cases or plans are not blocks.
        ValueError: shapes that do not fit, or a setting out of its range.
    """
    return judge_by(referee_blocks, cases, plans, (BlockCase, BlockPlan), settings)
