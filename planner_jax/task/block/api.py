"""The public functions `planner` and `judge` of the task `pj.block`."""

from planner_jax.core.planner import Planner
from planner_jax.referee.block import BlockVerdict, referee_blocks
from planner_jax.task.arguments import judge_by
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.spec import TASK


def planner(
    name: str = "online", *, effort: str = "feasible", **options: object
) -> Planner[BlockCase, BlockPlan]:
    """Make a planner of blocks by its name.

    An end pose is a pose of the arm in which the shield meets the ball.

    * `online`: a straight motion in joint space if one is free of collisions. Otherwise least
      squares find end pose, time of contact and motion together, from several starting points. The
      arm moves until the contact. The cost is the root mean square of the joints' accelerations,
      each divided by its limit, so that motions need little torque.
    * `brisk`: motions from standstill to standstill, as fast as the limits allow. The arm then
      waits for the ball, and needs more torque than by `online`. The cost is the duration [s].
    * `library:FILE`: a motion that is stored in a file of `planner-jax library build`. The faces of
      two boxes around the arm are divided into cells, and the file has a motion for each pair of
      an outer and an inner cell through which a ball can fly.
    * `direct`: each joint moves as fast as its limits allow, to the end pose that is reached first
      without a collision.
    * `rrt-connect`, `epase`: a path by OMPL's RRT-Connect, or by ePA*SE over steps of the joints,
      to one end pose after another. TOPP-RA sets the speed along the path. Both run on the host and
      need the extra `arm-peers`.
    * `insat`, `pinsat`: a weighted A* or ePA*SE over steps of the joints, interleaved with the
      optimisation of B-splines [Natarajan2024, Algorithm 2]. The search runs on the host. `pinsat`
      optimises the splines of up to `width` states in one call, and is meant for GPUs.

    Planners of other packages are also found by name.

    Args:
        name: name of the planner, as listed above.
        effort: "feasible" ends with the first plan that keeps every limit. "good" and "best"
            compare more motions of `online` or `brisk`, for plans of less cost.
        options: fields of the planner's class: `OnlineBlock`, `LibraryBlock`,
            `DirectBlock`, `RrtConnectBlock`, `EpaseBlock`, `InsatBlock` or `PinsatBlock`.

    Raises:
        ValueError: no planner has the requested name, or it does not support the effort.
        TypeError: an option is unknown.
        ModuleNotFoundError: an extra is missing.
    """
    return TASK.make_planner(name, options).with_effort(effort)


def judge(cases: BlockCase, plans: BlockPlan, **settings: object) -> BlockVerdict:
    """Judge one plan, or a batch, by collisions of the arm and the shield's contact with the ball.

    The verdict has the batch shape of the cases: `success`, reasons by `sentence(k)`, and measured
    quantities. The settings are keyword arguments of `referee_blocks`. `TypeError` is raised for
    cases of other tasks, `ValueError` for different batch shapes or invalid settings.
    """
    return judge_by(referee_blocks, cases, plans, (BlockCase, BlockPlan), settings)
