"""Scenarios of a catch sweep, drawn from a suite."""

import dataclasses
import hashlib
from typing import Any

import jax
import numpy as np

from planner_jax.sweep.catch.settings import CatchSweep
from planner_jax.sweep.source import Cases, Source, filled_in
from planner_jax.task.catch.scenario import CatchScenario
from planner_jax.task.catch.suites import make_suite


@dataclasses.dataclass(frozen=True)
class SuiteSource(Source):
    """The scenarios of a suite, all of them in memory."""

    settings: CatchSweep
    scenarios: CatchScenario  # (num, ...) NumPy leaves

    def cases(self, first: int, last: int) -> Cases:
        """The cases from place `first` up to `last`, that one left out."""
        picked = jax.tree.map(lambda leaf: leaf[first:last], self.scenarios)
        return Cases(index=np.arange(first, last), scenarios=picked)

    def description(self) -> dict[str, Any]:
        """Suite, its number of targets, and digest of all numbers."""
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves(self.scenarios):
            digest.update(np.ascontiguousarray(leaf).tobytes())
        suite = {
            "name": self.settings.suite,
            "num_targets": self.scenarios.num_targets,
            "sha256": digest.hexdigest(),
        }
        return {"suite": suite}


def open_source(settings: CatchSweep, batch: int) -> SuiteSource:
    """The source of a sweep's scenarios, drawn whole.

    Args:
        settings: of the sweep.
        batch: cases a chunk, where the settings name none.
    """
    fields = filled_in(settings, settings.DEFAULT_NUM, batch)
    scenarios = make_suite(settings.suite, fields["num"], settings.seed)
    scenarios = _scaled(jax.tree.map(np.asarray, scenarios), settings.limit_scale)
    return SuiteSource(**fields, scenarios=scenarios)


def _scaled(scenarios: CatchScenario, scale: float) -> CatchScenario:
    """Scenarios with other limits of speed, body rate and thrust."""
    limits, hover = scenarios.limits, scenarios.gravity
    least = np.maximum(hover + scale * (limits.min_thrust - hover), 0.0)
    scaled = dataclasses.replace(
        limits,
        speed=scale * limits.speed,
        body_rate=scale * limits.body_rate,
        min_thrust=least,
        max_thrust=hover + scale * (limits.max_thrust - hover),
    )
    return dataclasses.replace(scenarios, limits=scaled)
