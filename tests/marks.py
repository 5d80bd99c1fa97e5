"""Which tests an expression of pytest's option `-m` selects."""

from collections import defaultdict


def selects_slow(expression: str) -> bool:
    """Return whether tests marked slow are selected, with or without those marked gpu as well."""
    code = compile(expression or "True", "-m", "eval")
    return any(eval(code, {}, defaultdict(bool, slow=True, gpu=gpu)) for gpu in (False, True))
