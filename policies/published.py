"""The decision policy of [Yu2023catch, Section IV]: observation, action, reward and decision.

The policy proposes a time for each target; the order of the catches is the order of these times. A
network is trained for one number of targets. The paper states neither the coefficients of the
reward nor the least time of a catch. They are assumptions here, as is the scale of the observation.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.typing import ArrayLike

from planner_jax.core.checks import require_number
from planner_jax.core.choices import require
from planner_jax.core.rules import POSITIVE
from planner_jax.penalties.catches import length, net_angle_excess, net_distance
from planner_jax.penalties.flight import (
    body_rate_excess,
    ground_excess,
    speed_excess,
    thrust_band_excess,
)
from planner_jax.policies.settings import LEAST_TIME
from planner_jax.robot.attitude import tilt_quaternion
from planner_jax.robot.quadrotor import body_z
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.context import targets_at
from planner_jax.task.catch.decide import CatchDecision
from planner_jax.task.catch.estimate import INSTANT
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.trajectory.polynomial import evaluate, sample_pieces

SCALE = 4.0  # [m], [m/s]: divisor of the observed positions and velocities
TOLERANCE = 0.05  # relative excess over a limit that counts as kept, as in the authors' C++ code
# The arguments of `pj.catch.judge` for the rule of success of [Yu2023catch].
PAPER_RULE: dict[str, Any] = {"tolerance": TOLERANCE, "net_test": "ball"}
_NODES = 16  # number of intervals per polynomial piece at whose ends the limits are checked


@struct.dataclass
class RewardWeights:
    """The coefficients of the reward [Yu2023catch, eq. 8], whose values are not published."""

    caught: Array | float = 5.0  # lambda_n, of the number of caught targets
    cost: Array | float = 0.1  # lambda_c, of the logarithm of the trajectory's cost
    time: Array | float = 1.0  # lambda_t [1/s], of the change of the times by the planner


USUAL_WEIGHTS = RewardWeights()


def observe_published(case: CatchCase) -> Array:
    """Return the state (10 + 6 N,) of one case with N targets [Yu2023catch, eq. 6].

    It holds the quadrotor's position (3,), attitude (4,) and velocity (3,), then the positions
    (N, 3) and the velocities (N, 3) of the targets, all at time 0 in the world frame, relative to
    the case's origin. The attitude is the unit quaternion w x y z, w >= 0, at zero heading. Lengths
    are divided by 4 m and speeds by 4 m/s. The numbers of absent targets are zero.
    """
    pos, vel, acc, _ = case.head_state
    now = targets_at(case.targets, jnp.zeros_like(case.horizon))
    targets = jnp.where(case.present[:, None], jnp.stack([now.pos, now.vel]), 0.0)
    quat = SCALE * tilt_quaternion(acc, case.gravity)
    return jnp.concatenate([pos, quat, vel, targets.ravel()]) / SCALE


def times_of(
    action: Array, t_min: ArrayLike, t_max: Array, present: ArrayLike = True
) -> CatchChoice:
    """Return the order and times of catches for an action [Yu2023catch, eq. 7].

    Times are linear in the action: -1 is `t_min` and 1 is `t_max`, to which they are clipped (the
    paper's masking of invalid actions). The targets are caught in the order of these times, and
    those with equal times in the order of their indices. Consecutive times are then moved apart to
    differ by at least `INSTANT` (0.05 s), within the bounds.

    Args:
        action: (N,), any numbers.
        t_min: () [s], least time of a catch, at most the least `t_max` - 0.05 s (N - 1).
        t_max: (N,) [s], greatest time of the catch of each target.
        present: (N,) bool, whether each target exists; absent targets are last in the order.
    """
    wanted = jnp.clip(t_min + 0.5 * (t_max - t_min) * (1.0 + action), t_min, t_max)
    order = jnp.argsort(jnp.where(present, wanted, jnp.inf), stable=True).astype(jnp.int32)
    steps = jnp.asarray(INSTANT * np.arange(wanted.size), wanted.dtype)
    rising = lax.cummax(wanted[order] - steps)
    latest = lax.cummin(t_max[order] - steps, reverse=True)
    times = jnp.minimum(rising, latest) + steps
    return CatchChoice(order=order, times=times, taken=jnp.ones(wanted.shape, bool))


def published_reward(
    caught: ArrayLike,
    total: ArrayLike,
    cost: ArrayLike,
    decided: Array,
    optimised: Array,
    weights: RewardWeights = USUAL_WEIGHTS,
) -> Array:
    """Return the reward () of one decision [Yu2023catch, eq. 8].

    It is r = l_n (e^(n - N) - e^-N) - l_c ln J - l_t |T_p - T_o|. Of N = `total` () targets
    n = `caught` () are caught, and J = `cost` () > 0 is the cost of the planned trajectory
    [Yu2023catch, eq. 18]. T_p = `decided` (N,) and T_o = `optimised` (N,) [s] are the times of the
    catches before and after planning, in the same order. The gradient of the last term is zero at
    T_p = T_o.
    """
    caught, total, cost = (jnp.asarray(each, decided.dtype) for each in (caught, total, cost))
    catches = weights.caught * (jnp.exp(caught - total) - jnp.exp(-total))
    change = weights.time * length(decided - optimised)
    return catches - weights.cost * jnp.log(cost) - change


def count_caught(case: CatchCase, plan: CatchPlan, tolerance: float = TOLERANCE) -> Array:
    """Return how many targets () int a plan of one case catches; 0 if it exceeds a limit.

    These are the checks of "dynamic, safety and catching constraints" of
    [Yu2023catch, Section VII-A], at samples of the trajectory. A target is caught if it is within
    the net's radius of the net's centre, in the permitted angle, not after its horizon. All limits
    may be exceeded by the relative `tolerance`.
    """
    gravity, limits, above = case.gravity, case.limits, 1.0 + tolerance
    least, most = limits.thrust_bounds
    motion = sample_pieces(plan.trajectory, _NODES)
    lowest = limits.min_height - tolerance * jnp.abs(limits.min_height)
    excess = (
        speed_excess(motion.vel, above * limits.speed),
        body_rate_excess(motion.acc, motion.jerk, gravity, above * limits.body_rate),
        thrust_band_excess(motion.acc, gravity, (1.0 - tolerance) * least, above * most),
        ground_excess(motion.height, lowest),
    )
    at = lambda order: jax.vmap(lambda time: evaluate(plan.trajectory, time, order))  # noqa: E731
    axis = body_z(at(2)(plan.times), gravity)
    ball = targets_at(jax.tree.map(lambda leaf: leaf[plan.order], case.targets), plan.times)
    miss = net_distance(at(0)(plan.times), axis, ball.pos, case.net.height)
    caught = (miss <= above * case.net.radius) & case.present[plan.order]
    caught &= net_angle_excess(axis, ball.vel, above * case.net.max_angle) <= 0.0
    caught &= plan.times <= case.horizon[plan.order]
    return jnp.where(jnp.all(jnp.stack(excess) <= 0.0), jnp.sum(caught), 0)


@struct.dataclass
class PublishedPolicy(CatchDecision):
    """A decision by the network of [Yu2023catch]: one proposal, the mean of its actions."""

    params: Any  # weights of the network, the leaves of this pytree
    network: Any = struct.field(pytree_node=False)  # a `networks.PublishedMlp`
    t_min: float = struct.field(pytree_node=False, default=LEAST_TIME)  # [s], see `times_of`

    def __post_init__(self) -> None:
        require_number("t_min", self.t_min, POSITIVE)

    def check(self, cases: CatchCase) -> None:
        """Raise `ValueError` unless the cases have the network's number of required targets."""
        size, num = self.network.size, cases.num_targets
        require(num == size, "cases", f"cases of {size} targets for this policy", num)
        require(not cases.optional, "cases", "cases without optional targets for this policy", True)

    def propose(self, case: CatchCase) -> CatchChoice:
        """Return the order and times (1, N) of the catches in one case with N targets."""
        mean = self.network.apply(self.params, observe_published(case))[: self.network.size]
        choice = times_of(mean, self.t_min, case.horizon, case.present)
        return jax.tree.map(lambda leaf: leaf[None], choice)
