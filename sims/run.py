"""A run of flights into a run folder: manifest, rows, table, picture, page and film."""

import dataclasses
import datetime
import html
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from planner_jax.optimise.status import Status
from planner_jax.sims.catch import INTERVAL, fly_catches, throws
from planner_jax.sims.catch import SEEN as CATCH_SEEN
from planner_jax.sims.closed_loop import Loop
from planner_jax.sims.film import FilmError, draw_flight, film_flights, require_film
from planner_jax.sims.hit import SCENARIOS, fly_hits, volleys
from planner_jax.sims.hit import SEEN as HIT_SEEN
from planner_jax.sims.model import NET, RACKET, World
from planner_jax.sims.recording import FILE, Recording, read_recording, recorded, to_rows
from planner_jax.sims.scoring import returned
from planner_jax.sims.sensing import NOISES
from planner_jax.sweep.columns import (
    BOOL,
    COUNT,
    LIST,
    NUMBER,
    TEXT,
    VECTOR,
    Column,
    list_of,
    rows_of,
)
from planner_jax.sweep.columns import RefereedBatch as FlownBatch
from planner_jax.sweep.environment import environment, require_backend
from planner_jax.sweep.run_folder import RunFolder
from planner_jax.sweep.settings import SettingError, require, require_one_of
from planner_jax.sweep.source import Cases
from planner_jax.sweep.summary import percent, wilson_interval
from planner_jax.sweep.table import RateTable, own_cells, to_html, to_markdown
from planner_jax.sweep.timing import CompileClock, Stopwatch
from planner_jax.task.catch.planners import PLANNERS as CATCH_PLANNERS
from planner_jax.task.catch.planners import catch_planner
from planner_jax.task.hit.planners import PLANNERS as HIT_PLANNERS
from planner_jax.task.hit.planners import planner as hit_planner

TASKS = ("catch", "hit")
_RECORDED = 256  # flights of a batch that are recorded whole
_FRAME = "world, z up; times from the first plan"
_NEAR, _FAR = 0.5, 1.0  # [m] from the target: the two rates of paper 002
_RATES = {"catch": 100.0, "hit": 50.0}  # [Hz]
_PUBLISHED = {  # paper 000, Table I; paper 002 shows its rates as a figure only
    "catch": "Catch Planner, 50 real throws: 64 % caught",
    "hit": "Bat, 600 real serves: within 0.5 m and 1 m, in a figure without numbers",
}


@dataclasses.dataclass(frozen=True)
class FlySettings:
    """What a run of flights is asked to do.

    Raises:
        SettingError: a value breaks its rule; one line that begins with its name.
    """

    task: str
    num: int = 64
    noise: str = "lab"
    replan: float | None = None  # [Hz]; None: 100 for catches, 50 for hits; 0: never
    seed: int = 0
    batch: int | None = None  # flights at once; None: all up to 4096
    planner: str = "exact"  # of the plans from scratch
    balls: int = 1  # of a catch
    scenario: str = "S.1"  # of hits
    drag_error: float = 0.15  # relative, of what is believed of the drag

    def __post_init__(self) -> None:
        require_one_of(TASKS, "task", self.task)
        for name, least in (("num", 1), ("batch", 1), ("seed", 0), ("balls", 1)):
            value = getattr(self, name)
            require(value is None or value >= least, name, f">= {least}", value)
        require_one_of(NOISES, "noise", self.noise)
        require_one_of(SCENARIOS, "scenario", self.scenario)
        planners = CATCH_PLANNERS if self.task == "catch" else HIT_PLANNERS
        require_one_of(planners, "planner", self.planner)
        require(0.0 <= self.drag_error < 1.0, "drag_error", ">= 0 and < 1", self.drag_error)
        if self.task == "hit":
            require(self.balls == 1, "balls", "1 for hits", self.balls)
        again = self.rate > 0.0
        require(not again or self.planner == "exact", "replan", "0 for other planners", self.rate)
        self.loop(record=False)

    @property
    def rate(self) -> float:
        """[Hz] of planning anew; only `exact` is planned anew by default."""
        if self.replan is not None:
            return self.replan
        return _RATES[self.task] if self.planner == "exact" else 0.0

    def loop(self, record: bool) -> Loop:
        """The closed loop of the flights."""
        catch = self.task == "catch"
        world = World(NET, num_balls=self.balls) if catch else World(RACKET, gravity=9.8)
        try:
            return Loop(world, NOISES[self.noise], replan=self.rate, record=record)
        except ValueError as error:
            raise SettingError(str(error)) from None

    def cases(self) -> Any:
        """All cases."""
        if self.task == "catch":
            return throws(self.num, self.balls, self.seed, drag_error=self.drag_error)
        regions = SCENARIOS[self.scenario]
        return volleys(self.num, regions, self.seed, drag_error=self.drag_error)

    def fly(self, cases: Any, record: bool) -> Any:
        """Flights of some cases."""
        if self.task == "catch":
            planner: Any = catch_planner(self.planner)
            return fly_catches(self.loop(record), cases, self.seed, planner=planner)
        planner = None if self.planner == "exact" else hit_planner(self.planner)
        return fly_hits(self.loop(record), cases, self.seed, planner=planner)


def _contact(name: str) -> Any:
    return lambda b: np.asarray(getattr(b.verdict.flown.contact, name)).reshape(len(b.cases), -1)


def success(flights: Any) -> np.ndarray:
    """(B,) bool: all balls caught, or the ball within half a metre of the target."""
    return flights.caught.all(axis=1) if hasattr(flights, "caught") else flights.miss <= _NEAR


_COMMON = [
    Column("index", "", "place in the whole", pa.int64(), lambda b: b.cases.index),
    Column("success", "", "caught, or landed within 0.5 m", BOOL, lambda b: success(b.verdict)),
    Column(
        "status",
        "",
        "of the first plan",
        TEXT,
        lambda b: np.array([Status(code).name for code in np.asarray(b.plans.status)]),
    ),
    Column("iterations", "", "of the first plan", COUNT, lambda b: b.plans.iterations),
    Column("contact_time", "s", "of each ball's nearest passage", LIST, _contact("time")),
    Column("planned_time", "s", "of that contact", LIST, _contact("planned_time")),
    Column("offset", "m", "ball from the tool's centre", LIST, _contact("offset")),
    Column("contact_ball_pos", "m", "a point a ball", LIST, _contact("ball_pos")),
    Column("contact_robot_pos", "m", "a point a ball", LIST, _contact("robot_pos")),
    Column("contact_tracking", "m", "quadrotor from its plan then", LIST, _contact("tracking")),
    Column("tracking_rms", "m", "on the way", NUMBER, lambda b: b.verdict.flown.tracking[:, 0]),
    Column("tracking_worst", "m", "on the way", NUMBER, lambda b: b.verdict.flown.tracking[:, 1]),
]
_OWN: Mapping[str, Sequence[Column]] = {
    "catch": [
        Column("caught", "", "each ball", list_of(BOOL), lambda b: b.verdict.caught),
    ],
    "hit": [
        Column("met", "", "by the racket", BOOL, lambda b: b.verdict.flown.contact.met[:, 0]),
        Column("landing", "m", "of the returned ball", VECTOR, lambda b: b.verdict.landing),
        Column("miss", "m", "from the target", NUMBER, lambda b: b.verdict.miss),
    ],
}


def start_flights(
    settings: FlySettings,
    out: str | os.PathLike,
    video: str | None = None,
    *,
    record: int = 16,
    film: int = 3,
) -> dict[str, Any]:
    """Fly into a new folder.

    Args:
        settings: of the run.
        out: folder, new or empty.
        video: name of a film in the folder, .gif or .mp4; None makes none.
        record: how many flights are kept look by look, the first ones.
        film: how many of these the film shows, the first ones.

    Returns:
        The manifest.

    Raises:
        SettingError: an argument breaks a rule; nothing is left behind.
    """
    folder = RunFolder(out)
    require(1 <= record <= _RECORDED, "record", f">= 1 and <= {_RECORDED}", record)
    if video is not None:
        require(os.path.basename(video) == video, "video", "a file name", repr(video))
        try:
            require_film(Path(video))
        except FilmError as error:
            raise SettingError(str(error)) from None
    folder.require_new()
    require_backend()
    cases = settings.cases()
    folder.create(
        {
            "kind": f"fly {settings.task}",
            "state": "running",
            "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            **environment(),
            "seed": settings.seed,
            "parameters": dataclasses.asdict(settings),
            "loop": dataclasses.asdict(settings.loop(record=False)),
            "video": video,
        }
    )
    kept = min(record, settings.num)
    rows, times, flights = _fly_all(settings, cases, kept)
    folder.write_rows(folder.plans, rows)
    recording = record_of(settings, cases, flights, np.arange(kept))
    folder.write_rows(folder.path / FILE, to_rows(recording))
    if video is not None:
        titles = [title_of(settings, recording, lane) for lane in range(min(film, kept))]
        film_flights(folder.path / video, settings.loop(record=False).world, recording, titles)
    done = {"state": "complete", "summary": _summary(settings, rows), "times": times}
    manifest = {**folder.read_manifest(), **done}
    folder.write_manifest(manifest)
    write_flight_report(folder)
    return manifest


def read_flights(folder: RunFolder) -> tuple[dict[str, Any], FlySettings, Recording]:
    """Manifest, settings and recording of a finished run of flights.

    Raises:
        SettingError: the folder is not that of such a run.
    """
    manifest = folder.read_manifest()
    path = folder.path / FILE
    if not str(manifest["kind"]).startswith("fly "):
        raise SettingError(f"{folder.name} must be a run of flights, got a {manifest['kind']}")
    if manifest["state"] != "complete" or not path.exists():
        raise SettingError(
            f"{folder.name} must be finished, with its {FILE}, got {str(folder.path)!r}; "
            "fly it again"
        )
    try:
        recording = read_recording(path)
    except (pa.ArrowException, KeyError) as error:
        raise SettingError(f"{folder.name} must have a whole {FILE}: {error}") from None
    return manifest, FlySettings(**manifest["parameters"]), recording


def _fly_all(settings: FlySettings, cases: Any, shown: int) -> tuple[pa.Table, dict[str, Any], Any]:
    """Rows of all flights, batch by batch, seconds, and the first flights with their record.

    A run of few flights records them all, which saves compiling another program.
    """
    size = min(settings.batch or 4096, settings.num)
    record = shown <= size <= _RECORDED
    parts, compiling, warm, warm_flights, recorded = [], 0.0, 0.0, 0, None
    watch = Stopwatch()
    for first in range(0, settings.num, size):
        lanes = np.arange(first, first + size) % settings.num  # the last batch is filled up
        with CompileClock() as clock:
            lap = Stopwatch()
            flights = settings.fly(cases[lanes], record)
            seconds = lap.lap()
        recorded = flights if record and first == 0 else recorded
        compiling += clock.seconds
        if not clock.compiled:
            warm, warm_flights = warm + seconds, warm_flights + size
        batch = FlownBatch(Cases(lanes, None), None, flights.first_plan, flights)
        rows = rows_of([*_COMMON, *_OWN[settings.task]], batch, _FRAME)
        parts.append(rows.slice(0, min(size, settings.num - first)))
    times = {
        "compile_seconds": round(compiling, 3),
        "warm_seconds": round(warm, 4),
        "warm_flights": warm_flights,
        "wall_seconds": round(watch.lap(), 3),
    }
    if recorded is None:
        recorded = settings.fly(cases[np.arange(shown)], record=True)
    return pa.concat_tables(parts), times, recorded


def _summary(settings: FlySettings, rows: pa.Table) -> dict[str, Any]:
    """Counts of a run."""
    success = np.asarray(rows["success"])
    low, high = wilson_interval(int(success.sum()), success.size)
    summary = {
        "num": int(success.size),
        "successes": int(success.sum()),
        "wilson_95": [low, high],
        "tracking_rms_median": float(np.median(rows["tracking_rms"])),
        "tracking_worst": float(np.max(rows["tracking_worst"])),
    }
    if settings.task == "hit":
        miss = np.asarray(rows["miss"])
        summary["within_1_m"] = int((miss <= _FAR).sum())
        summary["met"] = int(np.asarray(rows["met"]).sum())
    return summary


def record_of(settings: FlySettings, cases: Any, flights: Any, lanes: np.ndarray) -> Recording:
    """The recording of some of the flights that were recorded.

    Args:
        settings: of the run.
        cases: that were flown.
        flights: what came of them.
        lanes: (F,) which of them.
    """
    pick = lambda leaf: np.asarray(leaf)[lanes]  # noqa: E731
    flown = flights.flown
    flown = dataclasses.replace(
        flown,
        contact=jax.tree.map(pick, flown.contact),
        record=jax.tree.map(pick, flown.record),
    )
    world, some = settings.loop(record=True).world, cases[lanes]
    common: dict[str, Any] = {
        "index": some.index,
        "success": pick(success(flights)),
        "gravity": world.gravity,
    }
    if settings.task == "catch":
        begins = INTERVAL * np.arange(world.num_balls)
        common |= {"drag": some.drag, "begins": begins, "seen": CATCH_SEEN}
        return recorded(flown, some.balls, **common)
    scenarios = some.scenarios
    contact = jax.tree.map(lambda leaf: leaf[:, 0], flown.contact)
    back = jax.device_get(jax.vmap(returned)(contact, scenarios.restitution))
    common |= {"drag": scenarios.drag[:, None], "begins": np.zeros(1), "seen": HIT_SEEN}
    balls = jax.tree.map(lambda leaf: leaf[:, None], scenarios.ball)
    return recorded(flown, balls, returned=back, target=scenarios.target, **common)


def draw_one(
    path: Path, settings: FlySettings, cases: Any, flights: Any, lane: int, **look: Any
) -> None:
    """Write the picture of one of some flights that were recorded.

    Args:
        path: ends in .png.
        settings: of the run.
        cases: that were flown.
        flights: what came of them.
        lane: which one.
        look: `title` and `view` for `film.draw_flight`.
    """
    recording = record_of(settings, cases, flights, np.array([lane]))
    world = settings.loop(record=True).world
    draw_flight(path, world, recording, 0, **{"title": title_of(settings, recording, 0), **look})


def title_of(settings: FlySettings, recording: Recording, flight: int) -> str:
    """Task, place in the run and outcome of a flight."""
    outcome = "success" if recording.success[flight] else "failure"
    return f"{settings.task} {recording.index[flight]}, {outcome}"


def headline(manifest: dict[str, Any]) -> list[str]:
    """Success and times of a run, a sentence each."""
    summary, times, device = manifest["summary"], manifest["times"], manifest["device"]
    settings = FlySettings(**manifest["parameters"])
    rate = percent(summary["successes"], summary["num"])
    low, high = (100.0 * end for end in summary["wilson_95"])
    what = "caught all balls" if settings.task == "catch" else "landed within 0.5 m of the target"
    lines = [
        f"{rate} % of {summary['num']:,} flights {what} (95 % interval {low:.2f} to {high:.2f} %)."
    ]
    if settings.task == "hit":
        within = percent(summary["within_1_m"], summary["num"])
        met = percent(summary["met"], summary["num"])
        lines.append(f"{within} % within 1 m; the racket met the ball in {met} %.")
    again = f"planned anew at {settings.rate:g} Hz" if settings.rate else "never planned anew"
    lines.append(
        f"Noise {settings.noise}, drag believed {100 * settings.drag_error:g} % wrong, {again}. "
        f"Tracking error {100 * summary['tracking_rms_median']:.2f} cm rms in the median flight, "
        f"{100 * summary['tracking_worst']:.1f} cm at worst."
    )
    lines.append(
        f"{times['wall_seconds']:.1f} s on {device['kind']}, {times['compile_seconds']:.1f} s of "
        "them compiling."
    )
    return lines


def write_flight_report(folder: RunFolder) -> None:
    """Write `table.md`, `figures/` and `index.html` of a run of flights anew.

    Args:
        folder: with `manifest.json` and `flights.parquet`; a film may be there.

    Raises:
        SettingError: the folder is not that of a finished run of flights.
    """
    manifest, settings, recording = read_flights(folder)
    folder.figures.mkdir(exist_ok=True)
    world = settings.loop(record=False).world
    title = title_of(settings, recording, 0)
    draw_flight(folder.figures / "flight.png", world, recording, 0, title)
    summary, video = manifest["summary"], manifest["video"]
    name = f"{settings.balls} ball(s)" if settings.task == "catch" else settings.scenario
    cells = own_cells(summary["successes"], summary["num"])
    table = RateTable(
        "Success",
        ["flights of", "flights", "success %", "95 % interval", "published"],
        [[name, *cells, _PUBLISHED[settings.task]]],
    )
    title, lines = f"Flights, {settings.task}, {name}", headline(manifest)
    remarks = [
        "Everything is simulated in MuJoCo MJX: rotors with lag, body-rate, attitude and position "
        "control, motion capture with noise, dropout and latency, balls with quadratic drag.",
    ]
    folder.write_text("table.md", to_markdown(title, lines, table, remarks))
    lead = "".join(f"<p>{html.escape(line)}</p>\n" for line in lines)
    shown = f'<p><img src="{html.escape(video)}" alt="film"></p>\n' if video else ""
    if video and video.endswith(".mp4"):
        shown = f'<p><video controls src="{html.escape(video)}"></video></p>\n'
    record = html.escape(json.dumps(manifest, indent=2))
    folder.write_text(
        "index.html",
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title></head>\n<body>\n<h1>{html.escape(title)}</h1>\n"
        f'{lead}{shown}<p><img src="figures/flight.png" alt="one flight"></p>\n'
        f'{to_html(table)}<p>All rows: <a href="plans.parquet">plans.parquet</a>. The first '
        f"{len(recording)} flights look by look: "
        f'<a href="{FILE}">{FILE}</a>; play them with <code>planner-jax view</code>.</p>\n'
        f"<details><summary>manifest.json</summary><pre>{record}</pre></details>\n"
        "</body></html>\n",
    )
