"""Arms that block balls which they observe with a camera, and records of the observations."""

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
    """The executed motion of an arm up to the true contact, and the quality of its observations."""

    sight: Array  # () int32, a `Sight`, of the first fit
    sightings: Array  # () int32, number of observations in the first fit
    fit_error: Array  # () [m], of the first fit, normal to the flight midway between the boxes
    fit_std: Array  # () [m], its estimated standard deviation
    last_fit_error: Array  # () [m], of the last fit
    motions: Array  # () int32, number of started motions


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SeeingArms(Planner[BlockCase, SeenPlan]):
    """Arms that plan from camera observations, once or repeatedly."""

    case_type: ClassVar[type] = BlockCase
    planner: Planner
    observe: float  # [s], until the first fit
    overhead: float  # [s], from a fit until its motion may start
    replan: float  # [Hz], rate of later fits; 0 for no later fit
    observe_longer: float  # [s], greatest delay of the first motion for more observations
    noise: float  # [m], isotropic; 0 for the noise of a stereo camera
    frame_rate: float  # [Hz]
    seed: int

    def plan_by(self, drive: Drive, cases: BlockCase) -> SeenPlan:
        """Return the executed motions of a batch, up to their contacts with the true balls."""
        done = self.decide_batch(cases)
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

    def decide_batch(self, cases: BlockCase) -> Decided:
        """Return the decisions of a batch of arms, without their contacts."""
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
        """Return the times of the fits [s], repeated until the last ball of a batch arrives."""
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
        """Return a seed (B,) for each throw's noise, independent of the batch."""
        balls = np.concatenate([cases.ball.pos, cases.ball.vel], axis=1).astype(np.float32)
        return np.array([zlib.crc32(ball.tobytes(), self.seed) for ball in balls], np.uint32)
