"""Does the status of a plan say what the referee says? Every task and suite, limits tight and weak.

    python -m benchmarks.status_against_referee [--num 200] [--rows hit:court,catch:throws]
        [--seed 0] [--out DIR]

A row counts the plans whose status says that every limit holds, those that the referee accepts, and
both ways to disagree: claims that the referee refuses, with the limits that it names, and plans
that it accepts though their status claims nothing. Of the latter the table says how many exceed a
limit by no more than the referee's tolerance, which a status does not use up. Obstacles stand in
the way: each where the plan of the same case without it comes by. Rows that take long have one case
in ten, or in forty.
"""

import collections
import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, begin, chosen
from planner_jax.robot.quadrotor_models import MODELS
from planner_jax.task.catch.spec import SUITES as CATCHES
from planner_jax.task.intercept.spec import SUITES as INTERCEPTIONS
from planner_jax.trajectory.polynomial import states_at

TOLERANCE = 1e-3  # of the referee, relative


@dataclasses.dataclass(frozen=True)
class Row:
    """Cases and the planner that is asked."""

    task: str
    suite: str
    draw: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of the planner
    judge: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    changed: Callable[["Row", Any, np.random.Generator], Any] | None = None  # the drawn cases
    every: int = 1  # of so many cases one is planned

    @property
    def card(self) -> Any:
        """The task's."""
        return pj.task_named(self.task)

    @property
    def planner(self) -> Any:
        """The one that is asked."""
        return self.card.planner(**{**self.card.bench, **self.options})

    def cases(self, num: int, seed: int) -> Any:
        """A batch in NumPy arrays."""
        cases = self.card.draw(max(num // self.every, 1), self.suite, seed, **self.draw)
        cases = jax.tree.map(np.asarray, cases)
        if self.changed is None:
            return cases
        return self.changed(self, cases, np.random.default_rng([seed, len(self.suite)]))


def tight(row: Row, cases: Any, random: np.random.Generator) -> Any:
    """Half the speed, two thirds of the acceleration and three fifths of the body rate."""
    own = cases.limits
    weak = {"speed": 2.5 + 0.0 * own.speed, "body_rate": 3.0 + 0.0 * own.body_rate}
    if own.acceleration is not None:
        weak["acceleration"] = 10.0 + 0.0 * own.acceleration
    return cases.replace(limits=dataclasses.replace(own, **weak))


def _passed(row: Row, cases: Any, random: np.random.Generator) -> np.ndarray:
    """A place (B, 3) on the way of each case's plan, between 35 and 75 % of its time."""
    path = pj.plan(row.planner, cases).trajectory
    share = random.uniform(0.35, 0.75, len(path.durations))
    return states_at(path, share * np.asarray(path.durations).sum(axis=1))[:, 0]


def _with(cases: Any, extra: Any) -> Any:
    """Cases with one more limit."""
    return cases.replace(extras=(jax.tree.map(lambda leaf: leaf.astype(np.float32), extra),))


def spheres(row: Row, cases: Any, random: np.random.Generator) -> Any:
    """A sphere of 10 to 30 cm in the way."""
    place = _passed(row, cases, random)
    centre = place + random.normal(0.0, 0.08, place.shape)
    return _with(cases, pj.KeepOut(centre, random.uniform(0.1, 0.3, len(place))))


def boxes(row: Row, cases: Any, random: np.random.Generator) -> Any:
    """A box with sides of 20 to 60 cm in the way."""
    place = _passed(row, cases, random)
    middle = place + random.normal(0.0, 0.08, place.shape)
    half = random.uniform(0.1, 0.3, place.shape)
    return _with(cases, pj.KeepOutBox(middle - half, middle + half))


def planes(row: Row, cases: Any, random: np.random.Generator) -> Any:
    """A wall up to 15 cm beside the straight line to where the way comes by, on any side of it."""
    start, place = cases.head_state[:, 0], _passed(row, cases, random)
    along = place - start
    along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-6
    normal = random.normal(size=place.shape)
    normal -= (normal * along).sum(axis=1, keepdims=True) * along
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    beside = random.uniform(0.0, 0.15, (len(place), 1))
    return _with(cases, pj.Plane(start - beside * normal, normal))


def _hits() -> dict[str, Row]:
    """Rows of hits."""
    late = {f"late-{delay}": Row("hit", "court", {"delay": delay}) for delay in (0.3, 0.5, 0.6)}
    weak = {
        f"limits-{scale}": Row("hit", "court", {"limit_scale": scale}) for scale in (0.7, 0.5, 0.35)
    }
    after = {"drag_after_impact": True}
    return {
        "court": Row("hit", "court"),
        "uniform-start": Row("hit", "court", {"start": "uniform"}),
        "drag-after": Row("hit", "court", options=after, judge=after),
        **late,
        **weak,
        "tight": Row("hit", "court", changed=tight),
        "spheres": Row("hit", "court", changed=spheres),
        "boxes": Row("hit", "court", changed=boxes),
        "planes": Row("hit", "court", changed=planes),
        "late-boxes": Row("hit", "court", {"delay": 0.3}, changed=boxes),
        **{name: Row("hit", "court", {"robot": MODELS[name]}) for name in ("racer", "x500")},
        "brake": Row("hit", "court", options={"recovery": "brake"}),
        "home": Row("hit", "court", options={"recovery": "home"}),
    }


def _catches() -> dict[str, Row]:
    """Rows of catches."""
    robots = ("crazyflie", "racer-net", "x500-net")
    return {
        **{suite: Row("catch", suite) for suite in CATCHES},
        "hard-tight": Row("catch", "hard", changed=tight),
        "parabola2-tight": Row("catch", "parabola2", changed=tight),
        "triangle3-tight": Row("catch", "triangle3", changed=tight),
        "throws-spheres": Row("catch", "throws", changed=spheres),
        "parabola2-spheres": Row("catch", "parabola2", changed=spheres),
        "throws-boxes": Row("catch", "throws", changed=boxes),
        "parabola2-boxes": Row("catch", "parabola2", changed=boxes),
        "parabola2-planes": Row("catch", "parabola2", changed=planes),
        **{name: Row("catch", "parabola2", {"robot": MODELS[name]}) for name in robots},
        "parabola2-brake": Row("catch", "parabola2", options={"recovery": "brake"}),
    }


def _others() -> dict[str, Row]:
    """Rows of interceptions and blocks."""
    blocks = {
        f"{suite}-{regime}": Row("block", suite, {"regime": regime}, every=10)
        for suite in ("pole", "open")
        for regime in ("R1", "R2", "R3")
    }
    quick = {"options": {"name": "quick"}, "every": 10}
    return {
        **{suite: Row("intercept", suite, every=10) for suite in INTERCEPTIONS},
        **{f"{suite}-quick": Row("intercept", suite, **quick) for suite in ("hard", "storm")},
        "hard-lattice": Row("intercept", "hard", options={"name": "lattice"}, every=40),
        "group": Row("group", "group", every=40),
        **blocks,
        "pole-wide": Row("block", "pole", {"regime": "R1", "wide": True}, every=10),
        "pole-brisk": Row("block", "pole", {"regime": "R2"}, {"name": "brisk"}, every=10),
    }


# The task stands before a name.
ROWS = {
    f"{row.task}:{name}": row
    for rows in (_hits(), _catches(), _others())
    for name, row in rows.items()
}


def compared(row: Row, num: int, seed: int) -> dict[str, Any]:
    """What status and referee say of a row's plans."""
    cases, planner = row.cases(num, seed), row.planner
    began = time.perf_counter()
    plans = jax.device_get(pj.plan(planner, cases))
    seconds = time.perf_counter() - began
    verdict = row.card.judge(cases, plans, **row.judge)
    claimed, accepted = np.asarray(pj.solved(plans)), np.asarray(verdict.success)
    refused, unclaimed = claimed & ~accepted, accepted & ~claimed
    return {
        "num": claimed.size,
        "claimed": int(claimed.sum()),
        "accepted": int(accepted.sum()),
        "refused": int(refused.sum()),
        "unclaimed": int(unclaimed.sum()),
        "unclaimed_within_tolerance": int((unclaimed & (plans.violation <= TOLERANCE)).sum()),
        "limits": dict(collections.Counter(verdict.failed_limit[refused].tolist())),
        "sentences": {int(k): verdict.sentence(k) for k in np.flatnonzero(refused)[:20]},
        "seconds": seconds,
    }


def measure(bench: Bench, options: Any, names: list[str]) -> None:
    """A row each, and the sums."""
    bench.say(
        f"seed {options.seed}, {jax.devices()[0].device_kind}, jax {jax.__version__}",
        "| row | cases | solved by status | accepted by referee | claimed, refused | accepted, not "
        "claimed (within tolerance) | limits that refuse | seconds |",
        "|---|---|---|---|---|---|---|---|",
    )
    total = collections.Counter()
    for name in names:
        found = compared(ROWS[name], options.num, options.seed)
        total.update({key: value for key, value in found.items() if isinstance(value, int)})
        limits = ", ".join(f"{limit} {count}" for limit, count in found["limits"].items())
        bench.say(f"| {name} | {_counts(found)} | {limits} | {found['seconds']:.1f} |")
        bench.row(row=name, **found)
        bench.count(np.arange(found["num"]) < found["accepted"])
    bench.say(f"| all | {_counts(total)} | | |")
    bench.note(**{key: value for key, value in total.items() if key != "num"})


def _counts(found: Mapping[str, Any]) -> str:
    return (
        f"{found['num']:,} | {found['claimed']:,} | {found['accepted']:,} | {found['refused']:,} | "
        f"{found['unclaimed']:,} ({found['unclaimed_within_tolerance']:,})"
    )


def main() -> None:
    """Print the table."""
    parser = argument_parser("status_against_referee", __doc__, num=200, seed=0)
    parser.add_argument("--rows", default=",".join(ROWS), help="comma-separated; default all")
    options = parser.parse_args()
    names = chosen(parser, "--rows", options.rows, ROWS)
    with begin(parser, options) as bench:
        measure(bench, options, names)


if __name__ == "__main__":
    main()
