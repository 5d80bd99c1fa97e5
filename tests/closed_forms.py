"""Closed forms of court regions and of targets' paths, with which tests compare the library."""

import numpy as np

from planner_jax.task.hit import court


def region_of(x, y):
    """Return the court region (...) at x, y [m]: 1 near, 2 far, 3 left, 4 right, or 0 outside."""
    depth, aside = np.abs(x), np.abs(y)
    inside = (depth >= court.DEAD_ZONE) & (depth <= court.HALF_LENGTH) & (aside <= court.HALF_WIDTH)
    middle = np.where(depth < court.NEAR_LINE, 1, 2)
    side = np.where(np.asarray(y) > 0.0, 3, 4)
    return np.where(inside, np.where(aside < court.LANE_LINE, middle, side), 0)


def recursion(state, controls, step):
    """Return the states (K + 1, 4) of a target by the matrices A and B of [Qu2022, eq. 3]."""
    a, states = np.kron([[1.0, step], [0.0, 1.0]], np.eye(2)), [np.asarray(state, float)]
    b = np.kron([[0.0, 0.0], [0.0, 1.0]], np.eye(2))
    for control in controls:
        states.append(a @ states[-1] + b @ [0.0, 0.0, *control])
    return np.stack(states)


def positions_on(path, times):
    times = np.asarray(times, float)
    if hasattr(path, "begin"):  # a delayed `ControlledPath`, whose controls last long enough
        num, positions = len(path.begin), []
        for k, when in enumerate(np.broadcast_to(times, (num, *times.shape[-1:]))):
            state, controls, step = (
                leaf[k] for leaf in (path.path.state, path.path.controls, path.path.step)
            )
            knots = step * np.arange(len(controls) + 1) - path.begin[k]
            columns = recursion(state, controls, step)[:, :2].T
            positions.append(np.stack([np.interp(when, knots, each) for each in columns], axis=-1))
        return np.stack(positions)
    pos, vel = (np.asarray(leaf, float) @ [1.0, 1.0j] for leaf in (path.pos, path.vel))
    rate = np.asarray(path.turn_rate, float)
    if times.ndim:
        pos, vel, rate = pos[..., None], vel[..., None], rate[..., None]
    angle = rate * times
    safe = np.where(angle == 0.0, 1.0, angle)
    point = pos + vel * times * np.where(angle == 0.0, 1.0, np.expm1(1j * safe) / (1j * safe))
    return np.stack([point.real, point.imag], axis=-1)
