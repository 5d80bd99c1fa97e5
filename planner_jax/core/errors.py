"""The exceptions of the library; `PlannerJaxError` is the base class of all."""

import copy
import numbers
from collections.abc import Mapping
from typing import ClassVar, Self


class PlannerJaxError(Exception):
    """Base class of the exceptions that the library defines; their text is one line."""

    _names: ClassVar[tuple[str, ...]] = ()  # fields that hold names of arguments

    def with_names(self, names: Mapping[str, str]) -> Self:
        """Return a copy of the error with other names of arguments: `names` maps old to new."""
        error = copy.copy(self)
        vars(error).update({k: names.get(v, v) for k, v in vars(self).items() if k in self._names})
        return error


class ArgumentError(PlannerJaxError, ValueError):
    """An argument breaks a rule: "NAME must be RULE, got VALUE".

    Args:
        name: argument, or field of an argument, such as "limits.speed".
        rule: condition on the argument, such as "> 0".
        value: value of the argument.
        index: index of the first entry of an array, or case of a batch, that breaks the rule.
        verb: word between "must" and the rule, such as "be" or "have".
        other: name of a second argument with which the rule compares this one.
        shown: text that is shown instead of `value`; "" shows nothing.
        more: number of further cases of the batch that break the rule.
    """

    _names = ("name", "other")
    _where: ClassVar[str] = "at index"

    def __init__(
        self,
        name: str,
        rule: str,
        value: object = None,
        index: int | tuple[int, ...] | None = None,
        *,
        verb: str = "be",
        other: str = "",
        shown: str | None = None,
        more: int = 0,
    ):
        super().__init__(name, rule, value, index)
        self.name, self.rule, self.value, self.index = name, rule, value, index
        self.verb, self.other, self.more = verb, other, more
        self.shown = format_value(value) if shown is None else shown

    def __str__(self) -> str:
        text = f"{self.name} must {self.verb} {self.rule}{self.other and f' {self.other}'}"
        if self.shown:
            text += f", got {self.shown}"
        if self.index is not None:
            text += f" {self._where} {self.index}"
        if self.more:
            text += f" ({self.more} more such lane{'s' if self.more > 1 else ''})"
        return " ".join(text.split())


class ArgumentTypeError(ArgumentError, TypeError):
    """An argument has a type that its rule excludes, such as text instead of a number."""


class CaseError(ArgumentError):
    """A number of a case breaks its field's rule; `index` is the first case that breaks it."""

    _where = "in lane"


class UnknownName(ArgumentError):
    """The name of a task, planner, suite or robot is unknown; the rule lists the known names."""


class NotOffered(PlannerJaxError, TypeError):
    """A planner does not offer what is requested, such as a gradient; the text says what does."""


class NoRecovery(PlannerJaxError, ValueError):
    """Every trajectory from the end of a plan to standstill exceeds a limit, named in the text."""


def format_value(value: object) -> str:
    """Format a value as at most one line of text for an error message."""
    if isinstance(value, numbers.Real) and not isinstance(value, numbers.Integral):
        return f"{float(value):g}"
    text = str(value) if isinstance(value, numbers.Number) else repr(value)
    return " ".join(text.split())[: 200 if isinstance(value, str) else 60]
