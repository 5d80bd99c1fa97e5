"""The value of an objective at a point."""

from collections.abc import Callable

from flax import struct
from jax import Array


@struct.dataclass
class Evaluation:
    """An objective at one point."""

    cost: Array  # (), what is minimised
    violation: Array  # (), largest relative excess over a limit; <= 0 is feasible


Objective = Callable[[Array], Evaluation]
