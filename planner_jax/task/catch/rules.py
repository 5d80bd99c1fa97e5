"""What the numbers of a catch must be."""

import numpy as np
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Numbers
from planner_jax.core.rules import (
    PERMUTATION,
    POSITIVE,
    Field,
    Rule,
    Table,
    within,
)
from planner_jax.task.quadrotor import FLIGHT_RULES


def _lies_ahead(horizon: Numbers, case: PyTree) -> Numbers:
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
    *FLIGHT_RULES,
    Field("limits.min_height", ()),
)
