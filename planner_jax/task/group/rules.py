"""Rules on the numbers of a group."""

import numpy as np

from planner_jax.core.rules import PERMUTATION, Field, Table

RULES: Table = (
    Field("present", ("N",), kind=np.bool_),
    Field("order", ("N",), PERMUTATION, kind=np.integer),
)
