"""The functions `pj.block.planner` and `judge`; `case` and `draw` are in modules of their own."""

from planner_jax.core.planner import Planner
from planner_jax.referee.block import BlockVerdict, referee_blocks
from planner_jax.task.arguments import judge_by
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.spec import TASK


def planner(name: str = "online", **options: object) -> Planner[BlockCase, BlockPlan]:
    """Return a block planner by its name.

    * `library:FILE`: the motion that a file of `planner-jax library build` has for the two cells
      through which the ball enters the boxes.
    * `adapt:FILE`: motions of that file, warped to the ball, then refined by least squares.
    * `online`: a straight motion of the joints if one is free of collisions, else least squares
      for end pose, time of contact and motion together, from several starts.
    * `brisk`: the motions of `online` from rest to rest, as fast as limits allow; the arm waits for
      the ball at standstill. Needs more torque.
    * `direct`: each joint as fast as its limits allow, to the end pose that is reached soonest
      without a collision.
    * `rrt-connect`, `epase`: paths by OMPL's RRT-Connect, or by a weighted A* over steps of the
      joints, to one end pose after another, timed by TOPP-RA; on the host, extra `arm-peers`.
    * `insat`: that A* interleaved with B-splines [Natarajan2024, Algorithm 2]; on the host.

    See `pj.hit.planner` for arguments and errors. The options are fields of `OnlineBlock`,
    `LibraryBlock`, `AdaptBlock`, `DirectBlock`, `RrtConnectBlock`, `EpaseBlock` or `InsatBlock`.
    """
    return TASK.make_planner(name, options)


def judge(cases: BlockCase, plans: BlockPlan, **settings: object) -> BlockVerdict:
    """Judge one plan, or a batch, by kinematics and geometry alone.

    See `pj.hit.judge` for arguments, result and errors, and `referee_blocks` for the settings.
    """
    return judge_by(referee_blocks, cases, plans, (BlockCase, BlockPlan), settings)
