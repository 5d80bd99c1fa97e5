"""How a car comes to a stand behind its meeting: it brakes evenly, and steers to some curvature.

Of a few ways that keep the car's limits by construction, the first that the referee lets pass is
taken: the map, what stands and what moves are its to judge, until the car stands.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from planner_jax.core.errors import NoEnding
from planner_jax.referee.rest import referee_stops
from planner_jax.robot.car import CarPlan

_SPARE = 0.98  # share of each limit that is used
# Shares of the greatest deceleration; and of the greatest curvature, to the left, behind that which
# the car has at the meeting.
_DECELERATIONS = (1.0, 0.7, 0.4)
_CURVATURES = (0.0, 0.5, -0.5, 1.0, -1.0)
_USUAL = 1.0  # [m/s^2] and [1/m], where there is no limit


def braked_car(case: Any, found: CarPlan) -> CarPlan:
    """One plan of a car that goes on until the car stands.

    Args:
        case: with limits, body, map and obstacles; one case.
        found: the plan.

    Raises:
        NoEnding: the referee lets none of the ways pass.
    """
    why = ""
    for speed, curvature in _ways(case, found):
        step = float(found.time) / (len(found.speed) - 1)
        rest = _continued(found, step * (len(speed) - 1), speed, curvature)
        sentence = referee_stops(case, found, rest)
        if not sentence:
            whole = (
                np.concatenate([np.asarray(first), then[1:]])
                for first, then in ((found.speed, speed), (found.curvature, curvature))
            )
            return _continued(found, float(found.time) + float(rest.time), *whole)
        why = why or sentence
    raise NoEnding(why)


def _continued(found: CarPlan, time: float, speed: np.ndarray, curvature: np.ndarray) -> CarPlan:
    """A `CarPlan` of other knots, and the rest of a plan."""
    names = [field.name for field in dataclasses.fields(CarPlan)]
    kept: dict[str, Any] = {name: getattr(found, name) for name in names}
    for name, each in (("time", time), ("speed", speed), ("curvature", curvature)):
        kept[name] = np.asarray(each, np.float32)
    return CarPlan(**kept)


def _ways(case: Any, found: CarPlan) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Speeds and curvatures (n + 1,) at knots as far apart as the plan's, from its last one on."""
    limits = case.limits
    step = float(found.time) / (len(found.speed) - 1)
    first, bend = float(found.speed[-1]), float(found.curvature[-1])
    quickest = float(limits.acceleration)
    sharpest = float(limits.curvature)
    quickest = quickest if np.isfinite(quickest) else _USUAL
    sharpest = sharpest if np.isfinite(sharpest) else _USUAL
    wanted = [bend, *(_SPARE * share * sharpest for share in _CURVATURES)]
    # The steering angle turns fastest where the way is straight.
    turn = _SPARE * float(limits.steering_rate) / float(case.body.wheelbase) * step
    for share in _DECELERATIONS:
        num = max(int(np.ceil(first / (_SPARE * share * quickest * step))), 1)
        speed = first * np.linspace(1.0, 0.0, num + 1)
        # No tighter than the lateral acceleration allows at the speed before.
        before = np.maximum(speed[:-1] ** 2, 1e-9)
        most = np.maximum(_SPARE * float(limits.lateral_acceleration) / before, abs(bend))
        for target in wanted:
            curvature = [bend]
            for bound in most:
                change = np.clip(target - curvature[-1], -turn, turn)
                curvature.append(np.clip(curvature[-1] + change, -bound, bound))
            yield speed, np.array(curvature)
