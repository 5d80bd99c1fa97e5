"""Serves of a hit sweep, drawn or read."""

import dataclasses
import hashlib

import jax
import numpy as np
from jaxtyping import PyTree

from planner_jax.core.choices import require_one_of
from planner_jax.core.errors import ArgumentError, CaseError
from planner_jax.runs.manifest import Entries
from planner_jax.runs.source import Chunk, Source, filled_in
from planner_jax.sweep.hit.settings import HitSettings
from planner_jax.task.hit.court import check_cases
from planner_jax.task.hit.spec import REAL_SCENARIOS, TASK
from planner_jax.task.hit.suites import Serves, generate_serves, read_serves, to_cases


@dataclasses.dataclass(frozen=True)
class ServeSource(Source):
    """Where the serves of a sweep come from; they are the origin of its cases."""

    settings: HitSettings
    folder: Serves | None  # the serves of the published files, if these were asked for

    def cases(self, first: int, last: int) -> Chunk:
        """As `Source.cases`; a ball that is down before planning begins breaks a rule, too."""
        settings = self.settings
        if self.folder is not None:
            serves = self.folder[first:last]
        else:
            scenarios = REAL_SCENARIOS.get(str(settings.suite))
            serves = generate_serves(last - first, settings.seed, scenarios, first=first)
        try:
            cases = to_cases(serves, seed=settings.seed, **settings.draw_options())
            check_cases(cases)
        except CaseError as error:
            raise ArgumentError("serves", f"sound cases: {error}", verb="make", shown="") from error
        return Chunk(serves.index, jax.tree.map(np.asarray, cases), serves)

    def check(self) -> PyTree:
        """Look at every serve of a folder; drawn ones obey their law."""
        cases = super().check()
        for chunk in range(1, 1 if self.folder is None else self.num_chunks):
            self.chunk(chunk)
        return cases

    def description(self) -> Entries:
        """Return source, number of distinct serves and digest of their numbers."""
        if self.folder is None:
            return {"serves": {"source": "generated", "distinct": self.num, "sha256": None}}
        used = self.folder[: self.num]
        balls = np.column_stack([used.position, used.velocity])
        digest = hashlib.sha256(np.column_stack([balls, used.target]).tobytes()).hexdigest()
        distinct = len(np.unique(balls, axis=0))
        known = {"source": self.settings.serves, "distinct": distinct, "sha256": digest}
        return {"serves": known}


def open_source(settings: HitSettings, batch: int) -> ServeSource:
    """As `Sweep.open_source`; a folder is read and checked whole.

    Raises:
        ArgumentError: the suite is of another package, the folder is missing, a row is not sound,
            or too few serves are in it.
    """
    require_one_of(TASK.suites, "suite", str(settings.suite))  # others know no serves
    folder = None if settings.serves is None else read_serves(settings.serves)
    if folder is not None and (settings.num or 0) > len(folder):
        rule = f"<= {len(folder)}, the serves that the folder holds"
        raise ArgumentError("num", rule, settings.num)
    fields = filled_in(settings, settings.DEFAULT_NUM if folder is None else len(folder), batch)
    return ServeSource(**fields, folder=folder)
