"""Shared parts of all benchmarks: arguments, printed output, and the run folder.

A run of a benchmark writes a run folder with the following files:
* manifest.json: the name of the benchmark as "bench NAME", whether the run is complete, its
  arguments, the versions of packages, device, commit and times, and a summary;
* table.md: the printed lines;
* rows.json: the rows of the benchmark's tables, if it has any.

The summary has at least two numbers. `num` is the number of plans that were judged, usually by the
referee, an independent check in float64. `success_rate` is the share of these plans that were
accepted. Many benchmarks also compare the costs of plans with the costs of a longer search. Then
the summary has the median, 90 % and 99 % quantile of cost / best cost - 1.
"""

import argparse
import contextlib
import datetime
import json
import os
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from planner_jax.benchmarks.cost_gap import gap_figures
from planner_jax.core.errors import ArgumentError
from planner_jax.host.files import name_run_folder
from planner_jax.runs.environment import environment
from planner_jax.runs.run_folder import RunFolder


def argument_parser(name: str, doc: str | None, **counts: int) -> argparse.ArgumentParser:
    """Build the command-line parser of a benchmark.

    Args:
        name: name of the benchmark's module.
        doc: docstring of the module, whose first line describes the program.
        **counts: names of integer options with their defaults. Values must be at least 1, or at
            least 0 for the option `seed` and if the default is 0. The option --out for the run
            folder is added, too.
    """
    head, _, _ = (doc or "").partition("\n")
    parser = argparse.ArgumentParser(f"python -m benchmarks.{name}", description=head)
    for count, default in counts.items():
        kind = at_least(0 if count == "seed" else min(default, 1))
        parser.add_argument(f"--{count}", type=kind, default=default, help=f"default: {default}")
    parser.add_argument("--out", type=Path, help=f"default: runs/bench-{name}-DATE-TIME")
    parser.set_defaults(benchmark=name)
    return parser


def at_least(least: int) -> Callable[[str], int]:
    """Return a function that parses an integer argument and rejects values below `least`."""

    def integer(text: str) -> int:
        if (value := int(text)) < least:
            raise argparse.ArgumentTypeError(f"must be >= {least}, got {value}")
        return value

    return integer


def parse_names(
    parser: argparse.ArgumentParser, flag: str, text: str, known: Iterable[str]
) -> list:
    """Split the text of a comma-separated argument into names.

    The program exits with an error if a name is not in `known`. `flag` is the argument's name in
    the error message.
    """
    for name in (names := text.split(",")):
        if name not in known:
            parser.error(f"argument {flag}: must be among {', '.join(known)}, got {name!r}")
    return names


def begin(parser: argparse.ArgumentParser, options: argparse.Namespace) -> "Bench":
    """Create the run of a benchmark with parsed arguments.

    The program exits with an error if the run folder cannot be created.
    """
    given = {name: value for name, value in vars(options).items() if name != "benchmark"}
    try:
        return Bench(options.benchmark, given, given.pop("out"))
    except ArgumentError as error:
        parser.error(f"argument --{error}")


class Bench:
    """One run of a benchmark: a context manager that creates the run folder on entry.

    JAX is not started before entry, so that a benchmark can start other processes first.

    Args:
        name: name of the benchmark.
        parameters: arguments of the benchmark, which are stored in the manifest.
        out: run folder, new or empty; None for runs/bench-NAME-DATE-TIME.

    Raises:
        ArgumentError: the folder cannot be created or is not empty.
    """

    def __init__(self, name: str, parameters: Mapping[str, Any], out: Any = None):
        now = datetime.datetime.now().astimezone()
        self._folder = RunFolder(out or name_run_folder(f"bench-{name}"))
        self._folder.require_new()
        self.path = self._folder.path
        what = {"kind": f"bench {name}", "state": "running", "parameters": plain(parameters)}
        self._manifest = {**what, "started": now.isoformat(timespec="seconds")}
        self._began, self._lines, self._rows = time.perf_counter(), [], []
        self._accepted, self._gaps, self._figures = [], [], {}

    def __enter__(self) -> Self:
        self._manifest |= environment()
        self._owning = contextlib.ExitStack()
        self._owning.enter_context(self._folder.create(self._manifest))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        accepted = np.array(self._accepted)
        rate = accepted.mean() if accepted.size else None
        summary = {"num": accepted.size, "success_rate": rate, **self._figures}
        summary |= gap_figures(*self._gaps) if self._gaps else {}
        times = {"seconds": time.perf_counter() - self._began, "load_average": os.getloadavg()[0]}
        self._folder.write_text("table.md", "\n".join(self._lines) + "\n")
        self._manifest |= {"state": "failed" if kind else "complete", "times": times}
        self._folder.write_manifest({**self._manifest, "summary": plain(summary)})
        self._owning.close()

    def say(self, *lines: str) -> None:
        """Print lines, and store them for the file table.md of the run folder."""
        print("\n".join(lines), flush=True)
        self._lines += lines

    def row(self, **figures: Any) -> None:
        """Add a row of named numbers or texts to the file rows.json of the run folder."""
        self._rows.append(plain(figures))
        self._folder.write_text("rows.json", json.dumps(self._rows, indent=1) + "\n")

    def count(self, accepted: Any, *gaps: np.ndarray | None) -> None:
        """Add plans to the numbers of the run's summary: success rate and excess costs.

        Args:
            accepted: (B,) bool, whether the referee, an independent check, accepts each of B plans.
            *gaps: arrays of cost / best cost - 1 of these plans, where a longer search finds the
                best cost; None if the planner minimises no cost.
        """
        self._accepted += np.asarray(accepted, bool).tolist()
        self._gaps += gaps

    def note(self, **figures: Any) -> None:
        """Add named numbers of the benchmark to the summary in manifest.json."""
        self._figures |= figures


def plain(value: Any) -> Any:
    """Convert a value to JSON types: arrays to lists, paths to text, NaN and infinity to null."""
    text = json.dumps(value, default=lambda x: x.tolist() if hasattr(x, "tolist") else str(x))
    return json.loads(text, parse_constant=lambda _: None)
