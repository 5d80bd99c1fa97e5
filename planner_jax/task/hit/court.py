"""The court of [Yu2023bat, Section VI-B]: regions, targets, 36 scenarios, and flights of serves.

World frame: z up, x towards the opponent, y to the left, net at x = 0. The opponent's half has x >
0; the quadrotor hits in the half with x < 0. Both halves are divided into regions, which are mirror
images in x: near and far from the net in a middle strip, and a strip at the left and right.

The paper states the size of the court but not the lines between regions. They are estimated from
its published serves, landing points and targets: in y the middle strip extends to at least 0.8395
m, and the side strips start at 0.8418 m or less.

Flights are computed by NumPy in float64.
"""

import numpy as np

from planner_jax.core.rules import require_rule, require_sound
from planner_jax.referee.hit import ball_step
from planner_jax.task.hit.case import HitCase

HALF_LENGTH = 5.0  # [m], from the net to a back line
HALF_WIDTH = 2.5  # [m], from the middle line y = 0 to a side line
DEAD_ZONE = 0.5  # [m], distance from the net within which no region extends
NEAR_LINE = 3.0  # [m], distance from the net of the line between near and far region
LANE_LINE = 0.84  # [m], |y| of the lines between the middle strip and the side strips

_FLIGHT_STEPS = 16  # Runge-Kutta steps of a flight; landing points are then exact to 0.1 mm
_NEWTON_STEPS = 5  # iterations that refine the time of a landing

REGIONS = "NFLR"  # near, far, left, right; numbered from 1 in files of [Yu2023bat]
# [m], target of each region of `REGIONS` in the opponent's half. Left is y > 0 in both halves.
TARGETS = ((1.75, 0.0, 0.0), (4.0, 0.0, 0.0), (3.0, 1.67, 0.0), (3.0, -1.67, 0.0))

PLANNERS = ("juggle", "bat-lite", "bat")  # planners with results in [Yu2023bat]
# Names of the 36 scenarios, such as "NFL": serve near, landing far, target left.
SCENARIOS = tuple(
    serve + landing + target
    for serve in "NFL"
    for landing in ("NFLR" if serve == "L" else "NFL")
    for target in ("NFLR" if "L" in (serve, landing) else "NFL")
)


def region_bounds(depth: float = HALF_LENGTH) -> np.ndarray:
    """Return lower and upper bounds (4, 2, 2) [m] of |x| <= `depth` and y of the `REGIONS`."""
    near, far = (DEAD_ZONE, NEAR_LINE), (NEAR_LINE, depth)
    whole, middle = (DEAD_ZONE, depth), (-LANE_LINE, LANE_LINE)
    left, right = (LANE_LINE, HALF_WIDTH), (-HALF_WIDTH, -LANE_LINE)
    return np.array([(near, middle), (far, middle), (whole, left), (whole, right)])


def scenario_regions(scenario) -> np.ndarray:
    """Return a scenario's regions of serve, landing and target: 1 near, 2 far, 3 left, 4 right."""
    codes = np.array([[1 + REGIONS.index(letter) for letter in name] for name in SCENARIOS])
    return codes[np.asarray(scenario)]


def target_of(scenario) -> np.ndarray:
    """Return the landing points (..., 3) [m] to aim at in scenarios (...), indices in SCENARIOS."""
    return np.array(TARGETS)[scenario_regions(scenario)[..., 2] - 1]


def _states(position, velocity, shape: tuple[int, ...] = ()) -> np.ndarray:
    """Return states (6, ...): NumPy is fastest if the long axes come last."""
    both = np.asarray(position, float), np.asarray(velocity, float)
    lead = np.broadcast_shapes(*(each.shape[:-1] for each in both), shape)
    both = [np.broadcast_to(each, (*lead, 3)) for each in both]
    return np.ascontiguousarray(np.moveaxis(np.concatenate(both, axis=-1), -1, 0))


def fly(position, velocity, duration, drag, gravity, *, num_steps: int = _FLIGHT_STEPS):
    """Return balls' positions [m] and velocities (..., 3) after `duration` [s], quadratic drag."""
    step = np.asarray(duration, float) / num_steps
    air = np.asarray(drag, float), np.asarray(gravity, float)
    state = _states(position, velocity, step.shape)
    for _ in range(num_steps):
        state = ball_step(state, step, air)
    return np.moveaxis(state[:3], 0, -1), np.moveaxis(state[3:], 0, -1)


def landing(position, velocity, drag, gravity):
    """Return when and where balls with quadratic drag land on the floor z = 0.

    Runge-Kutta steps lead below the floor. Newton's method then finds the time of zero height.

    Args:
        position: (..., 3) [m], with z > 0.
        velocity: (..., 3) [m/s].
        drag: (...) [1/m], coefficient of quadratic drag, >= 0.
        gravity: (...) [m/s^2], magnitude, > 0.

    Returns:
        time: (...) [s], NaN if no landing is found, as for extreme speeds or drags.
        point: (..., 3) [m], NaN if no landing is found.
    """
    state = _states(position, velocity)
    drag, gravity = np.asarray(drag, float), np.asarray(gravity, float)
    rise = state[5]
    with np.errstate(all="ignore"):
        drag_free_time = (rise + np.sqrt(rise**2 + 2.0 * gravity * state[2])) / gravity
        # Drag changes the velocity within the time 1 / (drag * speed), so a step must be shorter.
        stiffness = drag * np.linalg.norm(state[3:], axis=0) * drag_free_time
        num_steps = int(np.clip(8.0 * np.nanmax(stiffness, initial=0.0), _FLIGHT_STEPS, 1024))
        step = drag_free_time / num_steps
        time = np.zeros_like(step)
        for _ in range(8 * num_steps):
            above = state[2] > 0.0
            if not above.any():
                break
            state = np.where(above, ball_step(state, step, (drag, gravity)), state)
            time = time + np.where(above, step, 0.0)
        for _ in range(_NEWTON_STEPS):
            back = -state[2] / state[5]
            state = ball_step(state, back, (drag, gravity))
            time = time + back
    down = np.abs(state[2]) < 1e-6
    return np.where(down, time, np.nan), np.moveaxis(np.where(down, state[:3], np.nan), 0, -1)


def check_cases(cases: HitCase) -> None:
    """Raise `CaseError` unless all cases are valid and their balls land in the half x < 0."""
    require_sound(cases)
    batch, ball = cases.batch_shape, cases.ball
    position, velocity = np.asarray(ball.pos, float), np.asarray(ball.vel, float)
    height = position[..., 2]
    require_rule("height of ball.pos", height, height > 0.0, "> 0", batch)
    _, point = landing(position, velocity, cases.drag, cases.gravity)
    x = point[..., 0]
    require_rule("landing point of ball", x, x < 0.0, "in the hitting half, x < 0", batch)
