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
    * `insat`: that A* interleaved with B-splines, Algorithm 2 of [Natarajan2024]; on the host.

    Arguments and errors are those of `pj.hit.planner`; the options are fields of `OnlineBlock`,
    `LibraryBlock`, `AdaptBlock`, `DirectBlock`, `RrtConnectBlock`, `EpaseBlock` or `InsatBlock`.
    """
    return TASK.make_planner(name, options)


def judge(cases: BlockCase, plans: BlockPlan, **settings: object) -> BlockVerdict:
    """Judge one plan, or a batch, by kinematics and geometry alone.

    Arguments, result and errors are those of `pj.hit.judge`; `referee_blocks` has the settings.
    """
    return judge_by(referee_blocks, cases, plans, (BlockCase, BlockPlan), settings)
