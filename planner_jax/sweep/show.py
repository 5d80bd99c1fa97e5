"""`pj.show`: a picture of one plan, for notebooks."""

import io

from jaxtyping import PyTree
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from planner_jax.core.errors import ArgumentError
from planner_jax.core.registry import all_tasks
from planner_jax.runs.style import context
from planner_jax.sweep.sweep import sweep_of

_RULE = "one case of hit, catch, intercept or block"


class PlanFigure(Figure):
    """A figure of Matplotlib that a notebook shows without a plotting backend."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()


def show(case: PyTree, plan: PyTree) -> PlanFigure:
    """Draw one case and its plan: robot, target, and whether the referee accepts the plan.

    Args:
        case: one case of `hit`, `catch`, `intercept` or `block`.
        plan: its plan, solved or not.

    Returns:
        A figure of Matplotlib. A notebook shows it as the last value of a cell; `savefig` writes
        it to a file.

    Raises:
        ArgumentError: the case is a batch, or a case of a task without pictures.
    """
    homes = {task.home: task for task in all_tasks().values()}
    task = homes.get(type(case).__module__.rpartition(".")[0])
    shape = getattr(case, "batch_shape", None)
    if task is None or shape != ():
        batch = f" of batch shape {shape}" if shape else ""
        raise ArgumentError("case", _RULE, shown=f"a {type(case).__name__}{batch}")
    drawn = sweep_of(task).pictures(case, plan, task.judge(case, plan), "plan")
    if not drawn:
        raise ArgumentError("case", _RULE, shown=f"a case of {task.name}")
    with context():
        figure = PlanFigure(figsize=drawn[0].size)
        FigureCanvasAgg(figure)
        drawn[0].draw(figure)
    return figure
