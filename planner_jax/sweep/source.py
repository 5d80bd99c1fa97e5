"""Serves of a sweep, chunk by chunk, drawn or read."""

import dataclasses
import hashlib
from typing import Any

import numpy as np

from planner_jax.sweep.settings import DEFAULT_NUM, HitSweep, SettingError
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.task.hit.serves import Serves, generate_serves, read_serves, to_scenarios
from planner_jax.task.hit.validate import ScenarioError, ServeError, check_scenarios


@dataclasses.dataclass(frozen=True)
class ServeSource:
    """Where the serves of a sweep come from."""

    settings: HitSweep  # with `num` and `batch` filled in
    num: int  # of all cases
    batch: int  # cases a chunk
    folder: Serves | None  # the serves of the published files, if these were asked for

    @property
    def num_chunks(self) -> int:
        """How many chunks the sweep has; the last one may be smaller."""
        return -(-self.num // self.batch)

    def chunk(self, number: int) -> Serves:
        """The serves of one chunk."""
        return self.serves(number * self.batch, min((number + 1) * self.batch, self.num))

    def serves(self, first: int, last: int) -> Serves:
        """The serves from place `first` up to `last`, that one left out."""
        if self.folder is not None:
            return self.folder[first:last]
        return generate_serves(last - first, self.settings.seed, start=first)

    def scenarios(self, serves: Serves) -> HitScenario:
        """The scenarios of some serves, checked.

        Raises:
            SettingError: a ball is down before planning begins, or a value of a scenario breaks
                a rule.
        """
        try:
            scenarios = to_scenarios(
                serves,
                start=self.settings.start,
                seed=self.settings.seed,
                delay=self.settings.delay,
                limit_scale=self.settings.limit_scale,
            )
            check_scenarios(scenarios)
        except ServeError as error:
            raise SettingError(str(error)) from error
        except ScenarioError as error:
            raise SettingError(f"serves must make sound scenarios: {error}") from error
        return scenarios

    def description(self) -> dict[str, Any]:
        """Source, number of distinct serves and digest of their numbers, for the manifest."""
        if self.folder is None:
            return {"source": "generated", "distinct": self.num, "sha256": None}
        used = self.folder[: self.num]
        balls = np.column_stack([used.position, used.velocity])
        digest = hashlib.sha256(np.column_stack([balls, used.target]).tobytes())
        return {
            "source": self.settings.serves,
            "distinct": len(np.unique(balls, axis=0)),
            "sha256": digest.hexdigest(),
        }


def open_source(settings: HitSweep, batch: int) -> ServeSource:
    """The source of a sweep's serves; a folder is read and checked whole.

    Args:
        settings: of the sweep.
        batch: cases a chunk, where the settings name none.

    Raises:
        SettingError: the folder is missing, a row of it is not sound, or more serves are asked
            for than it holds.
    """
    try:
        folder = None if settings.serves is None else read_serves(settings.serves)
    except ServeError as error:
        raise SettingError(str(error)) from error
    held = DEFAULT_NUM if folder is None else len(folder)
    num = settings.num or held
    if folder is not None and num > held:
        raise SettingError(f"num must be <= {held}, the serves that the folder holds, got {num}")
    batch = settings.batch or batch
    resolved = dataclasses.replace(settings, num=num, batch=batch)
    return ServeSource(settings=resolved, num=num, batch=batch, folder=folder)
