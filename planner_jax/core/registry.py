"""Tasks, planners and suites by name: the library's own, and those of other packages.

Another package offers its own by entry points, without an edit of this one:

    [project.entry-points."planner_jax.tasks"]
    meet = "my_package.meet:TASK"
    [project.entry-points."planner_jax.planners"]
    "hit.mine" = "my_package.planners:MyHit"
    [project.entry-points."planner_jax.suites"]
    "catch.gusts" = "my_package.suites:draw_gusts"

Nothing here imports JAX, so that names can be listed quickly.
"""

import dataclasses
import functools
import pkgutil
import warnings
from collections.abc import Callable, Collection, Mapping
from importlib import metadata
from typing import Any

from planner_jax.core.errors import ArgumentTypeError, UnknownName

_GROUP = "planner_jax"
_OWN = {
    name: f"planner_jax.task.{name}.spec:TASK"
    for name in ("hit", "catch", "intercept", "group", "block")
}


@dataclasses.dataclass(frozen=True)
class Task:
    """What makes a task: its four words, planners, suites, and what runs of it need.

    Objects are named as "module:attribute" and imported when they are needed.
    """

    name: str  # on the command line
    summary: str  # one line, without a full stop
    home: str  # module with the functions `case`, `draw`, `planner` and `judge`
    planners: Mapping[str, str]  # name -> what makes the planner of given options; default first
    suites: Mapping[str, str]  # name -> what it draws, a sentence; default first
    # Planners that are read from a file, such as "library:motions.bin" -> what makes the file.
    from_file: Mapping[str, str] = dataclasses.field(default_factory=dict)
    # Classes of the settings of its sweeps, and of its flights in `sims`; they name what runs them.
    sweep: str = "planner_jax.runs.settings:SweepSettings"
    flight: str | None = None
    # Class of the settings of one case that is asked for in a few numbers; they name what answers.
    single: str | None = None
    # Options of `planner` where its speed is measured.
    bench: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    contact: str | None = None  # place in a plan of its times of contact, such as "stroke.time"
    # The planner with whose costs those of planners are compared that have no longer search.
    yardstick: str | None = None

    @property
    def case(self) -> Callable[..., Any]:
        """Makes one case, or a batch, of physical quantities."""
        return self._word("case")

    @property
    def draw(self) -> Callable[..., Any]:
        """`draw(num, suite=None, seed=0, *, first=0)`: a batch of a suite.

        Case k of a seed is always the same one: `first` is the place of the first.
        """
        return self._word("draw")

    @property
    def planner(self) -> Callable[..., Any]:
        """`planner(name, **options)`."""
        return self._word("planner")

    @property
    def judge(self) -> Callable[..., Any]:
        """`judge(cases, plans)`: the referee's verdict."""
        return self._word("judge")

    def all_planners(self) -> dict[str, str | metadata.EntryPoint]:
        """Planners by name, those of other packages behind the task's own."""
        return {**self.planners, **_offered("planners", self.name, self.planners)}

    def all_suites(self) -> dict[str, str]:
        """Suites and what they draw, those of other packages behind the task's own."""
        others = _offered("suites", self.name, self.suites)
        return {**self.suites, **{name: f"{entry.value}." for name, entry in others.items()}}

    def split_planner(self, name: object) -> tuple[str, str]:
        """The key of `all_planners` in a planner's name, and its file, or nothing.

        Raises:
            UnknownName: there is no planner of that name, or it needs a file or takes none.
        """
        planner, file = split_name(self.all_planners(), "planner", name, self.from_file)
        if planner in self.from_file and not file:
            raise UnknownName(
                "planner",
                f"its file, as in {planner}:FILE, which `{self.from_file[planner]}` makes",
                name,
                verb="name",
            )
        return planner, file

    def make_planner(self, name: object, options: Mapping[str, Any]) -> Any:
        """The planner of a name.

        Args:
            name: a key of `all_planners`; of those in `from_file` with ":" and the file behind it.
            options: keyword arguments of what makes it, which also takes the file first.

        Raises:
            UnknownName: there is no planner of that name, or it needs a file or takes none.
            TypeError: the planner has no such option.
        """
        planner, file = self.split_planner(name)
        maker = _resolved(self.all_planners()[planner])
        if isinstance(maker, type) and dataclasses.is_dataclass(maker):
            known = [field.name for field in dataclasses.fields(maker) if field.init]
            for option in options:
                if option not in known:
                    rule = f"one of {', '.join(known)}" if known else "left out"
                    raise ArgumentTypeError(f"option of planner {planner}", rule, option)
        return maker(*filter(None, [file]), **options)

    def other_suite(self, name: object) -> Callable[..., Any]:
        """What draws a suite of another package: `draw(num, seed, first)`.

        Raises:
            UnknownName: there is no suite of that name.
        """
        require_name(self.all_suites(), "suite", name)
        return _resolved(_offered("suites", self.name, self.suites)[name])

    def _word(self, word: str) -> Callable[..., Any]:
        return pkgutil.resolve_name(f"{self.home}:{word}")


def require_name(known: Mapping[str, Any], kind: str, name: object) -> None:
    """Raise `UnknownName` unless a name is known."""
    if not isinstance(name, str):
        raise UnknownName(kind, "a name", name)
    if name not in known:
        raise UnknownName(kind, f"one of {', '.join(known)}", name)


def suite_named(name: object, default: str) -> str:
    """The name of a suite, or the default where none is given.

    Raises:
        UnknownName: it is no name.
    """
    if name is not None and not isinstance(name, str):
        raise UnknownName("suite", "a name", name)
    return name or default


def split_name(
    known: Mapping[str, Any], kind: str, name: object, from_file: Collection[str] = ()
) -> tuple[str, str]:
    """A known name and the file behind it, as in "policy:FILE", or nothing.

    Args:
        known: names.
        kind: what they are names of, for the message.
        name: one of them, with ":" and a file behind it or without.
        from_file: those that may have one.

    Raises:
        UnknownName: it is not known, or takes no file.
    """
    own, _, file = name.partition(":") if isinstance(name, str) else (name, "", "")
    require_name(known, kind, own)
    if own != name and own not in from_file:
        raise UnknownName(kind, f"{own} without a file", name)
    if own != name and not file:
        raise UnknownName(kind, f"a file behind {own}:", name, verb="name")
    return own, file


def task_named(name: object) -> Task:
    """The task of a name, of the library or of another package.

    Raises:
        UnknownName: there is none; one line.
    """
    tasks = all_tasks()
    require_name(tasks, "task", name)
    return tasks[name]


@functools.cache
def all_tasks() -> dict[str, Task]:
    """Tasks by name; one of another package that does not work is left out with a warning."""
    tasks = {name: pkgutil.resolve_name(path) for name, path in _OWN.items()}
    for entry in metadata.entry_points(group=f"{_GROUP}.tasks"):
        problem = f"the name is taken by {tasks[entry.name].home}" if entry.name in tasks else ""
        found: Any = None
        if not problem:
            try:
                found = entry.load()
            except Exception as error:  # whatever it is, it is the other package's
                problem = f"{type(error).__name__}: {error}"
            else:
                if not isinstance(found, Task) or found.name != entry.name:
                    problem = f"it is not a Task of that name, got {found!r:.60}"
        if problem:
            warnings.warn(
                f"task {entry.name!r} of {entry.value} is left out: {problem}", stacklevel=2
            )
        else:
            tasks[entry.name] = found
    return tasks


def _offered(kind: str, task: str, own: Mapping[str, Any]) -> dict[str, metadata.EntryPoint]:
    """What other packages offer for a task, by name; a name that is taken is left out."""
    found = {}
    for entry in metadata.entry_points(group=f"{_GROUP}.{kind}"):
        of, _, name = entry.name.partition(".")
        if of == task and name in {*own, *found}:
            warnings.warn(
                f"{kind} {entry.name!r} of {entry.value} is left out, as the name is taken",
                stacklevel=3,
            )
        elif of == task:
            found[name] = entry
    return found


def _resolved(place: str | metadata.EntryPoint) -> Any:
    if isinstance(place, str):
        return pkgutil.resolve_name(place)
    try:
        return place.load()
    except Exception as error:  # whatever it is, it is the other package's
        why = f"{type(error).__name__}: {error}"
        name = f"{place.name} of {place.value}"
        raise UnknownName(name, "one that can be loaded", shown=why) from error
