"""Arguments and results of the functions of a task: arrays, draws, decisions and judgements."""

import inspect
import pkgutil
import zlib
from collections.abc import Callable, Collection, Mapping
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from planner_jax.core.checks import numbers_of, numeric, require_number, require_switch, shape_of
from planner_jax.core.choices import require_memory, require_size
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.protocol import Decision, Plan, take
from planner_jax.core.registry import split_name
from planner_jax.core.rules import NOT_NEGATIVE, Case

_DRAWN_BYTES = 1_000  # of a case, as estimated


def array_of(
    name: str, value: object, batch: tuple[int, ...], shape: tuple[int, ...], dtype: DTypeLike
) -> Array:
    """Return `numbers_of` as a JAX array of a type."""
    with np.errstate(over="ignore"):  # what is too large is infinite, and refused as that
        return jnp.asarray(numbers_of(name, value, batch, shape), dtype)


def batch_of(name: str, vectors: object, *shape: int) -> tuple[int, ...]:
    """The batch's axes of an argument (..., *shape), which the others follow.

    Raises:
        TypeError: no numbers.
        ValueError: the argument does not end with this shape.
    """
    given = shape_of(name, vectors)
    if given[len(given) - len(shape) :] != shape or len(given) < len(shape):
        ends = ", ".join(map(str, shape))
        raise ArgumentError(name, f"a shape that ends with ({ends},)", given, verb="have")
    return given[: len(given) - len(shape)]


def require_draw(num: int, seed: int, first: int) -> None:
    """Raise unless so many cases of a suite can be drawn from a seed, from a place on.

    Raises:
        TypeError: one of them is no whole number.
        ValueError: one of them is too small, or `num` is more than memory holds.
    """
    for name, value, least in (("num", num, 1), ("seed", seed, 0), ("first", first, 0)):
        require_size(name, value, least)
    require_memory("num", num, _DRAWN_BYTES)


def make_generators(suite: str, num: int, seed: int, first: int) -> list[np.random.Generator]:
    """Make a generator for every case of a suite, so that no case depends on the others.

    Raises:
        TypeError, ValueError: as of `require_draw`.
    """
    require_draw(num, seed, first)
    tag = zlib.crc32(suite.encode())
    return [np.random.default_rng([seed, first + k, tag]) for k in range(num)]


def find_decision(
    names: Mapping[str, str], decide: str | Decision, from_file: Collection[str] = ()
) -> Decision:
    """Return the decision of a name out of "name -> module:class", or the decision itself.

    The names in `from_file` may have ":" and a file behind them.

    Raises:
        ValueError: there is no decision of that name, or it takes no file.
        TypeError: it is neither a name nor a decision.
    """
    if not isinstance(decide, str):
        if isinstance(decide, type) or not isinstance(decide, Decision):
            raise ArgumentTypeError("decide", "a name or a decision", decide)
        return decide
    name, file = split_name(names, "decide", decide, from_file)
    return pkgutil.resolve_name(names[name])(*filter(None, [file]))


def require_orders(orders: ArrayLike) -> None:
    """Raise `ValueError` unless every order (..., N) of a batch is a permutation."""
    flat = np.asarray(orders).reshape(-1, np.shape(orders)[-1])
    wrong = np.flatnonzero((np.sort(flat, axis=1) != np.arange(flat.shape[1])).any(axis=1))
    if wrong.size:
        shown = f"{flat[wrong[0]].tolist()} in case {wrong[0]}"
        raise ArgumentError("order", f"a permutation of 0..{flat.shape[1] - 1}", shown=shown)


VerdictT = TypeVar("VerdictT")


def judge_by(
    referee: Callable[..., VerdictT],
    cases: Case,
    plans: Plan,
    kinds: tuple[type[Case], type[Plan]],
    settings: dict[str, object],
) -> VerdictT:
    """Return the verdict of a referee of batches on one plan, or on a batch.

    Raises:
        TypeError: cases or plans are not of the two `kinds`, or a setting is none of the referee's
            keyword arguments or of another kind.
        ValueError: shapes that do not fit, or an error of the referee.
    """
    for name, tree, kind in zip(("cases", "plans"), (cases, plans), kinds, strict=True):
        if not isinstance(tree, kind):
            raise ArgumentTypeError(name, f"a {kind.__name__}", shown=f"a {type(tree).__name__}")
    require_settings(referee, settings)
    for leaf in jax.tree.leaves((cases, plans)):
        if numeric(leaf) is None:
            raise ArgumentTypeError("cases and plans", "numbers", leaf, verb="hold")
    num = np.shape(plans.status)
    if num != cases.batch_shape:
        raise ArgumentError(
            "plans", f"the batch shape of the cases, {cases.batch_shape}", num, verb="have"
        )
    alone = cases.batch_shape == ()
    if alone:
        cases, plans = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (cases, plans))
    verdict = referee(cases, plans, **settings)
    return take(verdict, 0) if alone else verdict


def require_settings(referee: Callable[..., object], settings: dict[str, object]) -> None:
    """Raise unless settings are a referee's, each of the kind that its default is.

    Those that a referee hands on to another are looked at for that one.
    """
    known = inspect.signature(referee).parameters
    hands_on = any(each.kind is each.VAR_KEYWORD for each in known.values())
    for name, value in settings.items():
        if name not in known and hands_on:
            continue
        if name not in known:
            raise ArgumentTypeError(name, "a setting of the referee's", value)
        usual = known[name].default
        if isinstance(usual, bool):
            require_switch(name, value)
        elif isinstance(usual, int):
            require_size(name, value)
        elif isinstance(usual, float):
            require_number(name, value, NOT_NEGATIVE)
