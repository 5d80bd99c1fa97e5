"""Rules on the numbers of cases: one table serves the host and compiled programs.

A class of cases, or of parts of cases such as a target's path, has its table as `rules`. Every
number of such a case must be finite and keep the rule that the table has for it. On the host
`require_sound` names the first number that breaks its rule. Inside compiled programs `is_sound`
evaluates every lane, and `planner_jax.planning` gives unsound lanes the status `BAD_INPUT`.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Numbers, numpy_of
from planner_jax.core.errors import ArgumentError, ArgumentTypeError, CaseError


@dataclasses.dataclass(frozen=True)
class Rule:
    """A condition on every number of an array."""

    words: str  # as in "limits.speed must be WORDS, got -1"
    # Returns where the condition holds, number by number, of an array with any leading axes and
    # of the case, or part of it, whose table has the rule.
    holds: Callable[[Numbers, PyTree], Numbers]
    infinite: bool = False  # whether the number may be infinite
    other: str = ""  # the array of the same part that the number is compared with


FINITE = Rule("finite", lambda value, part: abs(value) < np.inf)
POSITIVE = Rule("> 0", lambda value, part: value > 0.0)
NOT_NEGATIVE = Rule(">= 0", lambda value, part: value >= 0.0)
NOT_ZERO = Rule(  # of a vector
    "other than zero",
    lambda value, part: (value != 0.0) | (value != 0.0).any(-1, keepdims=True),
)
POSITIVE_OR_NONE = Rule("> 0", lambda value, part: value > 0.0, infinite=True)  # infinite: no limit


def within(low: float, high: float, words: str) -> Rule:
    """Return the rule of a closed interval."""
    return Rule(words, lambda value, part: (value >= low) & (value <= high))


def below(other: str) -> Rule:
    """Return the rule that an array is less than another array of the same part and shape."""
    return Rule("<", lambda value, part: value < named(part, other), other=other)


def _is_permutation(value: Numbers, part: PyTree) -> Numbers:
    """Return where an entry along the last axis is an index of it that no other entry has."""
    alike = (value[..., :, None] == value[..., None, :]).sum(axis=-1)
    return (alike == 1) & (value >= 0) & (value < value.shape[-1])


PERMUTATION = Rule("a permutation", _is_permutation)


@dataclasses.dataclass(frozen=True)
class Field:
    """One array of a case: its name, its shape in one case, its rule, and its kind of numbers.

    An array that is None, or that belongs to a part that is None, is not checked.
    """

    name: str  # joined by dots, as in "limits.speed"
    shape: tuple[int | str, ...] | None = ()  # equal letters are equal sizes; None: any shape
    rule: Rule = FINITE
    kind: type = np.floating


Table = tuple[Field, ...]


@dataclasses.dataclass(frozen=True)
class Ruled:
    """One array of a case, and one rule that it has to keep."""

    name: str
    value: Numbers
    rule: Rule
    part: PyTree

    def holds(self) -> Numbers:
        """Return where the array keeps the rule, bool of its shape."""
        return self.rule.holds(self.value, self.part)


@runtime_checkable
class Case(Protocol):
    """A pytree of arrays for one case, or for a batch with a leading axis on every leaf."""

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one case, (B,) for a batch."""
        ...


def fields_of(tree: PyTree) -> dict[str, PyTree]:
    """Return the fields of a dataclass by name, without copies."""
    return {field.name: getattr(tree, field.name) for field in dataclasses.fields(tree)}


def nodes_of(tree: PyTree) -> dict[str, PyTree]:
    """Return the fields of a dataclass by name, without its static fields."""
    values = fields_of(tree)
    fields = dataclasses.fields(tree)
    return {f.name: values[f.name] for f in fields if f.metadata.get("pytree_node", True)}


def named(tree: PyTree, name: str) -> PyTree:
    """Return the part of a tree under a name with dots, such as "limits.speed"."""
    for each in name.split("."):
        tree = None if tree is None else getattr(tree, each)
    return tree


def has_rules(cases: PyTree) -> bool:
    """Return whether the class of the cases, or of a part of them, has a table."""
    return any(True for _ in _parts(cases))


def require_sound(cases: object, names: Mapping[str, str] | None = None) -> None:
    """Raise for the first rule that a case breaks, in one line.

    Args:
        cases: one case, or a batch, in arrays of any kind. Classes without `rules` pass. Of traced
            arrays, which have no values yet, only shape and kind are checked.
        names: the caller's arguments by the fields that they become, for the message.

    Raises:
        CaseError: a number breaks its rule; the line has the field, the rule, the value and the
            first such case of the batch.
        ArgumentError: an array has not the shape of its field.
        ArgumentTypeError: an array has not the kind of numbers of its field.
    """
    try:
        _require_sound(cases)
    except ArgumentError as error:
        raise error.renamed(names or {}) from None


def _require_sound(cases: object) -> None:
    """Raise for the first rule that a case breaks, with the names of fields."""
    if isinstance(cases, type) or not isinstance(cases, Case):
        raise ArgumentTypeError("cases", "a case or a batch", shown=f"a {type(cases).__name__}")
    require_shapes(cases)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(cases)):
        return
    for ruled in all_ruled(jax.tree.map(np.asarray, cases)):
        words, other = ruled.rule.words, ruled.rule.other
        require_rule(ruled.name, ruled.value, ruled.holds(), words, cases.batch_shape, other)


def require_rule(
    name: str, value: Numbers, holds: Numbers, words: str, batch: tuple[int, ...], other: str = ""
) -> None:
    """Raise `CaseError` for the first case where a rule does not hold.

    Args:
        name: of the value, for the message.
        value: batch + shape.
        holds: batch + shape, bool, where the rule holds.
        words: what the value must be.
        batch: () or (B,).
        other: name of the array that the value is compared with.
    """
    broken = ~np.asarray(holds)
    if not broken.any():
        return
    first = np.asarray(value)[broken].flat[0]
    cases = np.argwhere(broken.any(axis=tuple(range(len(batch), broken.ndim))))
    index = tuple(map(int, cases[0])) if batch else None
    if index is not None and len(index) == 1:
        (index,) = index
    raise CaseError(name, words, first, index, other=other, more=len(cases) - 1)


def require_shapes(cases: PyTree) -> None:
    """Raise unless every array, traced or not, has the shape and kind of numbers of its field.

    Raises:
        ValueError: another shape; one line with the field and both shapes.
        TypeError: another kind of numbers.
    """
    for place, part in _parts(cases):
        sizes: dict[str, int] = {}
        batch = _usual_batch(part)
        values = fields_of(part)
        for each in dataclasses.fields(part):
            if values[each.name] is None and each.default is not None:
                raise ArgumentTypeError(f"{place}{each.name}", "given", shown="None")
        for field in type(part).rules:
            value, name = named(part, field.name), place + field.name
            if value is None:
                continue
            kind = np.asarray(value).dtype if isinstance(value, _PLAIN) else jnp.result_type(value)
            if not jnp.issubdtype(kind, field.kind):
                wanted = _KINDS[field.kind]
                raise ArgumentTypeError(name, wanted, shown=f"an array of {kind}")
            if kind == np.float16:
                raise ArgumentTypeError(name, "in float32 or float64", shown=f"an array of {kind}")
            if field.shape is None:
                continue
            shape = np.shape(value)
            own = shape[len(batch) :]
            if len(own) == len(field.shape):
                known = [
                    sizes.setdefault(want, got) if isinstance(want, str) else want
                    for want, got in zip(field.shape, own, strict=True)
                ]
            else:
                known = [sizes.get(want, want) for want in field.shape]  # type: ignore[arg-type]
            if shape != (*batch, *known):
                wanted = ", ".join(map(str, whole := (*batch, *known)))
                comma = "," if len(whole) == 1 else ""
                raise ArgumentError(name, f"the shape ({wanted}{comma})", shape, verb="have")


def _usual_batch(part: PyTree) -> tuple[int, ...]:
    """Return the axes that most arrays of a part have in front of the axes of one case."""
    fronts: Counter[tuple[int, ...]] = Counter()
    for name, size in {field.name: field.shape for field in type(part).rules}.items():
        if size is not None and (value := named(part, name)) is not None:
            fronts[np.shape(value)[: max(np.ndim(value) - len(size), 0)]] += 1
    return fronts.most_common(1)[0][0] if fronts else ()


_PLAIN = (np.ndarray, str, bytes)  # of which NumPy knows the kind, numbers or not
_KINDS = {
    np.floating: "floating-point numbers",
    np.integer: "whole numbers",
    np.bool_: "true or false",
}


def is_sound(cases: PyTree) -> PyTree:
    """Return whether every number of each case keeps its rules; pure.

    Returns:
        Bool of the batch shape, a jax array if the cases hold one.
    """
    batch = cases.batch_shape
    held = [ruled.holds() for ruled in all_ruled(cases)]
    # Joined before they are reduced: one loop of a compiled program, not one for every array.
    xp = numpy_of(*held)
    return xp.concatenate([each.reshape(*batch, -1) for each in held], axis=-1).all(axis=-1)


def all_ruled(cases: PyTree) -> Iterator[Ruled]:
    """Yield the rules of all arrays of a case, first the rule that they are finite."""
    parts = list(_parts(cases))
    tables = [
        (place + field.name, field, part) for place, part in parts for field in type(part).rules
    ]
    free = {name for name, field, _ in tables if field.rule.infinite}
    whole: list[str] = []  # places of parts whose numbers have been yielded
    for place, part in parts:
        if any(place.startswith(outer) for outer in whole):
            continue
        whole.append(place)
        for path, leaf in jax.tree_util.tree_leaves_with_path(part):
            name = place + jax.tree_util.keystr(path, simple=True, separator=".")
            if name not in free and jnp.issubdtype(jnp.result_type(leaf), np.floating):
                yield Ruled(name, leaf, FINITE, part)
    for name, field, part in tables:
        value = named(part, field.name)
        if field.rule is not FINITE and value is not None:
            yield Ruled(name, value, field.rule, part)


def _parts(tree: PyTree, place: str = "") -> Iterator[tuple[str, PyTree]]:
    """Yield the places and parts of a case whose class has a table, outer ones first."""
    if getattr(type(tree), "rules", None):
        yield place, tree
    children: Mapping[str, PyTree] = {}
    if dataclasses.is_dataclass(tree):
        children = nodes_of(tree)
    elif isinstance(tree, tuple | list):
        children = {str(k): child for k, child in enumerate(tree)}
    for name, child in children.items():
        yield from _parts(child, f"{place}{name}.")
