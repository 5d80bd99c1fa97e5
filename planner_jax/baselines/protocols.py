"""Every published number that this project prints, with the protocol of its measurement.

Sweeps, simulations and benchmarks print these numbers, and a test compares the pages with them. The
module stands in the lowest package that prints one, and imports only the standard library.
"""

import csv
import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from importlib import resources
from statistics import fmean
from typing import Any


@dataclasses.dataclass(frozen=True)
class Published:
    """One published number, and the protocol by which its authors measured it."""

    paper: str  # key of docs/references.md
    table: str  # table or section of the paper, or "trial files" of its authors
    what_counts: str  # what is measured, or what counts as a success
    unit: str
    num: int | None  # number of trials; None if it is not stated
    machine: str
    unknown: str  # parts of the protocol that are not stated
    row: str  # quantity, and the planner or case
    value: float
    spread: float | None = None  # standard deviation, in `unit`
    bound: str = ""  # "<" or "<=" if only a bound of the number is published

    def __str__(self) -> str:
        """Return the number as the pages print it, with its sign, spread and unit."""
        spread = "" if self.spread is None else f" ± {self.spread:g}"
        return f"{self.bound} {self.value:g}{spread} {self.unit}".strip()


def _rows(*protocol: object, rows: Mapping[str, object], bound: str = "") -> Iterator[Published]:
    for row, value in rows.items():
        pair = value if isinstance(value, tuple) else (value, None)
        fields: tuple[Any, ...] = (*protocol, row, *pair, bound)
        yield Published(*fields)


def _rows_of_court() -> Iterator[Published]:
    """Yield the success rates of [Yu2023bat] by planner and court scenario, then their means."""
    folder = resources.files("planner_jax.baselines.hit")
    text = (folder / "published_rates.csv").read_text("utf-8")
    lines = [*csv.DictReader(line for line in text.splitlines() if line[0] != "#")]
    protocol = "plan within the limits that sends the ball to the target", "%"
    for source, table in (("paper", "Table I"), ("data", "trial files")):
        for planner in ("juggle", "bat-lite", "bat"):
            column = f"{source}_{planner.replace('-', '_')}"
            rates = {f"{planner} {line['scenario']}": float(line[column]) for line in lines}
            mean = {planner: round(fmean(rates.values()), 1)}
            for rows, num in ((rates, 1000), (mean, 36000)):
                yield from _rows("Yu2023bat", table, *protocol, num, "-", _BAT, rows=rows)


def _label(quantity: str, cases: Iterable[object], values: Iterable[object]) -> dict[str, object]:
    return {f"{quantity} {name}": value for name, value in zip(cases, values, strict=True)}


def _torques(name: str, text: str) -> Iterator[Published]:
    pairs = (tuple(map(float, pair.split("±"))) for pair in text.split())
    rows = _label(f"{name} joint", range(1, 7), pairs)
    unknown = f"{_ARM}, gravity included?"
    return _rows("Natarajan2024", "Table II", "RMS torque", "N m", 209, "-", unknown, rows=rows)


_NUC, _DESKTOP = "Intel i5-1135G7", "AMD Threadripper Pro 5995WX"
_BAT = "start position, weights, iterations, limit of computing time"
_CATCH = "limits, weights, ranges of the cases"
_CAR = "map, limits, obstacles, processor"
_ARM = "joint limits, poses, boxes, shield; the text states 200 trials in simulation"
_REAL = "ball falls into the net, real robot"
_OTR = "mean relative change of the decided times by the optimiser"
_SPEED = "column of acceleration; one of the two headings must be wrong"
_SUITES = ("parabola1", "parabola2", "harmonic2", "triangle3", "hexagon6")
_AHEAD = ("0 s", "5 s", "10 s", "15 s")
_ARMS = ("theirs", "RRT-Connect", "ePA*SE")

PUBLISHED: tuple[Published, ...] = (
    *_rows_of_court(),
    *_rows("Yu2023bat", "Section VI-C", "time of each module", "ms", None, _NUC, "which modules",
           rows={"module": 20}, bound="<"),
    *_rows("Yu2023catch", "Table I", "plan passes the authors' checks, real throws", "%", 50, _NUC,
           _CATCH, rows={"success throws": 96, "MPP success throws": 14}),
    *_rows("Yu2023catch", "Table I", _REAL, "%", 50, _NUC, _CATCH,
           rows={"caught throws": 64, "MPP caught throws": 8}),
    *_rows("Yu2023catch", "Table I", _OTR, "", 50, _NUC, _CATCH, rows={"OTR throws": 0.092}),
    *_rows("Yu2023catch", "Table II", "mean computing time", "ms", None, _NUC, "decision included?",
           rows={"plan": 9, "MPP plan": 0.149}),
    *_rows("Yu2023catch", "Section VII-A", "computing time of a new plan", "ms", None, _NUC,
           "decision included?", rows={"re-plan": 2}),
    *_rows("Yu2023catch", "Table III", "all targets caught in simulation", "%", 1000, "-", _CATCH,
           rows=_label("success", _SUITES, (99.3, 98.2, 84.7, 99.7, 76.3))),
    *_rows("Yu2023catch", "Table III", _OTR, "", 1000, "-", _CATCH,
           rows=_label("OTR", _SUITES, (0.052, 0.119, 0.234, 0.126, 0.458))),
    *_rows("Qu2022", "Table I", "relative error of the predicted position", "%", None, "-",
           "degree, divisor of the error",
           rows=_label("straight", _AHEAD, (0.23, 0.56, 1.28, 2.04))
           | _label("gaining", _AHEAD, (0.58, 2.13, 3.94, 5.88))),
    *_rows("Qu2022", "Table II", _SPEED, "m/s²", None, "-", _CAR,
           rows={"EM max": 0.327, "EM ave": 1.653, "theirs max": 0.296, "theirs ave": 1.559}),
    *_rows("Qu2022", "Table II", "mean time of the speed planner", "ms", None, "-", _CAR,
           rows={"EM time": 2.883, "theirs time": 2.175}),
    *_rows("Qu2022", "Table III", "mean time of a module", "ms", None, "-", _CAR,
           rows={"path": 150, "total": 154}),
    *_rows("Qu2022", "Table III", "mean time of a module", "ms", None, "-", _CAR,
           rows={"prediction": 1, "speed": 3}, bound="<="),
    *_rows("Natarajan2024", "Table I", "planner returns a motion", "%", 209, _DESKTOP, _ARM,
           rows=_label("found", _ARMS, (70.33, 59.81, 50.71))),
    *_rows("Natarajan2024", "Table I", "query and motion end before the ball arrives", "%", 209,
           _DESKTOP, _ARM, rows=_label("in time", _ARMS, (68.9, 27.27, 9.57))),
    *_rows("Natarajan2024", "Table I", "motion ends before the ball arrives", "%", 209, _DESKTOP,
           _ARM, rows={"blocked RRT-Connect": 27.27, "blocked ePA*SE": 11}),
    *_rows("Natarajan2024", "Table I", "computing time of a query", "ms", 209, _DESKTOP, _ARM,
           rows=_label("query", _ARMS, ((0.109, 0.033), (17.5, 31.7), (231, 377)))),
    *_rows("Natarajan2024", "Table I", "duration of the motion", "s", 209, _DESKTOP, _ARM,
           rows=_label("motion", _ARMS, ((0.31, 0.2), (1.3, 0.97), (1.8, 0.87)))),
    *_torques("theirs", "11±11 24.5±21 16.2±16 0.031±0.02 0.036±0.03 0.0003±0.0003"),
    *_torques("RRT-Connect", "102±40 130.2±49 43.6±24 0.35±1.3 0.13±0.35 0.015±0.12"),
    *_torques("ePA*SE", "61.4±38 131±52 39.5±14 0.34±1.3 0.11±0.25 0.012±0.09"),
    *_rows("Natarajan2024", "Section V-A", "mean time of flight", "s", 200, "-", "launch",
           rows={"flight": 1.069}),
    *_rows("Natarajan2024", "Section V-A", "preprocessing of the library", "h", 1, _DESKTOP, _ARM,
           rows={"build": 5}),
    *_rows("Natarajan2024", "Section V-B", "ball blocked, real robot, 6 to 8 m", "%", 50, "-", _ARM,
           rows={"real": 78}),
    *_rows("Natarajan2024", "Section V-B", "mean of a part of the time of flight", "ms", 50, "-",
           _ARM, rows={"perception": 82.9, "execution": 212.2, "overhead": 50, "planner": 4.9}),
    *_rows("Ji2025", "abstract", "hits in a row, real robot", "hits", 10, "-", "",
           rows={"mean": 311, "best": 462, "model-based mean": 3.1}),
    *_rows("Viljoen2026", "abstract", "plans per second over those of IPOPT", "", None,
           "NVIDIA L40S", "", rows={"speed-up": 32.85}, bound="<="),
    *_rows("Trauth2024", "abstract", "simulated scenarios of roads solved", "%", 1750, "-", "",
           rows={"solved": 88}),
)  # fmt: skip
# (paper, table, row) -> published number
BY_ROW = {(each.paper, each.table, each.row): each for each in PUBLISHED}
