"""One case of a sweep planned by every other planner, for the figure that compares them."""

import pyarrow as pa

from planner_jax.sweep.columns import RefereedBatch, rows_of
from planner_jax.sweep.source import Source
from planner_jax.sweep.task import SweepTask


def plan_baselines(task: SweepTask, source: Source, index: int) -> pa.Table | None:
    """Refereed plans of the other planners for one case, solved or not.

    Args:
        task: of the sweep.
        source: of the sweep.
        index: place of the case in it.

    Returns:
        The columns of `plans.parquet` behind a column `planner`; None where there is no other.
    """
    cases, settings = source.cases(index, index + 1), source.settings
    tables = []
    for name in task.planners:
        if name == settings.planner:
            continue
        scenarios, plans = task.plan(task.planner(name, {}), cases.scenarios, settings)
        verdict = task.judge(scenarios, plans, settings)
        batch = RefereedBatch(cases, scenarios, plans, verdict)
        rows = rows_of(task.columns, batch, task.frame)
        tables.append(rows.add_column(0, "planner", pa.array([name])))
    return pa.concat_tables(tables) if tables else None
