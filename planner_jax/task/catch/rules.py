"""What the numbers of a catch must be."""

from typing import Any

import numpy as np

from planner_jax.rules import (
    NOT_NEGATIVE,
    PERMUTATION,
    POSITIVE,
    Field,
    Rule,
    Table,
    below,
    within,
)


def _lies_ahead(horizon: Any, case: Any) -> Any:
    return (horizon > 0.0) | ~case.present


RULES: Table = (
    Field("present", ("N",), kind=np.bool_),
    Field("horizon", ("N",), Rule("> 0 of a target that is present", _lies_ahead)),
    Field("order", ("N",), PERMUTATION, kind=np.integer),
    Field("times", ("N",)),
    Field("head_state", (4, 3)),
    Field("gravity", (), POSITIVE),
    Field("net.height", ()),
    Field("net.radius", (), POSITIVE),
    Field("net.max_angle", (), within(0.0, np.pi, "in [0, pi]")),
    Field("limits.speed", (), POSITIVE),
    Field("limits.min_thrust", (), NOT_NEGATIVE),
    Field("limits.min_thrust", (), below("limits.max_thrust")),
    Field("limits.max_thrust", ()),
    Field("limits.body_rate", (), POSITIVE),
    Field("limits.min_height", ()),
)
