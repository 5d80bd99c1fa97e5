"""The tasks of this library and of other packages, by name."""

import functools
import pkgutil
import warnings
from importlib import metadata

from planner_jax.core.registry import GROUP, Task, require_name

_OWN = {
    name: f"planner_jax.task.{name}.spec:TASK"
    for name in ("hit", "rally", "catch", "team", "intercept", "group", "block", "reach")
}


def task_named(name: object) -> Task:
    """Return the task with this name, of this library or another package; else `UnknownName`."""
    tasks = all_tasks()
    return tasks[require_name(tasks, "task", name)]


@functools.cache
def all_tasks() -> dict[str, Task]:
    """Return tasks by name; other packages' tasks that fail to load are left out with a warning."""
    tasks = {name: pkgutil.resolve_name(path) for name, path in _OWN.items()}
    for entry in metadata.entry_points(group=f"{GROUP}.tasks"):
        problem = f"the name is taken by {tasks[entry.name].home}" if entry.name in tasks else ""
        found: object = None
        if not problem:
            try:
                found = entry.load()
            except Exception as error:  # of any class: the other package raises it
                problem = f"{type(error).__name__}: {error}"
            else:
                if not isinstance(found, Task) or found.name != entry.name:
                    problem = f"it is not a Task of that name, got {found!r:.60}"
        if isinstance(found, Task) and not problem:
            tasks[entry.name] = found
        else:
            warnings.warn(
                f"task {entry.name!r} of {entry.value} is left out: {problem}", stacklevel=2
            )
    return tasks
