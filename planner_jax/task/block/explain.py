"""Reasons why an arm does not block a ball: no pose, no clear pose, or no clear pose in time."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.core.checks import require_kind
from planner_jax.core.choices import require
from planner_jax.robot.arm import shield_inradius
from planner_jax.robot.arm_dynamics import USED
from planner_jax.robot.arm_motion import least_times
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.problem.check import torque_excess
from planner_jax.task.block.problem.end_poses import poses_at
from planner_jax.task.block.problem.flight import Flight, flight_of

_PIECES = 10  # see `poses_at`
# Contacts are sampled in rounds: first evenly, then near the best contacts, ever closer to them.
_ROUNDS, _POINTS, _BEST = 8, 160, 16
_SPREAD, _NARROWER = 0.25, 0.45  # standard deviation in the second round, and its ratio to the next
_TOUCH = 1e-3  # [m], greatest depth of two bodies in each other that the referee accepts
_SURE = 1e-2  # [s], time that later samples could still save


@dataclasses.dataclass(frozen=True)
class Prospects:
    """Numbers of poses in which an arm meets a ball, and the time that the arm lacks.

    In a pose the shield meets the ball where it may be blocked, off the shield's middle and tilted
    as far as the case allows. Inverse kinematics find the poses at 1280 samples of time, offset and
    tilt. Obstacles between start and poses are ignored.

    Attributes:
        poses: number of poses within the limits of the joint angles.
        clear: number of these poses in which the arm touches nothing.
        later: [s], time by which the ball would have to come later for the clear pose that is
            reached soonest, negative if this pose is reached early. Each joint has its own least
            time by its limits, and obstacles on the way are ignored. Infinite without a clear pose.
        torque: greatest ratio of a joint's torque to its limit, in the straight motion to the clear
            pose in time that needs the least ratio. 0 without limits of torque, infinite if no
            clear pose is in time.
        start: [m], least distance between two bodies at the start.
    """

    poses: int
    clear: int
    later: float
    torque: float = 0.0
    start: float = np.inf

    @property
    def is_impossible(self) -> bool:
        """True if no sampled pose is clear and in time, or if the arm starts in a collision."""
        return self.start < -_TOUCH or not self.clear or self.later > _SURE

    def sentence(self) -> str:
        """Describe why the ball cannot be blocked, or that a search for a motion may succeed."""
        near = f", and the arm starts {1e3 * self.start:.2g} mm from a body"
        return self._of_poses() + (near if 0.0 <= self.start < OnlineBlock.margin else "")

    def _of_poses(self) -> str:
        if not self.poses:
            return "the shield cannot get to the ball's path between the two boxes"
        if not self.clear:
            return f"the arm touches something in all {self.poses} poses that meet the ball"
        if self.start < -_TOUCH:
            return f"at the start bodies are {-self.start:.3g} m inside each other"
        if self.later > _SURE:
            return f"the ball is too early: the arm is ready {self.later:.3f} s after it"
        if self.torque > 1.0:
            return (
                "the motors may be too weak: straight motions to clear poses in time need at least "
                f"{self.torque:.0%} of a joint's greatest torque"
            )
        return (
            f"{self.clear} of {self.poses} poses that meet the ball are clear, and one is reached "
            f"{max(-self.later, 0.0):.3f} s early if nothing is in the way"
        )


def prospects(case: BlockCase) -> Prospects:
    """Return whether an arm's poses meet the ball, are clear and in time, and the torques.

    Use the function for a case that no planner solves. If a clear pose is in time, either the
    search failed, or no way round the obstacles is short enough.

    Args:
        case: one case.

    Raises:
        ValueError: there is a batch of cases instead of one case.
        TypeError: the case is not a `BlockCase`.
    """
    require_kind("case", case, BlockCase)
    require(case.batch_shape == (), "case", "one case", shown=f"batch shape {case.batch_shape}")
    start, *measured = _measure(case)
    found, gaps, late, torque = (np.asarray(each) for each in measured)
    is_clear = found & (gaps >= -_TOUCH)
    later = float(np.min(late, initial=np.inf, where=is_clear))
    torque = float(np.min(torque, initial=np.inf, where=is_clear & (late <= _SURE)))
    return Prospects(int(found.sum()), int(is_clear.sum()), later, torque, float(start))


@jax.jit
def _measure(case: BlockCase) -> tuple[Array, ...]:
    """Return the least distance [m] at the start, and four arrays (rounds, C) of C poses a round.

    The arrays are whether the pose exists, its least distance [m], the time [s] by which the arm is
    late, and the greatest ratio of a torque to its limit.
    """
    flight, dtype, rng = flight_of(case), case.angles.dtype, np.random.default_rng(0)
    evenly = rng.uniform(-1.0, 1.0, (_POINTS, 6))
    evenly[:, 0] = (2.0 * np.arange(_POINTS) + 1.0) / _POINTS - 1.0
    spread = _SPREAD * _NARROWER ** np.arange(_ROUNDS)
    steps = spread[:, None, None] * rng.normal(size=(_ROUNDS, _POINTS, 6))

    def sample(state: tuple[Array, Array, Array], step: Array) -> tuple[tuple, tuple]:
        shares, best, costs = state
        found, gaps, late, torque, start = _measure_contacts(case, flight, shares)
        # Poses that are reached in time are the best; then clear ones, then those that exist.
        cost = jnp.where(gaps >= -_TOUCH, late, 1e2 - gaps)
        cost = jnp.min(jnp.where(found, cost, 1e4).reshape(_POINTS, -1), axis=1)
        every, costs = jnp.concatenate([best, shares]), jnp.concatenate([costs, cost])
        order = jnp.argsort(costs)[:_BEST]
        near = jnp.tile(every[order], (_POINTS // _BEST, 1)) + step
        return (jnp.clip(near, -1.0, 1.0), every[order], costs[order]), (
            found,
            gaps,
            late,
            torque,
            start,
        )

    shares = jnp.asarray(evenly, dtype)
    first = shares, shares[:_BEST], jnp.full(_BEST, jnp.inf, dtype)
    *measured, start = lax.scan(sample, first, jnp.asarray(steps, dtype))[1]
    return start[0], *measured


def _measure_contacts(case: BlockCase, flight: Flight, shares: Array) -> tuple[Array, ...]:
    """Return measurements of the poses at contacts that shares (P, 6) in [-1, 1] describe.

    They are the four arrays of `_measure` for one round, and the least distance () at the start.
    The shares are of the time, the offset (2), the tilt (2) and the last joint's angle.
    """

    def in_disc(share: Array) -> Array:
        return share / jnp.maximum(jnp.sqrt(jnp.sum(share**2, axis=1, keepdims=True)), 1.0)

    middle, half = 0.5 * (flight.earliest + flight.latest), 0.5 * (flight.latest - flight.earliest)
    most = jnp.minimum(case.offset, shield_inradius(case.arm))
    offset, tilt = most * in_disc(shares[:, 1:3]), case.tilt * in_disc(shares[:, 3:5])
    poses = poses_at(case, flight, middle + half * shares[:, 0], offset, _PIECES, tilt)
    if case.arm.turns_in_plane:  # half of the poses keep the last joint's angle
        turn = jnp.sign(shares[:, 5]) * jnp.maximum(jnp.abs(shares[:, 5]) - 0.5, 0.0)
        last = case.angles[-1] + jnp.pi * jnp.repeat(turn, len(poses.time) // len(shares))
        last = jnp.clip(last, case.arm.lower[-1], case.arm.upper[-1])
        poses = dataclasses.replace(poses, angles=poses.angles.at[:, -1].set(last))
    settings = case.rates, case.limits.velocity, case.limits.acceleration, case.ends_at_rest
    away = poses.angles - case.angles[None]
    least = jax.vmap(lambda away: jnp.max(least_times(away, *settings)[0]))(away)
    late = case.delay + least - poses.time
    torque = jnp.zeros_like(late)
    if case.limits.torque is not None:
        online = OnlineBlock(pieces=_PIECES)
        points = jax.vmap(lambda k: online.encode_straight(case, poses, k))(jnp.arange(len(late)))
        excess = jax.vmap(lambda point: torque_excess(online, case, point))(points)
        torque = USED * (1.0 + excess)
    gaps = case.clearances(jnp.concatenate([poses.angles, case.angles[None]]))
    return poses.is_found, gaps[:-1], late, torque, gaps[-1]
