"""What all benchmarks share: arguments, what is printed, and the folder that a run writes.

The folder holds manifest.json (kind "bench NAME", state, parameters, versions, device, commit,
times, summary), table.md with what was printed and, where there are rows, rows.json. Every summary
has `num`, the plans that were judged, and `success_rate`; where a speed is measured also the
median, the 90 and the 99 % quantile of `cost_gaps`.
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
from planner_jax.runs.environment import environment
from planner_jax.runs.run_folder import RunFolder


def argument_parser(name: str, doc: str | None, **counts: int) -> argparse.ArgumentParser:
    """A parser of a benchmark with --out and some counts, by name with their defaults."""
    head, _, _ = (doc or "").partition("\n")
    parser = argparse.ArgumentParser(f"python -m benchmarks.{name}", description=head)
    for count, default in counts.items():
        kind = at_least(0 if count == "seed" else 1)
        parser.add_argument(f"--{count}", type=kind, default=default, help=f"default: {default}")
    parser.add_argument("--out", type=Path, help=f"default: runs/bench-{name}-DATE-TIME")
    parser.set_defaults(benchmark=name)
    return parser


def at_least(least: int) -> Callable[[str], int]:
    """What reads an integer argument that must not be smaller."""

    def integer(text: str) -> int:
        if (value := int(text)) < least:
            raise argparse.ArgumentTypeError(f"must be >= {least}, got {value}")
        return value

    return integer


def chosen(parser: argparse.ArgumentParser, flag: str, text: str, known: Iterable[str]) -> list:
    """The names in a comma-separated argument; an unknown one ends the program with a line."""
    for name in (names := text.split(",")):
        if name not in known:
            parser.error(f"argument {flag}: must be among {', '.join(known)}, got {name!r}")
    return names


def begin(parser: argparse.ArgumentParser, options: argparse.Namespace) -> "Bench":
    """The run of parsed arguments; a folder that cannot be written ends the program with a line."""
    given = {name: value for name, value in vars(options).items() if name != "benchmark"}
    try:
        return Bench(options.benchmark, given, given.pop("out"))
    except ArgumentError as error:
        parser.error(f"argument --{error}")


class Bench:
    """One run; its folder is made where its block begins, and JAX is not started before.

    Raises `ArgumentError` unless `out` (None: runs/bench-NAME-DATE-TIME) can be a new folder.
    """

    def __init__(self, name: str, parameters: Mapping[str, Any], out: Any = None):
        now = datetime.datetime.now().astimezone()
        self._folder = RunFolder(out or Path("runs", f"bench-{name}-{now:%Y%m%d-%H%M%S}"))
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
        """Print lines, and keep them for table.md."""
        print("\n".join(lines), flush=True)
        self._lines += lines

    def row(self, **figures: Any) -> None:
        """Add a row to rows.json."""
        self._rows.append(plain(figures))
        self._folder.write_text("rows.json", json.dumps(self._rows, indent=1) + "\n")

    def count(self, accepted: Any, *gaps: np.ndarray | None) -> None:
        """Add plans to the summary: which the referee accepts, and their `cost_gaps` if asked."""
        self._accepted += np.asarray(accepted, bool).tolist()
        self._gaps += gaps

    def note(self, **figures: Any) -> None:
        """Add figures of the benchmark's own to the summary."""
        self._figures |= figures


def plain(value: Any) -> Any:
    """A value as JSON has it: arrays are lists, paths are text, what is not finite is null."""
    text = json.dumps(value, default=lambda x: x.tolist() if hasattr(x, "tolist") else str(x))
    return json.loads(text, parse_constant=lambda _: None)
