"""The functions `pj.block.planner` and `judge`; `case` and `draw` are in modules of their own."""

from planner_jax.core.planner import Planner
from planner_jax.referee.block import BlockVerdict, referee_blocks
from planner_jax.task.arguments import judge_by
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.spec import TASK


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
