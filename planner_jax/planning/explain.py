"""The function `explain`: which changes of a planner and its cases compile a program anew."""

import dataclasses
import reprlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from planner_jax.core.planner import Planner, require_fit
from planner_jax.core.rules import Case


def explain(planner: Planner, cases: Case) -> None:
    """Print which changes of a planner and its cases need another compiled program.

    The first part lists the arrays: other numbers in them need no compilation, other shapes and
    types do. The second part lists the settings that are compiled into a program. This holds for
    functions of yours under `jax.jit` whose arguments are the planner and the cases. `pj.plan`
    compiles less often: it pads arrays, and attempts that differ only in numbers share a program.

    Args:
        planner: a planner such as `pj.catch.planner()`.
        cases: one case of the planner's task, or a batch.

    Raises:
        TypeError: the cases belong to another task than the planner.
    """
    require_fit(planner, cases)
    parts = [*_describe("planner", planner), *_describe("cases", cases)]
    titles = {
        True: "data: other numbers need no compilation, other shapes and types do",
        False: "static: every other value, or another class, compiles a program",
    }
    for is_data, title in titles.items():
        print(
            title, *(f"  {name}: {text}" for name, text, data in parts if data is is_data), sep="\n"
        )


def _describe(name: str, node: PyTree, is_static: bool = False) -> Iterator[tuple[str, str, bool]]:
    """Yield for each array or setting its name, a short text, and whether it is data."""
    if not is_static and jax.tree_util.all_leaves([node]):
        yield name, f"{np.shape(node)} {jnp.result_type(node)}", True
        return
    pairs = [] if is_static else jax.tree_util.tree_leaves_with_path(node, lambda x: x is not node)
    children = {jax.tree_util.keystr(path, simple=True): child for path, child in pairs}
    fields = dataclasses.fields(node) if dataclasses.is_dataclass(node) else ()
    settings = {each.name: getattr(node, each.name) for each in fields if each.name not in children}
    if not children and not settings:
        yield name, reprlib.repr(node), False
    for inner, child in children.items():
        yield from _describe(f"{name}.{inner}", child)
    for inner, value in settings.items():
        yield from _describe(f"{name}.{inner}", value, True)
