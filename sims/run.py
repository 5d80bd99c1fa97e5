"""Runs of simulated flights: simulate all cases, and write results and report to a folder."""

import dataclasses
import datetime
import html
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.host import signals as stopping
from planner_jax.runs.columns import (
    BOOL,
    COUNT,
    INDEX,
    NUMBER,
    Column,
    leaves_of,
    rows_of,
    status_column,
)
from planner_jax.runs.columns import RefereedBatch as FlownBatch
from planner_jax.runs.dataset import Dataset
from planner_jax.runs.environment import environment, require_backend
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.settings import settings_of_manifest
from planner_jax.runs.source import Chunk
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.runs.table import RateTable, rate_cells, to_html, to_markdown
from planner_jax.runs.timing import CompileClock, Stopwatch
from planner_jax.sims.film import draw_flight, film_flights, require_film
from planner_jax.sims.recording import FLIGHTS, Recording, read_recording, to_rows
from planner_jax.sims.settings import FlySettings, fly_settings
from planner_jax.sims.task import FlightTask
from planner_jax.sweep.quadrotor_settings import robot_remark
from planner_jax.sweep.report import require_counted

_FILMED = 3  # greatest number of flights in a film
_RECORDED = 256  # largest batch of flights of which every sample is recorded
_FRAME = "world, z up; times from the start of the first plan"


_COLUMNS = (
    INDEX,
    *leaves_of("verdict", ("success", "", "by the task's criterion", BOOL)),
    status_column("of the first plan"),
    *leaves_of("plans", ("iterations", "", "of the first plan", COUNT)),
    Column("tracking_rms", "m", "from the plan", NUMBER, lambda b: b.verdict.flown.tracking[:, 0]),
    Column(
        "tracking_worst", "m", "from the plan", NUMBER, lambda b: b.verdict.flown.tracking[:, 1]
    ),
)


def start_flights(
    settings: FlySettings,
    out: str | os.PathLike,
    video: str | None = None,
    *,
    record: int = 16,
) -> dict[str, Any]:
    """Simulate all flights of a run, store them in a new folder, and return its manifest.

    Args:
        settings: settings of the run, of the task's own class.
        out: path of the folder, new or empty.
        video: name of a film in the folder, .gif or .mp4; None for no film.
        record: number of flights that are recorded, from the first flight on.

    Raises:
        ArgumentError: `record` or `video` is invalid, the folder is not empty, or this machine
            cannot run the simulation; no files remain.
    """
    folder = RunFolder(out)
    require(1 <= record <= _RECORDED, "record", f">= 1 and <= {_RECORDED}", record)
    if video is not None:
        require(os.path.basename(video) == video, "video", "a file name", video)
        require_film(Path(video))
    folder.require_new()
    require_backend()
    flight = settings.flight()
    cases = flight.cases()
    manifest = {
        "kind": f"fly {settings.TASK.name}",
        "state": "running",
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        **environment(),
        "seed": settings.seed,
        "parameters": dataclasses.asdict(settings),
        "loop": flight.parameters(),
        "video": video,
    }
    rest: dict[str, Any] = {
        "remainder": lambda: _discard_unfinished(folder),
        "patient": False,
        "bar": False,
    }
    with folder.create(manifest), stopping.under_way(**rest):
        try:
            return _fly_into(folder, manifest, flight, cases, min(record, settings.num))
        except (KeyboardInterrupt, OSError):
            _discard_unfinished(folder)
            raise


def _discard_unfinished(folder: RunFolder) -> str:
    try:
        if folder.read_manifest()["state"] == "complete":
            return f"the flights are finished: {folder.path}"
    except ArgumentError:
        pass
    folder.discard()
    return f"{stopping.NOTHING}: flights are kept when all of them are flown"


def _fly_into(
    folder: RunFolder, manifest: dict[str, Any], flight: FlightTask, cases: Any, kept: int
) -> dict[str, Any]:
    print(f"Writing {folder.path}; the simulation compiles first.", file=sys.stderr, flush=True)
    rows, times, flights = _fly_all(flight, cases, kept)
    folder.plans.write_rows(rows)
    recording = flight.recording(cases, flights, np.arange(kept))
    Dataset(folder.path / FLIGHTS).write_rows(to_rows(recording))
    if video := manifest["video"]:
        film_flights(folder.path / video, flight, recording, min(_FILMED, kept))
    done = {"state": "complete", "summary": _summary(flight, rows), "times": times}
    whole = folder.write_manifest({**manifest, **done})
    write_flight_report(folder)
    return whole


def read_flights(folder: RunFolder) -> tuple[dict[str, Any], FlightTask, Recording]:
    """Read the manifest, the task and the recording of a finished run of flights.

    Raises:
        ArgumentError: the folder does not hold a finished run of flights.
    """
    manifest = folder.read_manifest()
    flights = Dataset(folder.path / FLIGHTS)
    kind, _, task = str(manifest["kind"]).partition(" ")
    if kind != "fly":
        raise ArgumentError(folder.name, "a run of flights", shown=f"a {manifest['kind']}")
    if manifest["state"] != "complete" or not flights.files():
        shown = f"{str(folder.path)!r}; fly it again"
        raise ArgumentError(folder.name, f"finished, with its {FLIGHTS}", shown=shown)
    folder.require_whole(folder.plans, "fly it again", manifest["summary"]["num"])
    folder.require_whole(flights, "fly it again")
    settings = settings_of_manifest(fly_settings(task), manifest["parameters"], folder.name)
    try:
        recording = read_recording(flights.read())
    except (pa.ArrowException, OSError, ValueError) as error:
        why = " ".join(str(error).split())
        raise ArgumentError(folder.name, f"whole {FLIGHTS}: {why}", verb="have", shown="") from None
    return manifest, settings.flight(), recording


def require_sound(folder: RunFolder) -> None:
    """Raise `ArgumentError` unless the files of a run are complete and match its summary."""
    manifest, flight, _ = read_flights(folder)
    try:
        counted = _summary(flight, folder.plans.read())
    except (pa.ArrowException, OSError, KeyError) as error:
        why = " ".join(str(error).split())
        raise ArgumentError(
            folder.name, f"whole rows: {why}; fly it again", verb="have", shown=""
        ) from None
    require_counted(folder, manifest["summary"], counted)


def _fly_all(flight: FlightTask, cases: Any, shown: int) -> tuple[pa.Table, dict[str, Any], Any]:
    num = flight.settings.num
    size = min(flight.settings.batch or 4096, num)
    record = shown <= size <= _RECORDED
    parts, compiling, warm, warm_flights, recorded = [], 0.0, 0.0, 0, None
    watch = Stopwatch()
    for first in range(0, num, size):
        lanes = np.arange(first, first + size) % num  # the first cases pad the last batch
        with CompileClock() as clock:
            lap = Stopwatch()
            flights = flight.fly(cases[lanes], record)
            seconds = lap.lap()
        recorded = flights if record and first == 0 else recorded
        compiling += clock.seconds
        if not clock.compiled:
            warm, warm_flights = warm + seconds, warm_flights + size
        batch = FlownBatch(Chunk(lanes, None), flights.first_plan, flights)
        rows = rows_of([*_COLUMNS, *flight.every_column()], batch, _FRAME)
        parts.append(rows.slice(0, min(size, num - first)))
    times = {
        "compile_seconds": round(compiling, 3),
        "warm_seconds": round(warm, 4),
        "warm_flights": warm_flights,
        "wall_seconds": round(watch.lap(), 3),
    }
    # Large batches store no states, to save memory. The recorded flights are then flown again.
    if recorded is None:
        recorded = flight.fly(cases[np.arange(shown)], record=True)
    return pa.concat_tables(parts), times, recorded


def _summary(flight: FlightTask, rows: pa.Table) -> dict[str, Any]:
    success = np.asarray(rows["success"])
    low, high = wilson_interval(int(success.sum()), success.size)
    return {
        "success_rate": float(success.mean()),
        "num": int(success.size),
        "successes": int(success.sum()),
        "wilson_95": [low, high],
        "tracking_rms_median": float(np.median(rows["tracking_rms"])),
        "tracking_worst": float(np.max(rows["tracking_worst"])),
        **flight.counts(rows),
    }


def headline(manifest: dict[str, Any], flight: FlightTask) -> list[str]:
    """Return sentences on the success rate, sensing errors and wall time of a run of flights."""
    summary, times, device = manifest["summary"], manifest["times"], manifest["device"]
    settings = flight.settings
    rate = percent(summary["successes"], summary["num"])
    low, high = (100.0 * end for end in summary["wilson_95"])
    lines = [
        f"{rate} % of {summary['num']:,} flights {flight.SUCCESS} "
        f"(95 % interval {low:.2f} to {high:.2f} %).",
        *flight.findings(summary),
    ]
    again = f"planned anew at {settings.rate:g} Hz" if settings.rate else "never planned anew"
    lines.append(
        f"{flight.conditions}, {again}. "
        f"Tracking error {100 * summary['tracking_rms_median']:.2f} cm rms in the median flight, "
        f"{100 * summary['tracking_worst']:.1f} cm at worst."
    )
    lines.append(
        f"{times['wall_seconds']:.1f} s on {device['kind']}, {times['compile_seconds']:.1f} s of "
        "them compiling."
    )
    return lines


def write_flight_report(folder: RunFolder) -> None:
    """Write `table.md`, `figures/` and `index.html` of a run, and replace existing files.

    Args:
        folder: run folder with `manifest.json`, `plans/` and `flights/`, and perhaps a film.

    Raises:
        ArgumentError: the folder does not hold a finished run of flights.
    """
    manifest, flight, recording = read_flights(folder)
    folder.figures.mkdir(exist_ok=True)
    draw_flight(folder.figures / "flight.png", flight, recording, 0)
    rows = folder.plans.read()
    figures = ["flight.png", *flight.draw(folder.figures, rows)]
    more = flight.tables(rows)
    summary, video = manifest["summary"], manifest["video"]
    cells = rate_cells(summary["successes"], summary["num"])
    table = RateTable(
        "Success",
        ["flights of", "flights", "success %", "95 % interval", "published"],
        [[flight.suite, *cells, flight.PUBLISHED]],
    )
    lines = headline(manifest, flight)
    title = f"Flights, {flight.settings.TASK.name}, {flight.suite}"
    remarks = [
        *robot_remark(manifest["parameters"]),
        f"Everything is simulated in MuJoCo MJX: {flight.simulated}.",
    ]
    text = to_markdown(title, lines, table, remarks)
    text += "".join(f"\n{to_markdown(each.title, (), each, ())}" for each in more)
    folder.write_text("table.md", text)
    lead = "".join(f"<p>{html.escape(line)}</p>\n" for line in lines)
    shown = f'<p><img src="{html.escape(video)}" alt="film"></p>\n' if video else ""
    if video and video.endswith(".mp4"):
        shown = f'<p><video controls src="{html.escape(video)}"></video></p>\n'
    notes = "".join(f"<li>{html.escape(line)}</li>\n" for line in remarks)
    record = html.escape(json.dumps(manifest, indent=2))
    folder.write_text(
        "index.html",
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title></head>\n<body>\n<h1>{html.escape(title)}</h1>\n"
        f"{lead}{shown}{''.join(_image(name) for name in figures)}{to_html(table)}"
        f"{''.join(f'<h2>{html.escape(each.title)}</h2>{chr(10)}{to_html(each)}' for each in more)}"
        f"<ul>\n{notes}</ul>\n"
        f'<p>All rows: <a href="plans/">plans/</a>. The first '
        f"{len(recording)} flights, sample by sample: "
        f'<a href="{FLIGHTS}/">{FLIGHTS}/</a>; play them with <code>planner-jax view</code>.</p>\n'
        f"<details><summary>manifest.json</summary><pre>{record}</pre></details>\n"
        "</body></html>\n",
    )


def _image(name: str) -> str:
    return f'<p><img src="figures/{name}" alt="{name.partition(".")[0]}"></p>\n'
