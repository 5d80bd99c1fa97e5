"""Parsers of the command line; a command's options are the fields of its dataclass of settings.

In the metadata of a field, `help` is the help text of its option, and `metavar` the word that
stands for the option's value. `planner_jax.runs.settings.option` makes such fields.
"""

import argparse
import contextlib
import dataclasses
import re
import sys
import typing
import warnings
from argparse import SUPPRESS
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NoReturn

from planner_jax.core.errors import ArgumentError, PlannerJaxError, format_value
from planner_jax.core.missing_extra import MissingExtra
from planner_jax.core.registry import Task
from planner_jax.runs.settings import SweepSettings

Options = dict[str, Any]  # values of the options that the user passed, by argument names
FAILED, BAD_ARGUMENT = 1, 2  # exit codes of the process


class BadOption(PlannerJaxError):
    """Error: a word of the command line cannot be converted to the type of its option."""


class Unfinished(PlannerJaxError):
    """Error: the file system or workers failed during a run; the text says how to continue it."""


def fail(
    error: str | PlannerJaxError, flags: Mapping[str, str] | None = None, code: int = BAD_ARGUMENT
) -> int:
    """Print an error, with names replaced by `flags`, such as "num" by "--num"; return `code`."""
    if isinstance(error, ArgumentError | MissingExtra):
        error = error.with_names(flags or {})
    print(f"planner-jax: error: {' '.join(str(error).split())}", file=sys.stderr)
    return code


@contextlib.contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Print each warning for the user in one line while the `with` block runs."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = lambda text, *_, **__: print(
            f"planner-jax: warning: {text}", file=sys.stderr
        )
        yield


class Parser(argparse.ArgumentParser):
    """An argument parser that reports a bad argument in one line.

    Args:
        fill: function that adds the parser's options; it is called when the parser is used. With
            `fill`, options that the user omits are missing in the result, otherwise None.
        **look: further arguments of `argparse.ArgumentParser`.
    """

    def __init__(self, *, fill: Callable[["Parser"], None] | None = None, **look: Any):
        shape = partial(argparse.RawDescriptionHelpFormatter, max_help_position=28, width=100)
        look = {"formatter_class": shape, "allow_abbrev": False, **look}
        super().__init__(**look if fill is None else {**look, "argument_default": SUPPRESS})
        self._fill, self._flags = fill, {}
        # A word that matches this pattern is a negative number and not an option. The pattern that
        # argparse uses by default does not match numbers with an exponent, such as -1e3.
        self._negative_number_matcher = re.compile(r"-\.?[0-9]")

    def parse_known_args(self, *arguments: Any, **how: Any) -> Any:
        """Add the options, then parse; the entry `flags` of the result maps "num" to "--num".

        An unknown word ends the process with a line that names the command's help.
        """
        if self._fill is not None:
            self._fill(self)
        self.set_defaults(flags=self._flags)
        found, unknown = super().parse_known_args(*arguments, **how)
        if unknown:
            known = f"`{self.prog} --help` lists all options"
            self.error(f"unrecognized arguments: {' '.join(unknown)}; {known}")
        return found, unknown

    def add(self, flag: str, *, type: type | None = None, **how: Any) -> None:
        """Add the option `flag`, whose value is converted to `type` if this is int or float."""
        if type in (int, float):
            how["type"] = partial(_read_number, flag, type)
        self._flags[self.add_argument(flag, **how).dest] = flag

    def error(self, message: str) -> NoReturn:
        """Print the error in one line, and end the process with the exit code 2."""
        sys.exit(fail(message.removeprefix("argument ")))


def _read_number(flag: str, kind: Callable[[str], float], word: str) -> float:
    try:
        return kind(word)
    except ValueError:
        rule = "a whole number" if kind is int else "a number"
        raise BadOption(f"{flag} must be {rule}, got {format_value(word)}") from None


def add_settings(parser: Parser, kind: Any, task: Task | None = None) -> None:
    """Add an option for every field of `kind`, the dataclass with the settings of a command.

    Help texts list the planners and suites of `task`; None for a command without a task.
    """
    hints = typing.get_type_hints(kind)
    names = {"planner": task.all_planners(), "suite": task.all_suites()} if task else {}
    defaults: dict[str, object] = {name: next(iter(known)) for name, known in names.items()}
    if issubclass(kind, SweepSettings):
        batch = f"{kind.CPU_BATCH} on a CPU, {kind.GPU_BATCH} on a GPU"
        defaults |= {"num": kind.DEFAULT_NUM, "batch": batch}
    for field in dataclasses.fields(kind):
        words, default = field.metadata["help"], field.default
        if field.name in names:
            words = " ".join([", ".join(names[field.name]), *re.findall(r"\(default:.*", words)])
        default = defaults.get(field.name) if default is None else default
        how: Options = {"action": "store_true"}
        if default is None and bool in typing.get_args(hints[field.name]):
            how = {"action": argparse.BooleanOptionalAction}
        elif not isinstance(default, bool):
            how = {"type": _type_of(hints[field.name]), **_form_of(field)}
            shown = default
            if isinstance(default, tuple):
                shown, how = " ".join(f"{x:g}" for x in default), {"nargs": "+", **how}
            if default not in (None, (), dataclasses.MISSING) and "(default:" not in words:
                words += f" (default: {shown})"
        parser.add(f"--{field.name.replace('_', '-')}", help=words, **how)


def _form_of(field: dataclasses.Field) -> Options:
    names = field.metadata["metavar"].split()
    how: Options = {"required": True} if field.default is dataclasses.MISSING else {}
    if len(names) == 1:
        return {"metavar": names[0], **how}
    if field.default == ():
        how["action"] = "append"
    return {"metavar": tuple(names), "nargs": len(names), **how}


def _type_of(hint: Any) -> type:
    held = typing.get_args(hint) or (hint,)
    if str in held:  # the field accepts numbers or a word, such as "uniform"
        return str
    inner = [_type_of(kind) for kind in held if typing.get_args(kind)]
    return next((kind for kind in (int, float) if kind in held), next(iter(inner), str))


def pop_out(given: Options, kind: str = "folder") -> str | None:
    """Remove the option `--out`, the path of a file or folder, from the options, and return it."""
    out = given.pop("out", None)
    if out == "":
        raise ArgumentError("out", f"a {kind}", out, verb="name")
    if out and "://" in out:
        raise ArgumentError("out", f"a {kind} of this machine", out)
    return out
