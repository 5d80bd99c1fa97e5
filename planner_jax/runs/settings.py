"""Settings of a run, checked before anything is read, compiled or written.

Settings are frozen dataclasses; the options of the command line are made from their fields. Nothing
here imports JAX.
"""

import dataclasses
import os
from typing import Any, ClassVar, Self, TypeVar

from planner_jax.core.choices import (
    CHOICES,
    NONE,
    require,
    require_disk,
    require_one_of,
    require_seed,
    require_size,
)
from planner_jax.core.errors import ArgumentError, PlannerJaxError
from planner_jax.core.registry import Task, require_name

AnySettings = TypeVar("AnySettings", bound="SweepSettings")
KnownSettings = TypeVar("KnownSettings")
Options = dict[str, Any]  # values by the names of their fields


class WorkersFailed(PlannerJaxError, RuntimeError):
    """Workers could not make a chunk of a run: "workers must RULE". The run can be resumed."""


def option(default: object, metavar: str, text: str) -> Any:
    """Return a field of settings with its help text; a switch has no `metavar`."""
    return dataclasses.field(default=default, metadata={"metavar": metavar, "help": text})


def recovery_option(usual: str = NONE) -> str:
    """Return the field `recovery` of the settings of a task of quadrotors."""
    words = f"flown behind the last contact, within all limits: {', '.join(CHOICES)}"
    return option(usual, "NAME", words)


def recovery_options(value: str) -> dict[str, str]:
    """Return the options of a planner for the setting `recovery`; raise unless it is known."""
    require_one_of(CHOICES, "recovery", value)
    return {} if value == NONE else {"recovery": value}


def require_count(name: str, value: int | None, least: int, *, none: bool = False) -> None:
    """Raise unless a value is a whole number >= `least`; None is accepted if `none` is set."""
    if value is not None or not none:
        require_size(name, value, least)  # type: ignore[arg-type]


@dataclasses.dataclass(frozen=True)
class SweepSettings:
    """Settings that the sweeps of all tasks have; the class of a task adds its own.

    Together the settings decide every number of the rows of a run. A value that breaks its rule
    raises `ArgumentError`.
    """

    planner: str | None = option(None, "NAME", "")  # None selects the first of the task
    suite: str | None = option(None, "NAME", "")  # None selects the first of the task
    # None: `DEFAULT_NUM`, or all of a folder
    num: int | None = option(None, "N", "number of cases")
    batch: int | None = option(
        None, "B", "cases planned, judged and written at once; bounds the memory"
    )
    seed: int = option(0, "K", "seed of the drawn cases")

    RUN: ClassVar[str] = ""  # subclass of `Sweep`, "module:Class"; "" is `Sweep` itself
    DEFAULT_NUM: ClassVar[int] = 1000
    # Estimates of the memory of a case in a batch, and of the size of a row on the disk.
    CASE_BYTES: ClassVar[int] = 20_000
    ROW_BYTES: ClassVar[int] = 1_000
    CPU_BATCH: ClassVar[int] = 1024
    GPU_BATCH: ClassVar[int] = 65536
    # Names of the fields that are options of the task's `planner`, `draw` and `judge`.
    PLANNER: ClassVar[tuple[str, ...]] = ()
    DRAW: ClassVar[tuple[str, ...]] = ()
    JUDGE: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for name, value in (("num", self.num), ("batch", self.batch)):
            require_count(name, value, 1, none=True)
        require_seed(self.seed)

    def of(self, task: Task) -> Self:
        """Return the settings with the task's planner and suite; None selects the first."""
        planners, suites = task.all_planners(), task.all_suites()
        filled = dataclasses.replace(
            self,
            planner=next(iter(planners)) if self.planner is None else self.planner,
            suite=next(iter(suites)) if self.suite is None else self.suite,
        )
        task.split_planner(str(filled.planner))
        require_name(suites, "suite", str(filled.suite))
        return filled

    @property
    def case_bytes(self) -> int:
        """Memory [bytes] of one case of a batch while it is planned, judged and written."""
        return self.CASE_BYTES

    def require_disk_space(self, out: str | os.PathLike) -> None:
        """Raise `ArgumentError` if the rows of the run do not fit on the disk of `out`."""
        require_disk("num", self.num or self.DEFAULT_NUM, self.ROW_BYTES, out)

    def parameters(self) -> Options:
        """Return the settings as plain values for `manifest.json`; the class accepts them again."""
        return dataclasses.asdict(self)

    def planner_options(self) -> Options:
        """Return the options of the planner that these settings decide."""
        return self._values(self.PLANNER)

    def draw_options(self) -> Options:
        """Return the options of the task's `draw` that these settings decide, without None."""
        return {k: value for k, value in self._values(self.DRAW).items() if value is not None}

    def judge_options(self) -> Options:
        """Return the options of the task's `judge` that these settings decide."""
        return self._values(self.JUDGE)

    def _values(self, names: tuple[str, ...]) -> Options:
        return {name: vars(self)[name] for name in names}


def settings_to_resume(kind: type[AnySettings], parameters: Options, given: Options) -> AnySettings:
    """Return the settings of a run that is resumed, after a check of the settings passed again.

    Raises:
        ArgumentError: a passed value differs from the run's, or these are not of `kind`.
    """
    settings = settings_of_manifest(kind, parameters, "out")
    asked = dataclasses.replace(settings, **given)
    for name in given:
        part, old, new = _difference(name, vars(settings)[name], vars(asked)[name])
        require(new == old, part, f"{old} as in the run that is resumed", new, shown=str(new))
    return settings


def settings_of_manifest(
    kind: type[KnownSettings], parameters: Options, name: str
) -> KnownSettings:
    """Return the settings of a run; `name` is the argument that holds its folder.

    Raises:
        ArgumentError: the parameters do not fit the class, as another version wrote them.
    """
    try:
        return kind(**parameters)
    except (TypeError, ValueError) as error:
        rule = "a run with settings of this version"
        raise ArgumentError(name, rule, shown=f"others: {error}") from None


def _difference(name: str, old: object, new: object) -> tuple[str, object, object]:
    """Return name and both values of the first field in which two settings differ."""
    if dataclasses.is_dataclass(old) and dataclasses.is_dataclass(new) and type(old) is type(new):
        for field in dataclasses.fields(old):
            mine, other = vars(old)[field.name], vars(new)[field.name]
            if mine != other:
                return _difference(f"{name}.{field.name}", mine, other)
    return name, old, new
