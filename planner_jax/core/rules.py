"""Rules that the numbers of cases must keep, for checks on the host and in compiled programs.

A class of cases, or of parts of cases such as a target's path, lists its arrays and their rules in
`rules`. Every number must be finite and keep the rule of its array. On the host `require_sound`
raises for the first number that breaks its rule. Inside compiled programs `is_sound` evaluates
every case, and `planner_jax.planning` assigns the status `BAD_INPUT` to unsound cases.
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

    words: str  # text of the rule, as in "limits.speed must be WORDS, got -1"
    # `holds` is a function of an array with any leading axes, and of the case (or part of a case)
    # that contains the array. It returns for each number whether the condition holds.
    holds: Callable[[Numbers, PyTree], Numbers]
    infinite: bool = False  # whether the numbers may be infinite
    other: str = ""  # name of the array in the same part with which the numbers are compared


FINITE = Rule("finite", lambda value, part: abs(value) < np.inf)
POSITIVE = Rule("> 0", lambda value, part: value > 0.0)
NOT_NEGATIVE = Rule(">= 0", lambda value, part: value >= 0.0)
NOT_ZERO = Rule(  # for a vector
    "other than zero", lambda value, part: (value != 0.0) | (value != 0.0).any(-1, keepdims=True)
)
# For limits: an infinite number means that there is no limit.
POSITIVE_OR_NONE = Rule("> 0", lambda value, part: value > 0.0, infinite=True)

NUMBER = Rule("a number", lambda value, part: value == value, infinite=True)
NOT_NEGATIVE_OR_NONE = Rule(">= 0", lambda value, part: value >= 0.0, infinite=True)


def within(low: float, high: float, words: str) -> Rule:
    """Return the rule that numbers are in the closed interval from `low` to `high`."""
    return Rule(words, lambda value, part: (value >= low) & (value <= high))


def below(other: str) -> Rule:
    """Return the rule that an array is less than the array `other` in the same part of a case."""
    return Rule("<", lambda value, part: value < part_at(part, other), other=other)


def at_most(other: str) -> Rule:
    """Return the rule that an array is not greater than the array `other` in the same part."""
    return Rule("<=", lambda value, part: value <= part_at(part, other), other=other)


def at_least(other: str) -> Rule:
    """Return the rule that an array is not less than the array `other` in the same part."""
    return Rule(">=", lambda value, part: value >= part_at(part, other), other=other)


def below_or_infinite(other: str) -> Rule:
    """Return the rule `below(other)` for an array whose numbers may be infinite."""
    return dataclasses.replace(below(other), infinite=True)


def _is_permutation(value: Numbers, part: PyTree) -> Numbers:
    """Return which numbers of `value` are valid indices of its last axis and occur only once."""
    alike = (value[..., :, None] == value[..., None, :]).sum(axis=-1)
    return (alike == 1) & (value >= 0) & (value < value.shape[-1])


PERMUTATION = Rule("a permutation", _is_permutation)


@dataclasses.dataclass(frozen=True)
class Field:
    """One array of a case: its name, its shape in one case, its rule, and its kind of numbers."""

    name: str  # dotted name of the array, as in "limits.speed"
    shape: tuple[int | str, ...] | None = ()  # equal letters are equal sizes; None allows any shape
    rule: Rule = FINITE
    kind: type = np.floating


Table = tuple[Field, ...]


@dataclasses.dataclass(frozen=True)
class Ruled:
    """One array of a case, one rule that it must keep, and the part that contains it."""

    name: str
    value: Numbers
    rule: Rule
    part: PyTree

    def holds(self) -> Numbers:
        """Return where the array keeps the rule, a bool array of the same shape."""
        return self.rule.holds(self.value, self.part)


@runtime_checkable
class Case(Protocol):
    """A pytree of arrays for one case, or for a batch with a leading axis on every array."""

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape () for one case, or (B,) for a batch of B cases."""
        ...


def fields_of(tree: PyTree) -> dict[str, PyTree]:
    """Return the fields of a dataclass by name, without copying them."""
    return {field.name: getattr(tree, field.name) for field in dataclasses.fields(tree)}


def nodes_of(tree: PyTree) -> dict[str, PyTree]:
    """Return the fields of a dataclass by name, without its static fields."""
    static = {f.name for f in dataclasses.fields(tree) if not f.metadata.get("pytree_node", True)}
    return {name: value for name, value in fields_of(tree).items() if name not in static}


def part_at(tree: PyTree, name: str) -> PyTree:
    """Return the part of a tree with a dotted name, such as "limits.speed"."""
    for each in name.split("."):
        tree = None if tree is None else getattr(tree, each)
    return tree


def require_sound(cases: object, names: Mapping[str, str] | None = None) -> None:
    """Raise an error of one line for the first rule that a case breaks.

    Args:
        cases: one case, or a batch, with NumPy or jax arrays. Classes without `rules` pass. Traced
            arrays have no values yet, so only their shapes and types are checked.
        names: maps field names to the caller's names of arguments, for the message.

    Raises:
        CaseError: a number breaks its rule; the line has the field, the rule, the value and the
            first such case of the batch.
        ArgumentError: an array does not have the shape of its field.
        ArgumentTypeError: an array does not have the kind of numbers of its field.
    """
    if isinstance(cases, type) or not isinstance(cases, Case):
        raise ArgumentTypeError("cases", "a case or a batch", shown=f"a {type(cases).__name__}")
    try:
        require_shapes(cases)
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(cases)):
            return
        for ruled in all_ruled(jax.tree.map(np.asarray, cases)):
            words, other = ruled.rule.words, ruled.rule.other
            require_rule(ruled.name, ruled.value, ruled.holds(), words, cases.batch_shape, other)
    except ArgumentError as error:
        raise error.with_names(names or {}) from None


def require_rule(
    name: str, value: Numbers, holds: Numbers, words: str, batch: tuple[int, ...], other: str = ""
) -> None:
    """Raise `CaseError` for the first case with a number `value` at which `holds` is false.

    `value` and `holds` have the shape batch + shape. `words` states the rule, and `other` names the
    array with which the value is compared.
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


def require_or_mark(cases: PyTree, name: str, value: Numbers, holds: Numbers, words: str) -> PyTree:
    """Return the cases if `holds` is true everywhere, and raise `CaseError` as `require_rule` does.

    Where a traced `holds` is false, the gravity becomes NaN, which leads to the status `BAD_INPUT`.
    """
    batch = cases.batch_shape
    if not isinstance(holds, Tracer):
        require_rule(name, value, holds, words, batch)
        return cases
    are_kept = holds.reshape(*batch, -1).all(axis=-1)
    return dataclasses.replace(cases, gravity=jnp.where(are_kept, cases.gravity, jnp.nan))


def require_shapes(cases: PyTree) -> None:
    """Raise `ArgumentError` unless each array, traced or not, has its field's shape and type."""
    for place, part in _parts(cases):
        sizes: dict[str, int] = {}
        batch = _usual_batch(part)
        defaults = {field.name: field.default for field in dataclasses.fields(part)}
        for name, value in fields_of(part).items():
            if value is None and defaults[name] is not None:
                raise ArgumentTypeError(f"{place}{name}", "given", shown="None")
        for field in type(part).rules:
            value, name = part_at(part, field.name), place + field.name
            if value is None:
                continue
            kind = np.asarray(value).dtype if isinstance(value, _PLAIN) else jnp.result_type(value)
            if not jnp.issubdtype(kind, field.kind) or kind == np.float16:
                is_half = kind == np.float16 and field.kind is np.floating
                rule = "in float32 or float64" if is_half else _KINDS[field.kind]
                raise ArgumentTypeError(name, rule, shown=f"an array of {kind}")
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
    """Return the batch shape: the leading axes that most arrays in a part of a case have."""
    fronts: Counter[tuple[int, ...]] = Counter()
    for name, shape in {field.name: field.shape for field in type(part).rules}.items():
        if shape is not None and (value := part_at(part, name)) is not None:
            fronts[np.shape(value)[: max(np.ndim(value) - len(shape), 0)]] += 1
    return fronts.most_common(1)[0][0] if fronts else ()


_PLAIN = (np.ndarray, str, bytes)  # for these types `np.asarray(value).dtype` is fast
_KINDS = {
    np.floating: "floating-point numbers",
    np.integer: "whole numbers",
    np.bool_: "true or false",
}


def is_sound(cases: PyTree) -> PyTree:
    """Return whether every number of each case keeps its rules, bool of the batch shape; pure.

    Cases whose class and parts have no `rules` are sound.
    """
    batch = cases.batch_shape
    held = [ruled.holds() for ruled in all_ruled(cases)] or [np.ones((*batch, 1), bool)]
    # Joining the arrays before the reduction compiles to one loop instead of one for each array.
    xp = numpy_of(*held)
    return xp.concatenate([each.reshape(*batch, -1) for each in held], axis=-1).all(axis=-1)


def all_ruled(cases: PyTree) -> Iterator[Ruled]:
    """Yield every rule of every array of a case, first the rule that its numbers are finite."""
    parts = list(_parts(cases))
    tables = [
        (place + field.name, field, part) for place, part in parts for field in type(part).rules
    ]
    free = {name for name, field, _ in tables if field.rule.infinite}
    whole: list[str] = []  # dotted prefixes of parts whose numbers have been yielded
    for place, part in parts:
        if any(place.startswith(outer) for outer in whole):
            continue
        whole.append(place)
        for path, leaf in jax.tree_util.tree_leaves_with_path(part):
            name = place + jax.tree_util.keystr(path, simple=True, separator=".")
            if name not in free and jnp.issubdtype(jnp.result_type(leaf), np.floating):
                yield Ruled(name, leaf, FINITE, part)
    for name, field, part in tables:
        value = part_at(part, field.name)
        if field.rule is not FINITE and value is not None:
            yield Ruled(name, value, field.rule, part)


def _parts(tree: PyTree, place: str = "") -> Iterator[tuple[str, PyTree]]:
    """Yield (prefix, part) for the parts of `tree` whose class has `rules`; prefixes are dotted."""
    if getattr(type(tree), "rules", None):
        yield place, tree
    children: Mapping[str, PyTree] = {}
    if dataclasses.is_dataclass(tree):
        children = nodes_of(tree)
    elif isinstance(tree, tuple | list):
        children = {str(k): child for k, child in enumerate(tree)}
    for name, child in children.items():
        yield from _parts(child, f"{place}{name}.")
