"""Settings of runs, whose fields are the options of the command line. JAX is not imported."""

import dataclasses
import os
from typing import Any, ClassVar, Self, TypeVar

from planner_jax.core.choices import (
    CHOICES,
    NONE,
    require,
    require_one_of,
    require_seed,
    require_size,
)
from planner_jax.core.errors import ArgumentError, PlannerJaxError
from planner_jax.core.registry import Task, require_name
from planner_jax.core.room import require_disk

AnySettings = TypeVar("AnySettings", bound="SweepSettings")
KnownSettings = TypeVar("KnownSettings")
Options = dict[str, Any]  # keyword arguments: values by name


class WorkersFailed(PlannerJaxError, RuntimeError):
    """Error: worker processes could not plan a chunk of cases; the run can be resumed."""


def option(default: object, metavar: str, text: str) -> Any:
    """Return a dataclass field for a command-line option; "" as `metavar` makes a flag."""
    return dataclasses.field(default=default, metadata={"metavar": metavar, "help": text})


def recovery_option(usual: str = NONE) -> str:
    """Return a dataclass field for the option `recovery`, with the default value `usual`.

    The option selects the trajectory after the quadrotor's last contact: "none"; "brake", to
    standstill at any position; or "home", to the start position.
    """
    words = f"trajectory after the last contact, within all limits: {', '.join(CHOICES)}"
    return option(usual, "NAME", words)


def recovery_options(value: str) -> dict[str, str]:
    """Return the planner's keyword arguments for the option `recovery`, which are {} for "none"."""
    require_one_of(CHOICES, "recovery", value)
    return {} if value == NONE else {"recovery": value}


def require_count(name: str, value: int | None, least: int, *, none: bool = False) -> None:
    """Raise unless a setting is a whole number >= `least`; with `none`, None is accepted too."""
    if value is not None or not none:
        require_size(name, value, least)  # type: ignore[arg-type]


@dataclasses.dataclass(frozen=True)
class SweepSettings:
    """Settings of a sweep (run over many cases) of any task; subclasses add a task's settings."""

    planner: str | None = option(None, "NAME", "")  # None selects the task's first planner
    suite: str | None = option(None, "NAME", "")  # None selects the task's first suite
    # None selects `DEFAULT_NUM` drawn cases, or all cases of a folder if cases are read from files.
    num: int | None = option(None, "N", "number of cases")
    batch: int | None = option(
        None, "B", "cases planned, judged and written at once; bounds the memory"
    )
    seed: int = option(0, "K", "seed of the drawn cases")

    # Subclass of `Sweep` that runs the sweep, as "module:Class"; "" stands for `Sweep` itself.
    RUN: ClassVar[str] = ""
    DEFAULT_NUM: ClassVar[int] = 1000  # number of cases if the settings specify none
    CASE_BYTES: ClassVar[int] = 20_000  # [bytes] estimated memory of one case of a batch
    ROW_BYTES: ClassVar[int] = 1_000  # [bytes] estimated size of one row on the disk
    CPU_BATCH: ClassVar[int] = 1024  # default number of cases in a batch on a CPU
    GPU_BATCH: ClassVar[int] = 65536  # default number of cases in a batch on a GPU
    # Names of the fields that are keyword arguments of the task's `planner`, `draw` and `judge`.
    PLANNER: ClassVar[tuple[str, ...]] = ()
    DRAW: ClassVar[tuple[str, ...]] = ()
    JUDGE: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for name, value in (("num", self.num), ("batch", self.batch)):
            require_count(name, value, 1, none=True)
        require_seed(self.seed)

    def of(self, task: Task) -> Self:
        """Return the settings; None as planner or suite is replaced by the task's default."""
        planners, suites = task.all_planners(), task.all_suites()
        planner = next(iter(planners)) if self.planner is None else self.planner
        suite = next(iter(suites)) if self.suite is None else self.suite
        task.split_planner(str(planner))
        require_name(suites, "suite", str(suite))
        return dataclasses.replace(self, planner=planner, suite=suite)

    @property
    def case_bytes(self) -> int:
        """Estimated memory [bytes] of one case of a batch while it is planned and judged."""
        return self.CASE_BYTES

    def require_disk_space(self, out: str | os.PathLike) -> None:
        """Raise `ArgumentError` if the disk of the folder `out` has no space for all rows."""
        require_disk("num", self.num or self.DEFAULT_NUM, self.ROW_BYTES, out)

    def parameters(self) -> Options:
        """Return the settings as plain values for `manifest.json`, by the names of the fields."""
        return dataclasses.asdict(self)

    def planner_options(self) -> Options:
        """Return the settings that are keyword arguments of the task's function `planner`."""
        return self._values(self.PLANNER)

    def draw_options(self) -> Options:
        """Return the settings that are keyword arguments of the task's function `draw`."""
        return {k: value for k, value in self._values(self.DRAW).items() if value is not None}

    def judge_options(self) -> Options:
        """Return the settings that are keyword arguments of the task's function `judge`."""
        return self._values(self.JUDGE)

    def _values(self, names: tuple[str, ...]) -> Options:
        return {name: vars(self)[name] for name in names}


def settings_to_resume(kind: type[AnySettings], parameters: Options, given: Options) -> AnySettings:
    """Return the stored settings of a run; raise if a setting in `given` has another value."""
    settings = settings_of_manifest(kind, parameters, "out")
    asked = dataclasses.replace(settings, **given)
    for name in given:
        part, old, new = _difference(name, vars(settings)[name], vars(asked)[name])
        require(new == old, part, f"{old} as in the run that is resumed", new, shown=str(new))
    return settings


def settings_of_manifest(
    kind: type[KnownSettings], parameters: Options, name: str
) -> KnownSettings:
    """Return a run's settings from its manifest; if invalid, raise an error about option `name`."""
    try:
        return kind(**parameters)
    except (TypeError, ValueError) as error:
        rule = "a run with settings of this version"
        raise ArgumentError(name, rule, shown=f"others: {error}") from None


def _difference(name: str, old: object, new: object) -> tuple[str, object, object]:
    if dataclasses.is_dataclass(old) and dataclasses.is_dataclass(new) and type(old) is type(new):
        for field in dataclasses.fields(old):
            mine, other = vars(old)[field.name], vars(new)[field.name]
            if mine != other:
                return _difference(f"{name}.{field.name}", mine, other)
    return name, old, new
