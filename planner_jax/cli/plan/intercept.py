"""The command `planner-jax plan intercept`: a case of a car and a target, read from a file."""

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from planner_jax.cli.plan.answer import Answer, Margin, Single, closest_to
from planner_jax.cli.plan.settings import SingleInterceptSettings
from planner_jax.core.checks import numbers_of, require_switch
from planner_jax.core.choices import require_one_of
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import is_unsolved
from planner_jax.host.yaml_files import read_fields
from planner_jax.plane.maps import MapError, read_map
from planner_jax.plane.target import TurningPath
from planner_jax.task.intercept import drawing
from planner_jax.task.intercept.case import InterceptCase, case
from planner_jax.task.intercept.explain import relaxation

_SAMPLES = 4001  # number of times at which a plan is compared with the limits
_TARGET = {"position": (2,), "velocity": (2,), "turn_rate": ()}  # fields of a target, and shapes
_GRID = ("file", "coarsen", "unknown_is_free")  # fields of a grid
_ONE = {"time": (), "start": (3,), "initial_speed": (), "tolerance": ()}
_OWN = ("grid", *(name for name in inspect.signature(case).parameters if name != "dtype"))


def read_case(path: Path) -> InterceptCase:
    """Read one case from a YAML or JSON file whose fields are arguments of `pj.intercept.case`.

    The target has the fields `position` [m], `velocity` [m/s] and `turn_rate` [rad/s]. The
    additional field `grid` is the path of a ROS map's YAML file, relative to the file of the case;
    or it has the fields `file`, `coarsen` and `unknown_is_free`. The map's occupied cells are added
    to the walls, and its corners are the defaults of `lower` and `upper`.

    Raises:
        MapError: the file, or a field, is invalid. The message names file and field.
        ArgumentError: the file does not exist.
    """
    try:
        fields = read_fields(path)
    except ValueError as error:
        raise MapError(f"{path}: {error}") from None
    except OSError as error:
        rule = f"a file that can be read ({error.strerror})"
        raise ArgumentError("map", rule, str(path)) from None
    try:
        for name in fields:
            require_one_of(_OWN, "field", name)
        grid = fields.pop("grid", None)
        given = {"target": _target(fields.pop("target", None)), **fields}
        for name, shape in _ONE.items():  # arrays of other shapes would be a batch
            numbers_of(name, given.get(name, np.zeros(shape)), (), shape)
        return case(**(given if grid is None else _with_grid(path, grid, given)))
    except ArgumentError as error:
        raise MapError(f"{path}: {error}") from None


def _target(given: object) -> TurningPath:
    fields = _fields_of("target", given, tuple(_TARGET))
    if "position" not in fields:
        raise ArgumentError("target.position", "given", shown="nothing")
    numbers: list[Any] = [
        numbers_of(f"target.{name}", fields.get(name, np.zeros(shape)), (), shape).astype(float)
        for name, shape in _TARGET.items()
    ]
    return TurningPath(*numbers)


def _with_grid(path: Path, grid: object, given: dict[str, Any]) -> dict[str, Any]:
    """Return arguments of `case` with the walls and the corners of an occupancy grid."""
    fields = _fields_of("grid", {"file": grid} if isinstance(grid, str) else grid, _GRID)
    name, walls = fields.get("file"), given.get("walls", [])
    if not isinstance(name, str):
        raise ArgumentError("grid.file", "the path of a map's YAML file", name)
    if not isinstance(walls, list):
        raise ArgumentError("walls", "a list of polygons", walls)
    unknown = fields.get("unknown_is_free", False)
    require_switch("grid.unknown_is_free", unknown)
    try:
        found = read_map(path.parent / name, unknown_is_free=unknown)
    except OSError as error:
        rule = f"a file that can be read ({error.strerror})"
        raise ArgumentError("grid.file", rule, name) from None
    bounds = {"lower": found.lower, "upper": found.upper}
    return {**bounds, **given, "walls": [*walls, *found.walls(fields.get("coarsen", 1))]}


def _fields_of(name: str, given: object, known: tuple[str, ...]) -> Mapping[str, Any]:
    if not isinstance(given, Mapping):
        raise ArgumentError(name, f"fields with values ({', '.join(known)})", given)
    for field in given:
        require_one_of(known, f"field of {name}", field)
    return given


class SingleIntercept(Single[SingleInterceptSettings]):
    """One case in which a car meets a target among walls and moving obstacles."""

    def case(self) -> InterceptCase:
        """Read the case from the file of the option `--map`."""
        return read_case(Path(self.settings.map))

    def contact(self, answer: Answer) -> list[str]:
        """Describe the meeting, and the least distances from obstacles, in one sentence."""
        verdict, (x, y) = answer.verdict, np.asarray(answer.plan.meeting)
        near = {"walls": verdict.wall_clearance, "movers": verdict.mover_clearance}
        gaps = [f"{float(gap):.3f} m from {name}" for name, gap in near.items() if np.isfinite(gap)]
        distances = f"; least distance {' and '.join(gaps)}" if gaps else ""
        return [
            f"Met at {float(verdict.meeting_time):.3f} s at ({x:.3f}, {y:.3f}) m, at "
            f"{float(answer.plan.speed[-1]):.2f} m/s, {1e3 * float(verdict.miss):.1f} mm from the "
            f"target{distances}."
        ]

    def describe(self, answer: Answer) -> list[str]:
        """Describe the answer, and limits with which an unsolved case has a plan, in lines."""
        lines = super().describe(answer)
        if not answer.success and is_unsolved(int(answer.plan.status)):
            found = relaxation(answer.case, answer.plan, self.planner())
            if found is not None:
                lines.insert(1, f"Relaxation: {found.sentence()}.")
        return lines

    def task_margins(self, answer: Answer) -> list[Margin]:
        """Return the margins of the body's distance from the target, and of the car's limits."""
        plan, limits, verdict = answer.plan, answer.case.limits, answer.verdict
        motion = drawing.sample_motion(plan.start, plan.time, plan.speed, plan.curvature, _SAMPLES)
        time, speed, curvature = motion["time"], motion["speed"], motion["curvature"]
        angle = np.arctan(float(answer.case.body.wheelbase) * curvature)
        knots = np.linspace(0.0, float(plan.time), np.size(plan.speed))
        jerk = np.diff(np.asarray(plan.speed, float), 2) / knots[1] ** 2
        quantities = {
            "speed [m/s]": (speed, limits.speed),
            "acceleration [m/s^2]": (motion["acceleration"], limits.acceleration),
            "lateral acceleration [m/s^2]": (speed**2 * curvature, limits.lateral_acceleration),
            "curvature [1/m]": (curvature, limits.curvature),
            "steering rate [rad/s]": (np.gradient(angle, time), limits.steering_rate),
            "jerk [m/s^3]": (jerk, np.inf if limits.jerk is None else limits.jerk),
        }
        margins = [
            closest_to(knots[1:] if values is jerk else time, words, np.abs(values), allowed)
            for words, (values, allowed) in quantities.items()
            if np.isfinite(allowed)
        ]
        off, end = float(verdict.miss), float(verdict.meeting_time)
        words = "target to body's middle [m]"
        return [Margin(words, off, float(answer.case.tolerance), end), *margins]

    def margins(self, answer: Answer) -> list[Margin]:
        """Return how close the plan comes to each limit of the car, and to its target."""
        return self.task_margins(answer)
