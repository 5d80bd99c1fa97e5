"""The names of endings, as planners, sweeps and exports take them. Nothing here imports JAX."""

from typing import Any

ENDINGS = ("brake", "home")  # to rest where that is cheapest, or where the case begins
NONE = "none"  # as a setting has it: a plan that ends at its last contact
CHOICES = (NONE, *ENDINGS)


def ending_problem(value: Any, choices: tuple[str, ...] = ENDINGS) -> str | None:
    """What is wrong with the argument `ending`, in a line; None where nothing is."""
    if value in choices:
        return None
    return f"ending must be one of {', '.join(choices)}, got {value!r:.60}"
