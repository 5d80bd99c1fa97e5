"""Pictures of one case that was asked for alone, by the figures of its task's runs."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from planner_jax.core.registry import Task
from planner_jax.runs.columns import RefereedBatch, rows_of
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.source import Chunk
from planner_jax.runs.style import draw
from planner_jax.sweep.report import RunRows
from planner_jax.sweep.single import Answer
from planner_jax.sweep.sweep import sweep_of


@dataclasses.dataclass(frozen=True)
class OneRow(RunRows):
    """A case that is of no run, as the figures of runs look at one."""

    row: dict[str, Any]

    def same_case(self) -> list[tuple[str, dict[str, Any]]]:
        """Planner and row."""
        return [(self.manifest["parameters"]["planner"], self.row)]


def write_pictures(task: Task, planner: str, answer: Answer, out: Path) -> list[Path]:
    """Draw a case, and write the pictures into a folder; their paths.

    Args:
        task: of the case.
        planner: its name.
        answer: the case, its plan and verdict.
        out: folder.
    """
    sweep = sweep_of(task)
    case, plan = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (answer.case, answer.plan))
    verdict = dataclasses.replace(
        answer.verdict,
        **{
            field.name: np.asarray(getattr(answer.verdict, field.name))[None]
            for field in dataclasses.fields(answer.verdict)
        },
    )
    batch = RefereedBatch(Chunk(np.zeros(1, int), case), plan, verdict)
    (row,) = rows_of(sweep.single_columns(), batch, sweep.frame).to_pylist()
    manifest = {"parameters": {"planner": planner}, "setting": sweep.setting(case)}
    run = OneRow(RunFolder(out), manifest, [], row)
    for figure in sweep.single_figures:
        draw(out / figure.name, figure.draw, figure.size, run)
    return [out / figure.name for figure in sweep.single_figures]
