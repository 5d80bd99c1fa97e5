"""The functions `pj.block.draw`, `planner` and `judge`; `case` is in a module of its own."""

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

    The suite is "pole" by default, "open", "short", or one that another package offers. `regime`,
    `wide`, `anywhere` and `delay` [s] are those of `case`; the other arguments and the errors are
    those of `pj.hit.draw`.
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
    """Judge one plan, or a batch, by kinematics and geometry alone, as `pj.hit.judge` does.

    Args:
        cases: one case, or a batch.
        plans: of the cases.
        **settings: such as `tolerance`; see `referee_blocks`.
    """
    return judge_by(referee_blocks, cases, plans, (BlockCase, BlockPlan), settings)
