"""What the numbers of a case must be: one table that serves the host and compiled programs.

A class of cases, or of parts of them such as a target's path, has its table as `rules`. Every
number of a case that has one must be finite, and keep what the table says besides. On the host
`require_sound` names the first that does not; inside of compiled programs `is_sound` says it lane
by lane, of which `planner_jax.planning` makes the status `BAD_INPUT`.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from planner_jax.core.errors import ArgumentError, ArgumentTypeError, CaseError


@dataclasses.dataclass(frozen=True)
class Rule:
    """What a number must be."""

    words: str  # as in "limits.speed must be WORDS, got -1"
    # Where it holds, number by number: of an array with any leading axes, NumPy's or jax's, and of
    # the case, or part of it, whose table has the rule.
    holds: Callable[[Any, Any], Any]
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
    """The rule of a closed interval."""
    return Rule(words, lambda value, part: (value >= low) & (value <= high))


def below(other: str) -> Rule:
    """The rule of what must be less than another array of the same part and shape."""
    return Rule("<", lambda value, part: value < named(part, other), other=other)


def _is_own_place(value: Any, part: Any) -> Any:
    alike = (value[..., :, None] == value[..., None, :]).sum(axis=-1)
    return (alike == 1) & (value >= 0) & (value < value.shape[-1])


PERMUTATION = Rule("a permutation", _is_own_place)


@dataclasses.dataclass(frozen=True)
class Field:
    """One array of a case: its name, its shape in one case, its rule, and its kind of numbers.

    Where the case has None for it, or for what it is part of, nothing is asked.
    """

    name: str  # joined by dots, as in "limits.speed"
    shape: tuple[int | str, ...] | None = ()  # a letter is one size wherever it is; None: any shape
    rule: Rule = FINITE
    kind: type = np.floating


Table = tuple[Field, ...]


@dataclasses.dataclass(frozen=True)
class Ruled:
    """One array of a case, and one rule that it has to keep."""

    name: str
    value: Any
    rule: Rule
    part: Any

    def holds(self) -> Any:
        """Where it does."""
        return self.rule.holds(self.value, self.part)


def named(tree: Any, name: str) -> Any:
    """What stands at a place that is named with dots, such as "limits.speed"."""
    for each in name.split("."):
        tree = None if tree is None else getattr(tree, each)
    return tree


def has_rules(cases: Any) -> bool:
    """Whether the class of the cases, or of a part of them, has a table."""
    return any(True for _ in _parts(cases))


def require_sound(cases: Any, names: Mapping[str, str] | None = None) -> None:
    """Raise for the first rule that a case breaks, in one line.

    Args:
        cases: one case, or a batch, in arrays of any kind. Classes without `rules` pass; of traced
            arrays, which have no values yet, only shape and kind are checked.
        names: arguments of the caller by the fields that they become, for the message.

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


def _require_sound(cases: Any) -> None:
    """Raise for the first rule that a case breaks, with the names of fields."""
    if isinstance(cases, type) or not hasattr(cases, "batch_shape"):
        raise ArgumentTypeError("cases", "a case or a batch", shown=f"a {type(cases).__name__}")
    require_shapes(cases)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(cases)):
        return
    for ruled in all_ruled(jax.tree.map(np.asarray, cases)):
        words, other = ruled.rule.words, ruled.rule.other
        require_rule(ruled.name, ruled.value, ruled.holds(), words, cases.batch_shape, other)


def require_rule(
    name: str, value: Any, holds: Any, words: str, batch: tuple[int, ...], other: str = ""
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


def require_shapes(cases: Any) -> None:
    """Raise unless every array has the shape and the kind of numbers of its field.

    These are known of traced arrays, too.

    Raises:
        ValueError: another shape; one line with the field and both shapes.
        TypeError: another kind of numbers.
    """
    for place, part in _parts(cases):
        sizes: dict[str, int] = {}
        batch = _usual_batch(part)
        for each in dataclasses.fields(part):
            if getattr(part, each.name) is None and each.default is not None:
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


def _usual_batch(part: Any) -> tuple[int, ...]:
    """The axes that most arrays of a part have in front of those of one case.

    So the one array that is of another batch is named, whichever it is.
    """
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


def is_sound(cases: Any) -> Any:
    """Whether every number of each case keeps its rules, bool of the batch shape; pure.

    NumPy arrays give NumPy's, jax arrays jax's.
    """
    batch = cases.batch_shape
    held = [ruled.holds() for ruled in all_ruled(cases)]
    # Joined before they are reduced: one loop of a compiled program, not one for every array.
    xp: Any = jnp if any(isinstance(each, jax.Array) for each in held) else np
    return xp.concatenate([each.reshape(*batch, -1) for each in held], axis=-1).all(axis=-1)


def all_ruled(cases: Any) -> Iterator[Ruled]:
    """All rules of the arrays of a case, that of being finite first."""
    parts = list(_parts(cases))
    tables = [
        (place + field.name, field, part) for place, part in parts for field in type(part).rules
    ]
    free = {name for name, field, _ in tables if field.rule.infinite}
    whole: list[str] = []  # places of parts whose numbers have been gone through
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


def _parts(tree: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """The parts of a case whose class has a table, outer ones first, and where they stand."""
    if getattr(type(tree), "rules", None):
        yield place, tree
    children: Any = ()
    if dataclasses.is_dataclass(tree):
        fields = [f for f in dataclasses.fields(tree) if f.metadata.get("pytree_node", True)]
        children = [(field.name, getattr(tree, field.name)) for field in fields]
    elif isinstance(tree, tuple | list):
        children = enumerate(tree)
    for name, child in children:
        yield from _parts(child, f"{place}{name}.")
