"""Drag and wind of the cases of hits and catches: functions that make and check them."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from planner_jax.core import rules
from planner_jax.core.arithmetic import numpy_of, to_host
from planner_jax.core.checks import shape_of
from planner_jax.core.errors import ArgumentError
from planner_jax.robot.quadrotor import Air, add_drag, thrust_in_air
from planner_jax.robot.quadrotor_model import QuadrotorModel


def air_of(
    robot: QuadrotorModel, rotor_drag: object, wind: object, leaf: Callable[..., Array]
) -> Air:
    """Return the drag and wind of arguments of `case`; the robot's drag replaces None."""
    if rotor_drag is None:
        if robot.drag is None:
            raise ArgumentError("wind", "left out without rotor_drag or a robot with drag", wind)
        rotor_drag = (robot.drag.across, robot.drag.along)
    shape = (2,) if shape_of("rotor_drag", rotor_drag)[-1:] == (2,) else ()
    drag = leaf("rotor_drag", rotor_drag, *shape)
    across, along = (drag[..., 0], drag[..., 1]) if shape else (drag, drag)
    return Air(across, along, leaf("wind", (0.0, 0.0, 0.0) if wind is None else wind, 3))


def check_hover(cases: PyTree) -> PyTree:
    """Return cases with air; raise `CaseError` if hovering needs more thrust than the limits allow.

    Traced cases are marked instead, as by `require_or_mark`.
    """
    limits, gravity, air = cases.limits, cases.gravity, cases.limits.air
    still = jnp.zeros_like(air.wind)
    thrust = to_host(thrust_in_air(air, still, add_drag(air, still, still), gravity))
    most = to_host(limits.thrust_bounds[1])
    if (rotors := limits.rotors) is not None:
        lift = to_host(rotors.mixer.shape[-2] * rotors.max_thrust / rotors.mass)
        most = numpy_of(most, lift).minimum(most, lift)
    least = f"{most.min():.3g} m/s^2" if isinstance(most, np.ndarray | np.generic) else "the limit"
    words = f"weak enough to hover within {least} of thrust"
    is_enough = numpy_of(thrust, most).less_equal(thrust, most)
    return rules.require_or_mark(cases, "wind: thrust at hover", thrust, is_enough, words)
