"""Count plans whose status disagrees with the referee, for every task, suite and kind of limit.

    python -m benchmarks.status_against_referee [--num 200] [--rows hit:court,catch:throws]
        [--seed 0] [--out DIR]

The status is the planner's own report whether every limit holds. The referee is an independent
check in float64. Each row of the table counts
* the plans whose status reports that every limit holds ("solved");
* the plans that the referee accepts;
* solved plans that the referee rejects, with the limits that fail;
* accepted plans that are not solved. In brackets is the number of them that exceed a limit by no
  more than the referee's tolerance; a status permits no tolerance.

In rows with obstacles, an obstacle is placed on the trajectory that the planner finds without
obstacles. Rows whose planning is slow use only a tenth or a fortieth of the cases.
"""

import collections
import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.robot.quadrotor_models import MODELS
from planner_jax.task.catch.spec import SUITES as CATCHES
from planner_jax.task.intercept.spec import SUITES as INTERCEPTIONS
from planner_jax.trajectory.polynomial import states_at

TOLERANCE = 1e-3  # The referee accepts limits that are exceeded by up to this relative amount.


@dataclasses.dataclass(frozen=True)
class Row:
    """One kind of cases of a task: how they are drawn, planned and judged."""

    task: str
    suite: str
    draw: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # options for drawing cases
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # options of the planner
    judge: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # options of the referee
    # Function that changes the drawn cases, such as `tighten_limits`; None for no change.
    change: Callable[["Row", Any, np.random.Generator], Any] | None = None
    every: int = 1  # the number of cases is divided by this number, for slow planners

    @property
    def card(self) -> Any:
        return pj.task_named(self.task)

    @property
    def planner(self) -> Any:
        """The planner, with the task's options for benchmarks, such as an order of catches.

        The options of the row are added to these options of the task specification (`bench`).
        """
        return self.card.planner(**{**self.card.bench, **self.options})

    def cases(self, num: int, seed: int) -> Any:
        """Draw about `num` / `every` cases in NumPy arrays, and change them by `change`.

        The field `every` of the row is above 1 for slow planners. Its field `change` is a function
        that adds an obstacle, for example; with None the drawn cases are returned.
        """
        cases = self.card.draw(max(num // self.every, 1), self.suite, seed, **self.draw)
        cases = jax.tree.map(np.asarray, cases)
        if self.change is None:
            return cases
        return self.change(self, cases, np.random.default_rng([seed, len(self.suite)]))


def tighten_limits(row: Row, cases: Any, random: np.random.Generator) -> Any:
    """Set the limits of speed, acceleration and body rate to 2.5 m/s, 10 m/s^2 and 3 rad/s.

    `row` and `random` are not used, but passed to every function that changes cases.
    """
    own = cases.limits
    weak = {"speed": 2.5 + 0.0 * own.speed, "body_rate": 3.0 + 0.0 * own.body_rate}
    if own.acceleration is not None:
        weak["acceleration"] = 10.0 + 0.0 * own.acceleration
    return cases.replace(limits=dataclasses.replace(own, **weak))


def _point_on_plan(row: Row, cases: Any, random: np.random.Generator) -> np.ndarray:
    """Plan B cases; return a position (B, 3) [m] on each plan, at 35 to 75 % of its duration."""
    path = pj.plan(row.planner, cases).trajectory
    share = random.uniform(0.35, 0.75, len(path.durations))
    return states_at(path, share * np.asarray(path.durations).sum(axis=1))[:, 0]


def _add_constraint(cases: Any, extra: Any) -> Any:
    return cases.replace(extras=(jax.tree.map(lambda leaf: leaf.astype(np.float32), extra),))


def add_spheres(row: Row, cases: Any, random: np.random.Generator) -> Any:
    """Add to each case a forbidden sphere, radius 10 to 30 cm, near the path planned without it."""
    place = _point_on_plan(row, cases, random)
    centre = place + random.normal(0.0, 0.08, place.shape)
    return _add_constraint(cases, pj.KeepOut(centre, random.uniform(0.1, 0.3, len(place))))


def add_boxes(row: Row, cases: Any, random: np.random.Generator) -> Any:
    """Add to each case a forbidden box, sides of 20 to 60 cm, near the path planned without it."""
    place = _point_on_plan(row, cases, random)
    middle = place + random.normal(0.0, 0.08, place.shape)
    half = random.uniform(0.1, 0.3, place.shape)
    return _add_constraint(cases, pj.KeepOutBox(middle - half, middle + half))


def add_planes(row: Row, cases: Any, random: np.random.Generator) -> Any:
    """Add to each case a wall beside a straight line from the start to a point of the plan.

    The plan is computed without the wall. The wall is parallel to the line, up to 15 cm from it, on
    a random side.
    """
    start, place = cases.head_state[:, 0], _point_on_plan(row, cases, random)
    along = place - start
    along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-6
    normal = random.normal(size=place.shape)
    normal -= (normal * along).sum(axis=1, keepdims=True) * along
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    beside = random.uniform(0.0, 0.15, (len(place), 1))
    return _add_constraint(cases, pj.Plane(start - beside * normal, normal))


def _hits() -> dict[str, Row]:
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
        "tight": Row("hit", "court", change=tighten_limits),
        "spheres": Row("hit", "court", change=add_spheres),
        "boxes": Row("hit", "court", change=add_boxes),
        "planes": Row("hit", "court", change=add_planes),
        "late-boxes": Row("hit", "court", {"delay": 0.3}, change=add_boxes),
        **{name: Row("hit", "court", {"robot": MODELS[name]}) for name in ("racer", "x500")},
        "brake": Row("hit", "court", options={"recovery": "brake"}),
        "home": Row("hit", "court", options={"recovery": "home"}),
    }


def _catches() -> dict[str, Row]:
    robots = ("crazyflie", "racer-net", "x500-net")
    return {
        **{suite: Row("catch", suite) for suite in CATCHES},
        "hard-tight": Row("catch", "hard", change=tighten_limits),
        "parabola2-tight": Row("catch", "parabola2", change=tighten_limits),
        "triangle3-tight": Row("catch", "triangle3", change=tighten_limits),
        "throws-spheres": Row("catch", "throws", change=add_spheres),
        "parabola2-spheres": Row("catch", "parabola2", change=add_spheres),
        "throws-boxes": Row("catch", "throws", change=add_boxes),
        "parabola2-boxes": Row("catch", "parabola2", change=add_boxes),
        "parabola2-planes": Row("catch", "parabola2", change=add_planes),
        **{name: Row("catch", "parabola2", {"robot": MODELS[name]}) for name in robots},
        "parabola2-brake": Row("catch", "parabola2", options={"recovery": "brake"}),
    }


def _others() -> dict[str, Row]:
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


# All rows of the table; the option --rows selects them by their keys "task:name".
ROWS = {
    f"{row.task}:{name}": row
    for rows in (_hits(), _catches(), _others())
    for name, row in rows.items()
}


def compare(row: Row, num: int, seed: int) -> dict[str, Any]:
    """Plan and judge `num` cases of one kind; return counts of plans, and further results by name.

    The counts are of plans that are solved by their status, that the referee (an independent check)
    accepts, and that only one of status and referee accepts.
    """
    cases, planner = row.cases(num, seed), row.planner
    began = time.perf_counter()
    plans = jax.device_get(pj.plan(planner, cases))
    seconds = time.perf_counter() - began
    verdict = row.card.judge(cases, plans, **row.judge)
    claimed, accepted = np.asarray(pj.are_solved(plans)), np.asarray(verdict.success)
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
    """Plan and judge the cases of the rows with the given names, and print counts of plans.

    A row has a task, a suite of cases and a kind of limit. The counts state how often the planner's
    status and the referee, an independent check, disagree. The last printed line has sums.
    """
    bench.say(
        f"seed {options.seed}, {jax.devices()[0].device_kind}, jax {jax.__version__}",
        "| row | cases | solved by status | accepted by referee | solved, rejected | accepted, not "
        "solved (within tolerance) | failed limits | seconds |",
        "|---|---|---|---|---|---|---|---|",
    )
    total = collections.Counter()
    for name in names:
        found = compare(ROWS[name], options.num, options.seed)
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
    parser = argument_parser("status_against_referee", __doc__, num=200, seed=0)
    parser.add_argument(
        "--rows", default=",".join(ROWS), help="rows, comma-separated; default: all"
    )
    options = parser.parse_args()
    names = parse_names(parser, "--rows", options.rows, ROWS)
    with begin(parser, options) as bench:
        measure(bench, options, names)


if __name__ == "__main__":
    main()
