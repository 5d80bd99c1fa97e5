"""Arms that block balls which they only see, and what they saw."""

import dataclasses
import zlib
from typing import ClassVar

import jax
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.planner import Drive, Planner
from planner_jax.core.protocol import take
from planner_jax.studies.block.contact_check import end_at_contact
from planner_jax.studies.block.observation import eye
from planner_jax.studies.block.receding import Decided, decide
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.end_poses import flight_of
from planner_jax.task.block.plan import BlockPlan


@struct.dataclass
class SeenPlan(BlockPlan):
    """What an arm does that sees its ball, up to the true contact; and how well it saw."""

    sight: Array  # () int32, a `Sight`, of the first fit
    sightings: Array  # () int32, of the first fit
    fit_error: Array  # () [m], of the first fit, across the flight midway between the boxes
    fit_std: Array  # () [m], what it is believed to be
    last_fit_error: Array  # () [m], of the last fit
    motions: Array  # () int32, that were begun


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SeeingArms(Planner[BlockCase, SeenPlan]):
    """Arms that plan with what a camera has seen, once or again and again."""

    case_type: ClassVar[type] = BlockCase
    planner: Planner
    observe: float  # [s], until the first fit
    overhead: float  # [s]
    replan: float  # [Hz], rate of later fits; 0 for none
    observe_longer: float  # [s], that an arm may watch longer before it begins
    noise: float  # [m], round; 0 for that of a stereo camera
    frame_rate: float  # [Hz]
    seed: int

    def plan_by(self, drive: Drive, cases: BlockCase) -> SeenPlan:
        """Return what the arms of a batch do, up to where they meet the true balls."""
        done = self.decided(cases)
        (error, std), (last, _) = (done.fit_errors(place) for place in (0, -1))
        first = take(done.fits, 0)
        met = end_at_contact(done.cases, done.plans)
        return jax.tree.map(
            np.asarray,
            SeenPlan(
                **vars(met),
                sight=first.status,
                sightings=first.num,
                fit_error=error,
                fit_std=std,
                last_fit_error=last,
                motions=done.motions,
            ),
        )

    def decided(self, cases: BlockCase) -> Decided:
        """Return what the arms of a batch do, wherever they meet their balls."""
        return decide(
            self.planner,
            cases,
            eye(rate=self.frame_rate, std=self.noise or None),
            self.moments(cases),
            overhead=self.overhead,
            seed=self._seeds(cases),
            patient=self.observe_longer > 0.0,
            again=self.replan > 0.0,
        )

    def moments(self, cases: BlockCase) -> list[float]:
        """Return when flights are fitted [s]; again until the last ball of a batch is there."""
        moments = [self.observe]
        if self.observe_longer:
            num = int(self.observe_longer * self.frame_rate + 1e-6)
            moments += [self.observe + k / self.frame_rate for k in range(1, num + 1)]
        if self.replan:
            latest = float(np.max(jax.jit(jax.vmap(flight_of))(cases).latest))
            step = 1.0 / self.replan
            moments += list(np.arange(self.observe + step, latest - self.overhead, step))
        return moments

    def _seeds(self, cases: BlockCase) -> np.ndarray:
        """Return a seed (B,) of each throw's noise, the same in whatever batch it is."""
        balls = np.concatenate([cases.ball.pos, cases.ball.vel], axis=1).astype(np.float32)
        return np.array([zlib.crc32(ball.tobytes(), self.seed) for ball in balls], np.uint32)
