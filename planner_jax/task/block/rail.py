"""An arm whose base can slide along a rail before it reaches for the ball.

The rail lies along the y axis of the base's frame, and the base stands at 0 when a ball is seen. It
slides as quickly as it can and stops, while the joints stay as they are; then the arm moves. To the
arm a shift of its base is a shift of everything else the other way round: planners and referee see
cases in the frame of the base where that stands by then, and need not know of rails. The rig of
beams carries the base and slides with it, the floor is level.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.planning.plan import plan, require_batch
from planner_jax.protocol import AnyPlanner, solved
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.clearance import least_clearances
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.wanted import chosen, plans_where

_STEP, _LOOKS = 0.005, 64  # [m], between looks at a sliding base; their number is a multiple
_MARGIN = 0.003  # [m], kept from everything while it slides


@dataclasses.dataclass(frozen=True)
class Rail:
    """Where the base may go besides 0, and how fast."""

    places: tuple[float, ...]  # [m] along y
    velocity: float = 2.0  # [m/s], > 0; infinite together with the acceleration: there at once
    acceleration: float = 10.0  # [m/s^2], > 0

    def __post_init__(self) -> None:
        if not np.isfinite(self.places).all():
            raise ValueError(f"places must be finite, got {self.places}")
        for name in ("velocity", "acceleration"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be > 0, got {getattr(self, name)}")

    def slide_time(self, place: float) -> float:
        """How long it takes to get to a place [m] from 0 and stand there [s]."""
        peak = min(np.sqrt(self.acceleration * abs(place)), self.velocity)
        return abs(place) / peak + peak / self.acceleration if 0.0 < peak < np.inf else 0.0


@struct.dataclass
class RailPlan:
    """Where on the rail each of B balls is met, and how."""

    place: Array  # (B,) [m], of the base
    cases: BlockCase  # (B, ...), in the frame of the base there; the delay includes the slide
    plans: BlockPlan  # (B, ...)


def shifted(cases: BlockCase, by: Any) -> BlockCase:
    """The same balls and surroundings as an arm sees them whose base has moved.

    Args:
        cases: one case, or a batch.
        by: (3,) or (B, 3) [m], of the base. The beams of the rig move with it.
    """
    by = jnp.asarray(by, cases.angles.dtype)
    scene = cases.scene
    back = lambda leaf: leaf - by  # noqa: E731
    return dataclasses.replace(
        cases,
        ball=dataclasses.replace(cases.ball, pos=back(cases.ball.pos)),
        scene=dataclasses.replace(
            scene,
            inner=jax.tree.map(back, scene.inner),
            outer=jax.tree.map(back, scene.outer),
            pole=scene.pole - by[..., :2],
            floor=scene.floor - by[..., 2],
        ),
    )


def slides_freely(cases: BlockCase, place: float) -> np.ndarray:
    """Whether each arm touches nothing while its base slides from 0 to a place [m], (B,) bool.

    The joints stay at the angles of the cases, leaves (B, ...).
    """
    num = _LOOKS * max(int(np.ceil(abs(place) / (_LOOKS * _STEP))), 1)
    return np.asarray(_least_clearance(cases, np.linspace(0.0, place, num + 1))) > _MARGIN


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None))
def _least_clearance(case: BlockCase, places: Array) -> Array:
    """The least distance () [m] of an arm at rest from all else, its base at places (N,) [m]."""

    def at(place: Array) -> Array:
        there = shifted(case, jnp.zeros(3, place.dtype).at[1].set(place))
        return least_clearances(there.arm, there.scene, there.angles[None])[0]

    return jnp.min(jax.vmap(at)(places))


def plan_on_rail(
    planner: AnyPlanner[BlockCase, BlockPlan], cases: BlockCase, rail: Rail
) -> RailPlan:
    """Plan each ball from where the base waits, else from the next place from which that is found.

    Places are tried in the order in which the base can be there, each with the balls that are left
    and the arms that touch nothing while it slides. The slide begins when the arm may start, and
    the arm's motion when it has ended.

    Args:
        planner: of single balls, such as `pj.block.planner()`.
        cases: a batch, with the base at 0 and the arm at rest.
        rail: of all of them.

    Returns:
        NumPy leaves; `pj.block.judge(found.cases, found.plans)` judges the arm. A ball that is not
        met from anywhere keeps its plan from place 0.

    Raises:
        ValueError: the cases are no batch, or an arm is not at rest.
    """
    require_batch(cases)
    if np.any(np.asarray(cases.rates) != 0.0):
        raise ValueError("rates must be 0: the base slides while the joints stand still")
    cases = jax.tree.map(np.asarray, cases)
    plans = jax.tree.map(np.asarray, plan(planner, cases))
    stays: Any = np.zeros_like(cases.delay)
    found = RailPlan(place=stays, cases=cases, plans=plans)
    for place in sorted(rail.places, key=rail.slide_time):
        wanted = ~solved(found.plans) & slides_freely(cases, place)
        if not wanted.any():
            continue
        there = jax.tree.map(np.asarray, shifted(cases, (0.0, place, 0.0)))
        delay = (cases.delay + rail.slide_time(place)).astype(cases.delay.dtype)
        there = dataclasses.replace(there, delay=delay)
        slides: Any = np.full_like(cases.delay, place)
        other = RailPlan(place=slides, cases=there, plans=plans_where(planner, there, wanted))
        found = chosen(solved(other.plans), other, found)
    return found
