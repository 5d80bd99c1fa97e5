"""Measuring the diagonal scale of a planner's decision variables.

Quasi-Newton steps are only as good as the coordinates. The scale of variable i is
c_i = 1 / sqrt(floor + median H_ii), where H = J^T J is the Gauss-Newton curvature of the
planner's residuals in natural units, and the median runs over cases, each taken at its
first guess and at a solution. A new task offers `residuals` and gets its scale from here.
"""

import dataclasses
import functools
import importlib.resources
import json
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.multistart import minimise
from planner_jax.optimise.problem import Problem

_ROUNDS = 3  # of measuring with the scale that the round before has found


class ScaledPlanner(Problem, Protocol):
    """A planner, a frozen dataclass, whose scale can be measured."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def scale(self) -> tuple[float, ...]:
        """Natural unit of each scaled variable, (n,)."""
        ...

    def residuals(self, point: Array, context: Any) -> Array:
        """Residuals whose squares sum to about twice the objective near its minimum, (R,)."""
        ...


@functools.cache
def shipped_scale(package: str, name: str) -> tuple[float, ...]:
    """A measured scale, from the `measured_scales.json` of a task's package.

    `python -m benchmarks.measure_scales --write` makes those files again.

    Raises:
        ValueError: there is none of that name.
    """
    path = importlib.resources.files(package) / "measured_scales.json"
    scales = json.loads(path.read_text("utf-8"))
    if name not in scales:
        raise ValueError(
            f"no measured scale for {name!r}: give `scale`, or one of {', '.join(scales)}"
        )
    return tuple(scales[name])


def curvature_diagonal(residuals: Callable[[Array], Array], point: Array) -> Array:
    """Diagonal of J^T J of a residual function at a point (n,), shape (n,)."""
    jacobian = jax.jacfwd(residuals)(point)
    return jnp.sum(jacobian**2, axis=0)


def measure_scale(planner: ScaledPlanner, cases: Any, *, floor: float = 1e-4) -> np.ndarray:
    """Scale of every decision variable, measured on a batch of cases.

    Solutions depend on the scale they were found with, so measuring is repeated with its own
    result; two or three rounds settle it.

    Args:
        planner: a frozen dataclass with a `scale` field, the first value of which only has
            to be sensible.
        cases: a batch; a few hundred, hard ones among them, so that limits are active.
        floor: curvature that is taken as none, so that a variable which hardly matters keeps
            a finite scale.

    Returns:
        (n,) float64.
    """
    config = LbfgsConfig(max_steps=30)
    for _ in range(_ROUNDS):

        def diagonals(case: Any, planner: ScaledPlanner = planner) -> Array:
            context = planner.prepare(case)
            scale = jnp.asarray(planner.scale)
            start = planner.guesses(context, 1)[0]
            optimum = minimise(lambda x: planner.objective(x, context), start, config)

            def at(point: Array) -> Array:
                return curvature_diagonal(
                    lambda natural: planner.residuals(natural / scale, context), point * scale
                )

            return at(start) + at(optimum.point)

        curvature = np.asarray(jax.jit(jax.vmap(diagonals))(cases), np.float64)
        scale = 1.0 / np.sqrt(floor + np.nanmedian(curvature, axis=0))
        planner = dataclasses.replace(planner, scale=tuple(scale.tolist()))
    return np.asarray(planner.scale)
