"""Registry of tasks, planners and suites by name, from this library and from other packages.

Another package registers its objects by entry points in its `pyproject.toml`:

    [project.entry-points."planner_jax.tasks"]
    meet = "my_package.meet:TASK"
    [project.entry-points."planner_jax.planners"]
    "hit.mine" = "my_package.planners:MyHit"
    [project.entry-points."planner_jax.suites"]
    "catch.gusts" = "my_package.suites:draw_gusts"

This module does not import JAX, so that names can be listed quickly.
"""

import dataclasses
import pkgutil
import warnings
from collections.abc import Callable, Collection, Mapping
from importlib import metadata
from typing import TYPE_CHECKING

from planner_jax.core.errors import ArgumentTypeError, UnknownName

if TYPE_CHECKING:
    from jaxtyping import PyTree

    from planner_jax.core.planner import Planner

GROUP = "planner_jax"


@dataclasses.dataclass(frozen=True)
class Task:
    """The description of a task: its functions, planners and suites, and settings of its runs.

    Objects are named as "module:attribute" and imported on first use.

    Attributes:
        name: name of the task on the command line.
        summary: one line about the task, without a full stop.
        home: name of the module with the functions `case`, `draw`, `planner` and `judge`.
        planners: class or function that makes each planner, by name; the default planner is the
            first.
        suites: a sentence about the cases of each suite, by name; the default suite is the first.
        from_file: command that writes the file of each planner that reads one, such as "library".
        sweep: name of the class with the settings of the task's sweeps (runs of many cases).
        flight: class with the settings of the task's simulated flights; None: no flights.
        single: name of the class with the options of `planner-jax plan`, which specify one case;
            None: no such command.
        bench: keyword arguments with which speed benchmarks call `planner`.
        contact: dotted name of the contact times in a plan, such as "stroke.time".
        yardstick: keyword arguments of `planner` for the planner with whose costs others are
            compared; empty: none. Planners that minimise a cost are compared with a longer search
            of their own.
    """

    name: str
    summary: str
    home: str
    planners: Mapping[str, str]
    suites: Mapping[str, str]
    from_file: Mapping[str, str] = dataclasses.field(default_factory=dict)
    sweep: str = "planner_jax.runs.settings:SweepSettings"
    flight: str | None = None
    single: str | None = None
    bench: Mapping[str, object] = dataclasses.field(default_factory=dict)
    contact: str | None = None
    yardstick: Mapping[str, object] = dataclasses.field(default_factory=dict)

    @property
    def case(self) -> "Callable[..., PyTree]":
        """Function that makes one case, or a batch, from physical quantities."""
        return self._function("case")

    @property
    def draw(self) -> "Callable[..., PyTree]":
        """Function `draw(num, suite, seed, first)`: a suite's random cases from number `first`."""
        return self._function("draw")

    @property
    def planner(self) -> "Callable[..., Planner]":
        """Function `planner(name, **options)`, which makes the planner with this name."""
        return self._function("planner")

    @property
    def judge(self) -> "Callable[..., PyTree]":
        """Function `judge(cases, plans)`, which checks plans independently of the planners."""
        return self._function("judge")

    def all_planners(self) -> dict[str, str | metadata.EntryPoint]:
        """Return planners by name, the task's own before planners of other packages."""
        return {**self.planners, **_other_entries("planners", self.name, self.planners)}

    def all_suites(self) -> dict[str, str]:
        """Return descriptions of suites by name, the task's own before other packages' suites."""
        others = _other_entries("suites", self.name, self.suites)
        return {**self.suites, **{name: f"{entry.value}." for name, entry in others.items()}}

    def split_planner(self, name: object) -> tuple[str, str]:
        """Split a name such as "library:FILE" into planner and file, or raise `UnknownName`."""
        planner, file = split_name(self.all_planners(), "planner", name, self.from_file)
        if planner in self.from_file and not file:
            raise UnknownName(
                "planner",
                f"its file, as in {planner}:FILE, which `{self.from_file[planner]}` makes",
                name,
                verb="name",
            )
        return planner, file

    def make_planner(self, name: object, options: Mapping[str, object]) -> "Planner":
        """Make the planner of a name and options, or raise `UnknownName` or `ArgumentTypeError`."""
        planner, file = self.split_planner(name)
        maker = _load(self.all_planners()[planner])
        _require_options(planner, maker, options)
        return maker(*filter(None, [file]), **options)

    def other_suite(self, name: object) -> "Callable[..., PyTree]":
        """Return the function `draw(num, seed, first)` of a suite of another package."""
        suite = require_name(self.all_suites(), "suite", name)
        return _load(_other_entries("suites", self.name, self.suites)[suite])

    def _function(self, name: str) -> "Callable[..., PyTree]":
        return pkgutil.resolve_name(f"{self.home}:{name}")


def require_name(known: Collection[str], kind: str, name: object) -> str:
    """Return a name if it is known, else raise `UnknownName` about a `kind` such as "planner"."""
    if not isinstance(name, str):
        raise UnknownName(kind, "a name", name)
    if name not in known:
        raise UnknownName(kind, f"one of {', '.join(known)}", name)
    return name


def _require_options(planner: str, maker: object, options: Collection[str]) -> None:
    owner = getattr(maker, "__self__", maker)  # of `Problem.planner`
    if isinstance(owner, type) and dataclasses.is_dataclass(owner):
        known = [field.name for field in dataclasses.fields(owner) if field.init]
        known += ["attempts"] if owner is not maker else []
        for option in options:
            if option not in known:
                rule = f"one of {', '.join(known)}" if known else "left out"
                raise ArgumentTypeError(f"option of planner {planner}", rule, option)


def suite_named(name: object, default: str) -> str:
    """Return a suite's name, or the default for None; raise `UnknownName` if it is no text."""
    if name is not None and not isinstance(name, str):
        raise UnknownName("suite", "a name", name)
    return default if name is None else name


def split_name(
    known: Collection[str], kind: str, name: object, from_file: Collection[str] = ()
) -> tuple[str, str]:
    """Split a name such as "policy:FILE" into ("policy", "FILE"), or raise `UnknownName`.

    The first part must be in `known`; only a name in `from_file` may have a file. `kind`, such as
    "planner", stands in the error message.
    """
    own, _, file = name.partition(":") if isinstance(name, str) else (name, "", "")
    own = require_name(known, kind, own)
    if own != name and own not in from_file:
        raise UnknownName(kind, f"{own} without a file", name)
    if own != name and not file:
        raise UnknownName(kind, f"a file behind {own}:", name, verb="name")
    return own, file


def _other_entries(kind: str, task: str, own: Collection[str]) -> dict[str, metadata.EntryPoint]:
    """Return the entry points by which other packages add planners or suites to a task, by name.

    `kind` is "planners" or "suites". An entry with a name in `own`, the task's own names, is left
    out with a warning.
    """
    found = {}
    for entry in metadata.entry_points(group=f"{GROUP}.{kind}"):
        of, _, name = entry.name.partition(".")
        if of == task and name in {*own, *found}:
            warnings.warn(
                f"{kind} {entry.name!r} of {entry.value} is left out, as the name is taken",
                stacklevel=3,
            )
        elif of == task:
            found[name] = entry
    return found


def _load(source: str | metadata.EntryPoint) -> "Callable[..., PyTree]":
    if isinstance(source, str):
        return pkgutil.resolve_name(source)
    try:
        return source.load()
    except Exception as error:  # of any class: the other package raises it
        why = f"{type(error).__name__}: {error}"
        name = f"{source.name} of {source.value}"
        raise UnknownName(name, "one that can be loaded", shown=why) from error
