"""Flights of returned balls in air, which referees of hits and rallies integrate."""

import numpy as np

from planner_jax.referee.hit import ball_acc, ball_step

# [s] Step and greatest duration of the integrated flight of the ball after the impact.
_OUTGOING_STEP, _LONGEST_FLIGHT = 0.01, 20.0


def _step_down_to(state, entry: int, level, air) -> tuple[np.ndarray, np.ndarray]:
    """Find the time (B,) [s] within a step at which height or vertical speed falls to `level`.

    `entry` is 2 for the height and 5 for the vertical speed in the states (6, B) of B balls. Also
    returns the states then. Newton's method starts at the end of the step, so that it converges to
    the last crossing.
    """
    step = np.full(state.shape[1], _OUTGOING_STEP)
    for _ in range(6):
        ahead = ball_step(state, step, air)
        slope = np.concatenate([ahead[3:], ball_acc(ahead[3:], air)])[entry]
        step = np.clip(step - (ahead[entry] - level) / slope, 0.0, _OUTGOING_STEP)
    return step, ball_step(state, step, air)


def return_in_air(state, height, air) -> tuple:
    """Integrate the flights of B balls in `air` until they fall to `height` (B,) [m].

    Returns the greatest heights (B,) [m] and their times, and the points (3, B) at which the balls
    fall to `height` and their times. Times [s] count from `state`, the start of the flights.
    """
    before_top, before_end, state = state.copy(), state.copy(), state.copy()
    top_time, end_time = np.zeros_like(height), np.zeros_like(height)
    flying = np.arange(len(height))
    for i in range(round(_LONGEST_FLIGHT / _OUTGOING_STEP)):
        now = state[:, flying]
        step = np.full(len(flying), _OUTGOING_STEP)
        ahead = ball_step(now, step, air[:, flying])
        rising = now[5] > 0.0
        before_top[:, flying[rising]] = now[:, rising]
        top_time[flying[rising]] = i * _OUTGOING_STEP
        before_end[:, flying], end_time[flying] = now, i * _OUTGOING_STEP
        state[:, flying] = ahead
        aloft = (ahead[5] >= 0.0) | (ahead[2] >= height[flying])
        flying = flying[aloft & np.isfinite(ahead[2])]
        if not flying.size:
            break
    step, top = _step_down_to(before_top, 5, 0.0, air)
    rises = before_top[5] > 0.0
    apex = np.where(rises, top[2], before_top[2])
    apex_time = np.where(rises, top_time + step, 0.0)
    step, end = _step_down_to(before_end, 2, height, air)
    down = apex >= height
    down[flying] = False
    landing = np.where(down, end[:3], np.nan)
    return apex, apex_time, landing, np.where(down, end_time + step, np.nan)
