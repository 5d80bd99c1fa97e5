"""One serve of a sweep planned by every other planner, for the figure that compares them."""

import pyarrow as pa

from planner_jax.referee.hit import referee_hits
from planner_jax.sweep.columns import RefereedBatch, rows_of
from planner_jax.sweep.source import ServeSource
from planner_jax.task.hit.planners import PLANNERS, planner
from planner_jax.task.solve import plan


def plan_baselines(source: ServeSource, index: int) -> pa.Table | None:
    """Refereed plans of the other planners for one case, solved or not.

    Args:
        source: of the sweep.
        index: place of the case in it.

    Returns:
        The columns of `plans.parquet` behind a column `planner`; None where there is no other.
    """
    serves = source.serves(index, index + 1)
    scenarios = source.scenarios(serves)
    tables = []
    for name in PLANNERS:
        if name == source.settings.planner:
            continue
        plans = plan(planner(name), scenarios)
        verdict = referee_hits(
            scenarios, plans, drag_after_impact=source.settings.drag_after_impact
        )
        rows = rows_of(RefereedBatch(serves, scenarios, plans, verdict))
        tables.append(rows.add_column(0, "planner", pa.array([name])))
    return pa.concat_tables(tables) if tables else None
