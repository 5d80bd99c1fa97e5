"""Sources of a sweep's cases (planning problems), which they draw or read batch by batch."""

import abc
import dataclasses
import hashlib

import jax
import numpy as np
from jaxtyping import PyTree

from planner_jax.core.choices import require
from planner_jax.core.registry import Task
from planner_jax.core.room import require_memory
from planner_jax.runs.manifest import Entries
from planner_jax.runs.settings import SweepSettings

_MOST_PARTS = 10**6  # greatest number of chunks (blocks of cases) in a run; each gets its own file


@dataclasses.dataclass(frozen=True)
class Chunk:
    """B consecutive cases of a sweep, which are planned, judged and stored together."""

    index: np.ndarray  # (B,) int, indices of the cases in the sweep
    cases: PyTree  # cases of the task's class, NumPy leaves (B, ...)
    origin: object = None  # data from which the cases were made, such as the serves of hits

    def __len__(self) -> int:
        return len(self.index)


@dataclasses.dataclass(frozen=True)
class Source(abc.ABC):
    """A source of the cases of a sweep; subclasses draw the cases or read them from files."""

    settings: SweepSettings  # settings of the sweep, in which `num` and `batch` are not None
    num: int  # number of all cases
    batch: int  # number of cases of a chunk

    @property
    def num_chunks(self) -> int:
        """Number of chunks of cases in the sweep; the last chunk may be smaller."""
        return -(-self.num // self.batch)

    def chunk(self, number: int) -> Chunk:
        """Return the cases of chunk `number`; raise `ArgumentError` if a case is invalid."""
        return self.cases(number * self.batch, min((number + 1) * self.batch, self.num))

    def check(self) -> PyTree:
        """Return the first `batch` cases, so that invalid cases raise before a run writes files."""
        return self.chunk(0).cases

    @abc.abstractmethod
    def cases(self, first: int, last: int) -> Chunk:
        """Return cases `first` to `last - 1`; raise `ArgumentError` if a case is invalid."""

    @abc.abstractmethod
    def description(self) -> Entries:
        """Return entries of the manifest that identify the cases when the run is resumed."""


@dataclasses.dataclass(frozen=True)
class DrawnSource(Source):
    """A source that draws the cases of a suite (a family of cases) from a seed, in chunks."""

    task: Task

    def cases(self, first: int, last: int) -> Chunk:
        """Draw the cases with indices `first` to `last - 1` of the suite."""
        suite, seed, options = self.settings.suite, self.settings.seed, self.settings.draw_options()
        drawn = self.task.draw(last - first, suite, seed, first=first, **options)
        return Chunk(index=np.arange(first, last), cases=jax.tree.map(np.asarray, drawn))

    def description(self) -> Entries:
        """Return the suite's name and the SHA-256 of the first chunk's cases, for the manifest."""
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves(self.chunk(0).cases):
            digest.update(np.ascontiguousarray(leaf).tobytes())
        return {"suite": {"name": self.settings.suite, "sha256": digest.hexdigest()}}


def fill_in(settings: SweepSettings, num: int, batch: int) -> Entries:
    """Return a `Source`'s keyword arguments; `num` and `batch` replace settings that are None."""
    num, batch = settings.num or num, settings.batch or batch
    rule = f"at most {_MOST_PARTS * batch:,} with a batch of {batch}, as each batch is a file"
    require(num <= _MOST_PARTS * batch, "num", rule, num)
    name, size = ("num", min(num, batch)) if settings.batch is None else ("batch", batch)
    require_memory(name, size, settings.case_bytes)
    resolved = dataclasses.replace(settings, num=num, batch=batch)
    return {"settings": resolved, "num": num, "batch": batch}
