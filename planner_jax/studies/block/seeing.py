"""A planner of blocks that knows the balls only from simulated camera observations."""

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
    """The executed motion of an arm up to the true contact, and errors of the fitted flight.

    The error is the distance of the fitted ball from the true ball, normal to the true velocity. It
    is taken halfway in time between the ball's entry into the outer box, in which the arm may meet
    it, and its entry into the protected inner box.
    """

    sight: Array  # () int32, a `Sight`: whether the first fit had enough observations
    sightings: Array  # () int32, number of observations in the first fit
    fit_error: Array  # () [m], error of the first fit
    fit_std: Array  # () [m], estimated standard deviation of this error
    last_fit_error: Array  # () [m], error of the last fit
    motions: Array  # () int32, number of motions that the arm started


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SeeingArms(Planner[BlockCase, SeenPlan]):
    """A planner that simulates camera observations, and plans from them once or repeatedly."""

    case_type: ClassVar[type] = BlockCase
    planner: Planner  # planner of the cases with estimated balls
    observe: float  # [s] time from a case's time 0 until a flight is first fitted to observations
    overhead: float  # [s] time from a fit until a motion that is planned from it may start
    replan: float  # [Hz] rate at which flights are fitted and motions planned again; 0 plans once
    noise: float  # [m] standard deviation of isotropic noise; 0 selects a stereo camera's noise
    frame_rate: float  # [Hz] frame rate of the camera
    seed: int  # seed of the noise

    def plan_by(self, drive: Drive, cases: BlockCase) -> SeenPlan:
        """Simulate observing, planning and moving; return executed motions; `drive` is unused."""
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
        """Return the motions of a batch of arms, not yet cut at their contacts with the balls."""
        return decide(
            self.planner,
            cases,
            eye(rate=self.frame_rate, std=self.noise or None),
            self.moments(cases),
            overhead=self.overhead,
            seed=self._seeds(cases),
            again=self.replan > 0.0,
        )

    def moments(self, cases: BlockCase) -> list[float]:
        """Return the times [s] at which flights are fitted, while a ball can still be blocked."""
        moments = [self.observe]
        if self.replan:
            latest = float(np.max(jax.jit(jax.vmap(flight_of))(cases).latest))
            step = 1.0 / self.replan
            moments += list(np.arange(self.observe + step, latest - self.overhead, step))
        return moments

    def _seeds(self, cases: BlockCase) -> np.ndarray:
        """Return a seed of the noise for each ball, which does not depend on the other balls."""
        balls = np.concatenate([cases.ball.pos, cases.ball.vel], axis=1).astype(np.float32)
        return np.array([zlib.crc32(ball.tobytes(), self.seed) for ball in balls], np.uint32)
