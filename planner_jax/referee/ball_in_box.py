"""Times at which a thrown ball is in a box, or gets to a rounded body, in float64 NumPy."""

import numpy as np

from planner_jax.referee.solids import from_segment, length

SIDES = ("lower", "upper")
_ENTRIES = 2049  # number of times at which a ball's distance from a rounded body is computed


def entry_time(case: dict, within: float) -> np.ndarray:
    """Return when the balls of B cases get `within` [m] into the protected body, (B,) [s].

    The body is the inner box, or the segment `inner_ends` in it, with the points up to
    `inner_radius` and the ball's radius from it.
    A ball that never gets there has the time infinity.
    """
    radius = case["scene.inner_radius"] + case["ball_radius"] - within
    begin, end = times_inside(case, "inner", radius)
    entry = np.where(end >= 0.0, np.maximum(begin, 0.0), np.inf)
    rounded = np.flatnonzero(radius > 0.0)
    if len(rounded):  # the edges of the enlarged box are rounded: sample the path in it
        begin, end = entry[:, rounded], end[:, rounded]
        never = ~np.isfinite(begin)
        share = np.linspace(0.0, 1.0, _ENTRIES)[:, None, None]
        times = np.where(never, 0.0, begin + share * np.where(never, 0.0, end - begin))
        fall = np.array([0.0, 0.0, 0.5])[:, None, None, None] * case["gravity"][rounded]
        pos, vel = (case[f"ball.{name}"][rounded].T[:, None, None] for name in ("pos", "vel"))
        lower, upper = (case[f"scene.inner.{side}"][rounded].T[:, None, None] for side in SIDES)
        path = pos + vel * times - fall * times**2
        away = length(path - np.clip(path, lower, upper))
        if (ends := case.get("scene.inner_ends")) is not None:
            away = from_segment(path, *np.moveaxis(ends[rounded], 0, 2)[:, :, None, None])
        near = away <= radius[rounded] + 1e-12
        first = np.take_along_axis(times, near.argmax(axis=0)[None], axis=0)[0]
        entry[:, rounded] = np.where(near.any(axis=0) & ~never, first, np.inf)
    return entry.min(axis=0)


def times_inside(case: dict, name: str, grown: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times at which the balls of B cases enter a box and at which they leave it.

    Both results are (2, B) [s]: a ball may pass the box while it rises (row 0) and while it falls
    (row 1). The box `name` is "inner", the protected box, or "outer", the box in which the arm may
    meet a ball. It is enlarged by `grown` [m] on all sides. A ball that is never inside enters
    at infinity and leaves at minus infinity.
    """
    pos, vel, gravity = case["ball.pos"].T, case["ball.vel"].T, case["gravity"]
    lower = case[f"scene.{name}.lower"].T - pos - grown
    upper = case[f"scene.{name}.upper"].T - pos + grown
    # Times at which the ball is between the heights of the box's bottom and top: first while it
    # rises to its highest point, then while it falls.
    highest = vel[2] / gravity
    over, under = (
        np.sqrt(vel[2] ** 2 - 2.0 * gravity * side[2]) / gravity for side in (upper, lower)
    )
    over = np.where(np.isnan(over), 0.0, over)
    begin = np.stack([highest - under, highest + over])
    end = np.stack([highest - over, highest + under])
    never = np.isnan(under)
    for k in range(2):
        stands = vel[k] == 0.0
        crossings = np.stack([lower[k], upper[k]]) / np.where(stands, 1.0, vel[k])
        begin = np.where(stands, begin, np.maximum(begin, crossings.min(axis=0)))
        end = np.where(stands, end, np.minimum(end, crossings.max(axis=0)))
        never |= stands & ((lower[k] > 0.0) | (upper[k] < 0.0))
    never = never | (begin > end)
    return np.where(never, np.inf, begin), np.where(never, -np.inf, end)
