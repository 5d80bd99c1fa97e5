"""Plans along their time: samples of a trajectory, and what panels of all tasks share."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from planner_jax.sweep.figures import style

DASHED: dict[str, Any] = {"color": style.RED, "linewidth": 1.2, "linestyle": "--", "zorder": 1}
FORBIDDEN: dict[str, Any] = {"color": style.RED, "alpha": 0.08, "linewidth": 0.0}


@dataclasses.dataclass(frozen=True)
class SampledMotion:
    """A trajectory at N times."""

    time: np.ndarray  # (N,) [s]
    pos: np.ndarray  # (N, 3) [m]
    vel: np.ndarray  # (N, 3) [m/s]
    acc: np.ndarray  # (N, 3) [m/s^2]
    jerk: np.ndarray  # (N, 3) [m/s^3]


def sample_motion(coeffs: Sequence[float], durations: Sequence[float], num: int) -> SampledMotion:
    """A trajectory as `plans.parquet` holds it, at even times.

    Args:
        coeffs: flat, M pieces x ascending powers of the piece's own time x 3 axes.
        durations: (M,) [s].
        num: how many samples.
    """
    ends = np.cumsum(np.asarray(durations, float))
    pieces = np.asarray(coeffs, float).reshape(len(ends), -1, 3)
    time = np.linspace(0.0, ends[-1], num)
    piece = np.minimum(np.searchsorted(ends, time, side="right"), len(ends) - 1)
    local = time - np.concatenate([[0.0], ends[:-1]])[piece]
    powers = local[:, None] ** np.arange(pieces.shape[1])
    derivatives = []
    for order in range(4):
        factors = [math.perm(k, order) for k in range(order, pieces.shape[1])]
        scaled = pieces[piece, order:] * np.array(factors, float)[:, None]
        derivatives.append(np.einsum("nk,nki->ni", powers[:, : scaled.shape[1]], scaled))
    return SampledMotion(time, *derivatives)


def net_thrust(motion: SampledMotion, gravity: float) -> np.ndarray:
    """Thrust per unit mass  a + g e_3, (N, 3) [m/s^2]."""
    return motion.acc + gravity * np.array([0.0, 0.0, 1.0])


def body_rate(motion: SampledMotion, gravity: float) -> np.ndarray:
    """Size (N,) [rad/s] of the body rate by the Hopf fibration at zero heading.

    From  c = thrust x jerk: |z'| = |c| / |thrust|^2 across the body z axis, and
    -c_z / (|thrust| (|thrust| + thrust_z)) about it. NaN without thrust and upside down.
    """
    thrust = net_thrust(motion, gravity)
    size = np.linalg.norm(thrust, axis=1)
    cross = np.cross(thrust, motion.jerk)
    with np.errstate(all="ignore"):
        across = np.linalg.norm(cross, axis=1) / size**2
        about = cross[:, 2] / (size * (size + thrust[:, 2]))
        return np.hypot(across, about)


def planner_look(place: int, name: str, good: bool) -> dict[str, Any]:
    """Of a plan's curves: dashed if it failed, thick for the first, the sweep's own."""
    return {
        "color": style.PLANNER_COLOURS.get(name, style.INK),
        "linestyle": "-" if good else (0, (4, 1.5)),
        "linewidth": 2.2 if place == 0 else 1.5,
        "zorder": 3 if place == 0 else 2,
    }


def draw_upper_limit(axes: Axes, limit: float) -> None:
    """A limit as a dashed line, the forbidden side above it shaded."""
    top = min(max(axes.get_ylim()[1], 1.15 * limit), 3.0 * limit)
    axes.axhline(limit, **DASHED)
    axes.axhspan(limit, top, **FORBIDDEN)
    axes.set_ylim(0.0, top)


def write_verdicts(axes: Axes, case: str, plans: Sequence[tuple[str, bool, str]]) -> None:
    """The legend, each planner with the referee's word.

    Args:
        axes: a panel for itself.
        case: which one it is.
        plans: planner, whether its plan succeeds, and what the referee says.
    """
    axes.axis("off")
    place = 1.0
    text = f"{case}\nlimits: red; curves of failed plans: dashed"
    axes.text(0.0, place, text, va="top", transform=axes.transAxes)
    for name, good, word in plans:
        place -= 0.22
        colour = style.PLANNER_COLOURS.get(name, style.INK)
        word = f"{'success' if good else 'fails'}: {word}"
        axes.text(0.0, place, name, va="top", color=colour, weight="bold", transform=axes.transAxes)
        axes.text(
            0.0, place - 0.075, word, va="top", wrap=True, fontsize=9.0, transform=axes.transAxes
        )
