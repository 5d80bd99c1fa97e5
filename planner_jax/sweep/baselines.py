"""One case of a sweep planned by every other planner, for the figure that compares them."""

from typing import Any

import pyarrow as pa

from planner_jax.sweep.columns import RefereedBatch, rows_of
from planner_jax.sweep.source import Source
from planner_jax.sweep.sweep import Sweep


def plan_baselines(sweep: Sweep, source: Source, planners: dict[str, Any], index: int) -> pa.Table:
    """Refereed plans of other planners for one case, solved or not.

    Args:
        sweep: of the run.
        source: of its cases.
        planners: by name, one or more.
        index: place of the case in the run.

    Returns:
        The columns of `plans.parquet` behind a column `planner`.
    """
    chunk, tables = source.cases(index, index + 1), []
    for name, planner in planners.items():
        plans = sweep.plan(planner, chunk.cases)
        verdict = sweep.judge(chunk.cases, plans, source.settings)
        batch = RefereedBatch(chunk, plans, verdict)
        rows = rows_of(sweep.columns(batch), batch, sweep.frame)
        tables.append(rows.add_column(0, "planner", pa.array([name])))
    return pa.concat_tables(tables)
