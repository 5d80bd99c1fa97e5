"""`pj.show`: a picture of one plan, for notebooks."""

import io

from jaxtyping import PyTree
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from planner_jax.core.errors import ArgumentError
from planner_jax.core.tasks import all_tasks
from planner_jax.runs.style import context
from planner_jax.sweep.sweep import Picture, sweep_of
from planner_jax.task.block.drawing import SIZE, draw_motion
from planner_jax.task.reach.api import judge
from planner_jax.task.reach.case import ReachCase

_RULE = "one case of hit, catch, intercept, group, block or reach"


class PlanFigure(Figure):
    """A figure of Matplotlib that a notebook shows without a plotting backend."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()


def show(case: PyTree, plan: PyTree) -> PlanFigure:
    """Draw one case and its plan: robot, target, and whether the referee accepts the plan.

    Args:
        case: one case of `hit`, `catch`, `intercept`, `group`, `block` or `reach`.
        plan: its plan, solved or not.

    Returns:
        A figure of Matplotlib. A notebook shows it as the last value of a cell; `savefig` writes
        it to a file.

    Raises:
        ArgumentError: the case is a batch, or a case of a task without pictures.
    """
    home, shape = type(case).__module__.rpartition(".")[0], getattr(case, "batch_shape", None)
    task = {task.home: task for task in all_tasks().values()}.get(home)
    drawn: list[Picture] = []
    if shape == () and isinstance(case, ReachCase):
        parts = judge(case, plan), case.arm, case.limits, case.scene, plan.motion
        drawn.append(Picture("reach.png", SIZE, lambda figure: draw_motion(figure, *parts)))
    elif shape == () and task is not None:
        drawn += sweep_of(task).pictures(case, plan, task.judge(case, plan), "plan")
    if not drawn:
        batch = f" of batch shape {shape}" if shape else ""
        raise ArgumentError("case", _RULE, shown=f"a {type(case).__name__}{batch}")
    with context():
        figure = PlanFigure(figsize=drawn[0].size)
        FigureCanvasAgg(figure)
        drawn[0].draw(figure)
    return figure
