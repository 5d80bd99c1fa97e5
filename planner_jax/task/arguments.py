"""Checks and conversions of arguments of every task's `case`, `draw`, `planner` and `judge`."""

import inspect
import zlib
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from planner_jax.core import checks
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.origin import has_origin
from planner_jax.core.protocol import Plan, take
from planner_jax.core.rules import NOT_NEGATIVE, Case

TreeT = TypeVar("TreeT")

_FEW = 1000  # number of drawn cases that fit in every memory
_DRAWN_BYTES = 1_000  # [B], estimated memory of one case of a suite


def array_of(
    name: str, value: object, *shape: int, batch: tuple[int, ...], dtype: DTypeLike
) -> Array:
    """Return the argument `value` as an array of the shape `batch + shape` and the type `dtype`.

    A value of the shape `shape` is repeated for every case of the batch. For any other shape an
    `ArgumentError` is raised, which names the argument.
    """
    numbers = checks.numbers_of(name, value, batch, shape)
    with np.errstate(over="ignore"):  # a number too large for `dtype` becomes infinite, no warning
        if isinstance(numbers, np.ndarray):
            numbers = numbers.astype(dtype)  # JAX would compile a program for each shape
        return jnp.asarray(numbers, dtype)


def repeat_leaves(tree: TreeT, *, batch: tuple[int, ...], dtype: DTypeLike) -> TreeT:
    """Return a tree without batch axes with its arrays repeated for every case of a batch.

    Arrays of floating-point numbers become arrays of the type `dtype`.
    """

    def repeat(value: ArrayLike) -> Array:
        value = np.asarray(value)
        kind = np.dtype(dtype) if value.dtype.kind == "f" else value.dtype
        return jnp.asarray(np.broadcast_to(value.astype(kind), batch + value.shape), kind)

    return jax.tree.map(repeat, tree)


def batch_of(name: str, vectors: object, *shape: int) -> tuple[int, ...]:
    """Return the batch shape of an argument: its leading axes, before the trailing `shape`."""
    found = checks.shape_of(name, vectors)
    split = len(found) - len(shape)
    if split < 0 or found[split:] != shape:
        ends = ", ".join(map(str, shape))
        raise ArgumentError(name, f"a shape that ends with ({ends},)", found, verb="have")
    if 0 in found[:split]:
        raise ArgumentError(name, "at least one case", verb="hold", shown=f"the shape {found}")
    return found[:split]


def require_draw(num: int, seed: int, first: int) -> None:
    """Raise unless num >= 1, seed >= 0, first case's index >= 0, and `num` cases fit in memory."""
    for name, value, least in (("num", num, 1), ("seed", seed, 0), ("first", first, 0)):
        require_size(name, value, least)
    if num > _FEW:
        from planner_jax.core.room import require_memory  # few cases always fit

        require_memory("num", num, _DRAWN_BYTES)


def make_generators(suite: str, num: int, seed: int, first: int) -> list[np.random.Generator]:
    """Make one random generator for each of `num` cases, from suite, seed and the case's index."""
    require_draw(num, seed, first)
    tag = zlib.crc32(suite.encode())
    return [np.random.default_rng([seed, first + k, tag]) for k in range(num)]


VerdictT = TypeVar("VerdictT")


def judge_by(
    referee: Callable[..., VerdictT],
    cases: Case,
    plans: Plan,
    kinds: tuple[type[Case], type[Plan]],
    settings: dict[str, object],
) -> VerdictT:
    """Check the arguments of a task's function `judge`, and return the verdict of its referee.

    `kinds` are the required classes of the cases and of the plans.
    """
    checks.require_kind("cases", cases, kinds[0])
    checks.require_kind("plans", plans, kinds[1])
    require_settings(referee, settings)
    checks.require_values("judge", cases, plans)
    for leaf in jax.tree.leaves((cases, plans)):
        if checks.numeric(leaf) is None:
            raise ArgumentTypeError("cases and plans", "numbers", leaf, verb="hold")
    if (num := np.shape(plans.status)) != cases.batch_shape:
        rule = f"the batch shape of the cases, {cases.batch_shape}"
        raise ArgumentError("plans", rule, num, verb="have")
    if not has_origin(plans, cases):
        raise ArgumentError("plans", "the origin of the cases", verb="have", shown="")
    if alone := cases.batch_shape == ():
        cases, plans = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (cases, plans))
    verdict = referee(cases, plans, **settings)
    return take(verdict, 0) if alone else verdict


def require_settings(referee: Callable[..., object], settings: dict[str, object]) -> None:
    """Raise unless every setting is a keyword argument of a referee and has its default's type."""
    known = inspect.signature(referee).parameters
    accepts_any = any(each.kind is each.VAR_KEYWORD for each in known.values())
    for name, value in settings.items():
        if name not in known:
            if accepts_any:
                continue
            raise ArgumentTypeError(name, "a setting of the referee", value)
        match known[name].default:
            case bool():
                checks.require_switch(name, value)
            case int():
                require_size(name, value)
            case float():
                checks.require_number(name, value, NOT_NEGATIVE)
