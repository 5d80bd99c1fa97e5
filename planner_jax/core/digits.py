"""Numbers as options and files write them: plain ASCII digits.

Python's own `int` and `float` also take digits of other scripts, underscores and blanks, so that a
slip of the pen passes for another number.
"""

import re

_WHOLE = re.compile(r"[+-]?[0-9]+")
_NUMBER = re.compile(r"[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|inf|nan)")
_LONGEST = 400  # characters; of more Python refuses to make a number


def written_whole(text: str) -> int:
    """The whole number that is written; raises `ValueError`, one sentence without the name."""
    if len(text) > _LONGEST or not _WHOLE.fullmatch(text):
        raise ValueError(f"must be a whole number, got {text!r:.60}")
    return int(text)


def written_number(text: str) -> float:
    """The number that is written, also "inf" and "nan"; raises `ValueError` as `written_whole`."""
    if len(text) > _LONGEST or not _NUMBER.fullmatch(text):
        raise ValueError(f"must be a number, got {text!r:.60}")
    return float(text)
