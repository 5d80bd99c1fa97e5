"""The court of [Yu2023bat, Section VI-B]: regions, targets, 36 scenarios, and flights of serves.

World frame, z up, x towards the opponent, net at x = 0, y to the left. The opponent's half
has x > 0, the hitting half x < 0; the same lines, mirrored in x, divide both.

The paper gives the size of the court; the lines inside it are measured from the published
serves, landing points and targets. The lane line shows itself at 0.84 m: points of the middle
lanes reach 0.8395 m, points of the side lanes begin at 0.8418 m.

Flights are computed in float64 NumPy over whole batches, so that a bad serve is found and named
before a program is compiled for it.
"""

import numpy as np
from numpy.typing import ArrayLike

from planner_jax.core.rules import require_rule, require_sound
from planner_jax.task.hit.case import HitCase

HALF_LENGTH = 5.0  # [m], net to back line
HALF_WIDTH = 2.5  # [m], middle line to side line
DEAD_ZONE = 0.5  # [m], from the net
NEAR_LINE = 3.0  # [m], from the net; near ends and far begins, in the middle lane
LANE_LINE = 0.84  # [m], from the middle line; middle lane ends and side lane begins

_FLIGHT_STEPS = 16  # puts the landing point of a serve within 0.1 mm
_NEWTON_STEPS = 5

# Near, Far, Left, Right; the published files count them from 1.
REGIONS = "NFLR"

# Left is y > 0 in both halves.
TARGETS = ((1.75, 0.0, 0.0), (4.0, 0.0, 0.0), (3.0, 1.67, 0.0), (3.0, -1.67, 0.0))  # [m]

PLANNERS = ("juggle", "bat-lite", "bat")


def _scenario_names() -> tuple[str, ...]:
    """Serve, landing and target region of the 36 scenarios.

    A case and its mirror image in the middle line count as one, so R stands only behind an L.
    """
    return tuple(
        serve + landing + target
        for serve in "NFL"
        for landing in ("NFLR" if serve == "L" else "NFL")
        for target in ("NFLR" if "L" in (serve, landing) else "NFL")
    )


SCENARIOS = _scenario_names()


def region_bounds(depth: float = HALF_LENGTH) -> np.ndarray:
    """Return edges (4, 2, 2) [m] of regions: region; |x| up to a depth, or y; lower or upper."""
    near, far = (DEAD_ZONE, NEAR_LINE), (NEAR_LINE, depth)
    whole, middle = (DEAD_ZONE, depth), (-LANE_LINE, LANE_LINE)
    left, right = (LANE_LINE, HALF_WIDTH), (-HALF_WIDTH, -LANE_LINE)
    return np.array([(near, middle), (far, middle), (whole, left), (whole, right)])


def scenario_regions(scenario) -> np.ndarray:
    """Return region codes (..., 3), 1 to 4, of serve, landing and target of scenarios (...) int."""
    codes = np.array([[1 + REGIONS.index(letter) for letter in name] for name in SCENARIOS])
    return codes[np.asarray(scenario)]


def target_of(scenario) -> np.ndarray:
    """Target points (..., 3) [m] of scenarios given by their place in SCENARIOS."""
    return np.array(TARGETS)[scenario_regions(scenario)[..., 2] - 1]


# Inside, the axis of the components comes first: NumPy is quick along the last one.


def _acceleration(velocity: np.ndarray, drag: np.ndarray, gravity: np.ndarray) -> np.ndarray:
    """Acceleration  g - K_D |v| v  (3, ...) [Yu2023bat, eq. 2]."""
    x, y, z = velocity
    acceleration = -drag * np.sqrt(x * x + y * y + z * z) * velocity
    acceleration[2] -= gravity
    return acceleration


def _rk4_step(position, velocity, step, drag, gravity):
    """Position and velocity (3, ...) after one Runge-Kutta step (...) [s] of order 4."""
    half = 0.5 * step
    a1 = _acceleration(velocity, drag, gravity)
    a2 = _acceleration(velocity + half * a1, drag, gravity)
    a3 = _acceleration(velocity + half * a2, drag, gravity)
    a4 = _acceleration(velocity + step * a3, drag, gravity)
    return (
        position + step * velocity + step**2 / 6.0 * (a1 + a2 + a3),
        velocity + step / 6.0 * (a1 + 2.0 * (a2 + a3) + a4),
    )


def _components_first(vectors: ArrayLike) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(np.asarray(vectors, float), -1, 0))


def fly(position, velocity, duration, drag, gravity, *, num_steps: int = _FLIGHT_STEPS):
    """Return position and velocity (..., 3) of balls after a flight with quadratic drag.

    Position (..., 3) [m], velocity (..., 3) [m/s], duration [s], drag K_D [1/m] and gravity
    [m/s^2] (...) broadcast; the flight takes a number of equal Runge-Kutta steps.
    """
    step = np.asarray(duration, float) / num_steps
    drag, gravity = np.asarray(drag, float), np.asarray(gravity, float)
    position, velocity = np.asarray(position, float), np.asarray(velocity, float)
    lead = np.broadcast_shapes(position.shape[:-1], velocity.shape[:-1], step.shape)
    position, velocity = (
        _components_first(np.broadcast_to(vector, (*lead, 3))) for vector in (position, velocity)
    )
    for _ in range(num_steps):
        position, velocity = _rk4_step(position, velocity, step, drag, gravity)
    return np.moveaxis(position, 0, -1), np.moveaxis(velocity, 0, -1)


def landing(position, velocity, drag, gravity):
    """Return when and where balls come down to the floor z = 0 if nobody hits them.

    Flies in equal steps until the ball is below the floor, then back to it by Newton's method on
    the height, each of its steps a Runge-Kutta step.

    Args:
        position: (..., 3) [m], with z > 0.
        velocity: (..., 3) [m/s].
        drag: (...) K_D [1/m], >= 0.
        gravity: (...) [m/s^2], magnitude, > 0.

    Returns:
        time: (...) [s] from now.
        point: (..., 3) [m]. Both are NaN for balls that are never down: too fast to compute with,
            or held up by a drag out of all proportion.
    """
    vectors = np.broadcast_arrays(np.asarray(position, float), velocity)
    point, velocity = (_components_first(vector) for vector in vectors)
    drag, gravity = np.asarray(drag, float), np.asarray(gravity, float)
    rise = velocity[2]
    with np.errstate(all="ignore"):
        drag_free_time = (rise + np.sqrt(rise**2 + 2.0 * gravity * point[2])) / gravity
        # Drag slows a ball down within 1 / (drag speed); a step must be a fraction of that.
        stiffness = drag * np.linalg.norm(velocity, axis=0) * drag_free_time
        num_steps = int(np.clip(8.0 * np.nanmax(stiffness, initial=0.0), _FLIGHT_STEPS, 1024))
        step = drag_free_time / num_steps
        time = np.zeros_like(step)
        for _ in range(8 * num_steps):
            above = point[2] > 0.0
            if not above.any():
                break
            ahead = _rk4_step(point, velocity, step, drag, gravity)
            point, velocity = np.where(above, ahead, (point, velocity))
            time = time + np.where(above, step, 0.0)
        for _ in range(_NEWTON_STEPS):
            back = -point[2] / velocity[2]
            point, velocity = _rk4_step(point, velocity, back, drag, gravity)
            time = time + back
    down = np.abs(point[2]) < 1e-6
    return np.where(down, time, np.nan), np.moveaxis(np.where(down, point, np.nan), 0, -1)


def check_cases(cases: HitCase) -> None:
    """Raise `CaseError` for the first rule that some lane of a batch breaks.

    Every number keeps the rules of `HitCase`; the ball is above the floor, and comes down in the
    hitting half, x < 0. The leaves must be concrete.
    """
    require_sound(cases)
    batch, ball = cases.batch_shape, cases.ball
    position, velocity = np.asarray(ball.pos, float), np.asarray(ball.vel, float)
    height = position[..., 2]
    require_rule("height of ball.pos", height, height > 0.0, "> 0", batch)
    _, point = landing(position, velocity, cases.drag, cases.gravity)
    x = point[..., 0]
    require_rule("landing point of ball", x, x < 0.0, "in the hitting half, x < 0", batch)
