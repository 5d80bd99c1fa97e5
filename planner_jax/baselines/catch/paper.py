"""The `catch` planner of [Yu2023catch]: contact and attitude as penalties (its eqs 18-28)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.baselines.parts.minimum_jerk import minimum_jerk
from planner_jax.core.arithmetic import components
from planner_jax.core.choices import require, require_size
from planner_jax.core.protocol import require_settings
from planner_jax.cost.along import Along, integrate_along
from planner_jax.cost.quadrotor import ground_excess, speed_excess
from planner_jax.optimise.planner import OptimisedPlanner, pending
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, Round, Stage
from planner_jax.robot.quadrotor import QuadrotorLimits, body_rate_squared, body_z
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.context import (
    CatchContext,
    facing_cosine,
    is_too_far,
    order_targets,
    targets_at,
)
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.trajectory.polynomial import Motion, evaluate
from planner_jax.trajectory.proportional_minco import (
    Chain,
    ProportionalMinco,
    chain_rows,
    chain_trajectory,
    proportional_minco,
    sample_motion,
    trajectory_energy,
)

_ORDER = 4  # minimum snap
# Units of the offsets, and of the variables of a catch, log duration to jerk. They are tuned on the
# cost gap of generated throws, since with stiff hinges the Hessian varies strongly between points.
_OFFSET_SCALE = 0.05
_CATCH_SCALE = (0.035, *(0.06,) * 3, *(0.6,) * 3, *(1.2,) * 3, *(2.4,) * 3)
_PATIENT = {
    "memory": 16,
    "trial_steps": (1.0, 2.5, 0.3, 0.05),
    "tolerance": 1e-8,
    "patience": 10,
}
COST_UNIT = 1e3  # scales the Hessian to moderate entries


def limits_excess(motion: Motion, given: tuple[Array, QuadrotorLimits]) -> tuple[Array, ...]:
    """Return the excess of samples over speed, body rate, thrust and ground limits (eqs 26-28).

    Squares are in their own units. `given` is a case's gravity and limits.
    """
    gravity, limits = given
    return (
        speed_excess(motion.vel, limits) * limits.speed**2,
        body_rate_squared(motion.acc, motion.jerk, gravity) - limits.body_rate**2,
        thrust_band_excess(motion.acc, gravity, *limits.thrust_bounds),
        ground_excess(motion.height, limits),
    )


def steep_hinge(x: Array, width: float | Array) -> Array:
    """Return L_eps(x) for eps = width: cubic up to eps, then far steeper [Yu2023catch, eq. 23].

    Above eps it is eps^3 + (x - eps)^2 x / eps^4, as printed. The value is continuous at eps, but
    the slope drops from 3 eps^2 to 0.
    """
    inside = jnp.clip(x, 0.0, width)
    beyond = jnp.maximum(x - width, 0.0)
    return inside**3 + beyond**2 * (beyond + width) / width**4 * (x > width).astype(x.dtype)


def thrust_band_excess(acc: Array, gravity: Array, least: Array, most: Array) -> Array:
    """Return (f - middle)^2 - half^2 [m^2/s^4] for the thrust f of accelerations (..., 3).

    The code of [Yu2023catch] has this form. The thrust limits are per unit mass [m/s^2]; their
    middle and half width are `middle` and `half`.
    """
    x, y, z = components(acc)
    z = z + gravity
    thrust = jnp.sqrt(jnp.maximum(x * x + y * y + z * z, 1e-6))
    middle, half = 0.5 * (most + least), 0.5 * (most - least)
    return (thrust - middle) ** 2 - half**2


@struct.dataclass
class Catch:
    """The N catches that a point of the search space describes."""

    times: Array  # (N,) [s]
    durations: Array  # (N,) [s], of the segments
    tail_states: Array  # (N, 4, 3) of the quadrotor
    miss: Array  # (N,) [m], from the net's centre to the ball
    angle_excess: Array  # (N,) cos(theta_safe) + z_d . v / |v|; <= 0 is good


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class PaperCatch(OptimisedPlanner):
    """The joint optimisation of catching time and state of [Yu2023catch].

    Cost (eqs 18-28): integral |snap|^2 + rho T + the smoothed penalties of speed, body rate, thrust
    and ground by the trapezoid rule + the penalties of the net's distance (eqs 22-24) and angle
    (eq. 25). The paper reports neither weights nor thresholds; they come from the published C++
    protocol, with squares in their own units. All pieces of a segment have the same duration, and
    the jerk at the last catch is zero.

    The variables are a change of coordinates of the paper's variables, so that the optima are the
    same: waypoints are whitened offsets, and the position at the catch is the net's offset from the
    ball. N segments have 3 (M - 1) + 13 decision variables each: offsets, log duration, miss,
    velocity, acceleration and jerk (unused at the last catch).

    This planner ignores a case's extras; the referee checks them.
    """

    case_type = CatchCase
    num_pieces: int = 4  # M, of one segment
    nodes: int = 16  # penalty intervals per piece
    time_weight: float = 1000.0  # rho
    limit_weight: float = 1e5
    ground_weight: float = 1e7
    miss_weight: float = 1e4
    angle_weight: float = 1e2
    hinge_width: float = 0.01  # mu, and eps of the angle
    # The hinges are stiff, so that their weights increase in stages.
    rounds: tuple[Round, ...] = (
        Round(
            starts=1,
            solver=LbfgsConfig(max_steps=150, **_PATIENT),
            stages=(
                Stage(
                    LbfgsConfig(max_steps=15),
                    (("limit_weight", 1e3), ("ground_weight", 1e4), ("hinge_width", 1.0)),
                ),
                Stage(
                    LbfgsConfig(max_steps=20, **_PATIENT),
                    (("limit_weight", 1e4), ("ground_weight", 1e6), ("hinge_width", 0.1)),
                ),
            ),
        ),
    )
    scale: tuple[float, ...] = ()  # units of one segment's variables; () for the tuned ones

    def __post_init__(self) -> None:
        require_settings(self)
        require_size("num_pieces", self.num_pieces, 2)
        if not self.scale:
            object.__setattr__(self, "scale", (_OFFSET_SCALE,) * self.num_offsets + _CATCH_SCALE)

    @property
    def maps(self) -> ProportionalMinco:
        """The constant matrices from boundary states and offsets to one segment."""
        return proportional_minco(_ORDER, (1.0,) * self.num_pieces)

    @property
    def num_offsets(self) -> int:
        """The number of waypoint variables of a segment."""
        return 3 * (self.num_pieces - 1)

    def prepare(self, case: CatchCase) -> CatchContext:
        """Order the targets by their catches."""
        return order_targets(case)

    def guesses(self, context: CatchContext, num: int) -> Array:
        """Return minimum-jerk primitives between standstills below every ball, (1, n)."""
        require(num == 1, "starts", "1", num)
        case, dtype = context.case, context.times.dtype
        durations = jnp.maximum(jnp.diff(context.times, prepend=jnp.zeros((1,), dtype)), 0.05)
        ball = targets_at(context.targets, context.times)
        below = ball.pos - case.net.height * jnp.array([0.0, 0.0, 1.0], dtype)
        still = jnp.zeros((2, 3), dtype)
        begins = jnp.concatenate([case.head_state[None, 0], below[:-1]])

        def waypoints(begin: Array, end: Array, duration: Array) -> Array:
            first, last = (jnp.concatenate([pos[None], still]) for pos in (begin, end))
            primitive = minimum_jerk(first, last, duration)
            shares = jnp.asarray(np.arange(1, self.num_pieces) / self.num_pieces, dtype)
            return jax.vmap(lambda share: evaluate(primitive, share * duration))(shares)

        tails = jnp.zeros((durations.size, 4, 3), dtype).at[:, 0].set(below)
        rows = chain_rows(case.head_state, tails, durations / self.num_pieces)
        columns = jnp.concatenate([rows, jax.vmap(waypoints)(begins, below, durations)], axis=1)
        offsets = jnp.einsum(
            "oc,nci->noi",
            jnp.asarray(self.maps.offsets, dtype),
            columns,
            precision=jax.lax.Precision.HIGHEST,
        )
        natural = jnp.concatenate(
            [
                offsets.reshape(durations.size, -1),
                jnp.log(durations)[:, None],
                jnp.zeros((durations.size, 12), dtype),
            ],
            axis=1,
        )
        return (natural / jnp.asarray(self.scale, dtype)).reshape(1, -1)

    def catches(self, natural: Array, context: CatchContext) -> Catch:
        """Return the catches that the variables (N, 13) after the waypoint offsets describe."""
        case, net = context.case, context.case.net
        durations = jnp.exp(natural[:, 0])
        times = jnp.cumsum(jnp.where(context.active, durations, 0.0))
        ball = targets_at(context.targets, times)
        miss, acc = natural[:, 1:4], natural[:, 7:10]
        axis = body_z(acc, case.gravity)
        pos = ball.pos - net.height * axis + miss
        last = jnp.sum(context.active) - 1
        flying = jnp.arange(times.size) != last
        jerk = jnp.where(flying[:, None], natural[:, 10:13], 0.0)
        facing, moving = facing_cosine(axis, ball.vel)
        miss_squared = jnp.sum(miss**2, axis=1)
        missing = miss_squared > 0.0
        return Catch(
            times=times,
            durations=durations,
            tail_states=jnp.stack([pos, natural[:, 4:7], acc, jerk], axis=1),
            miss=jnp.where(missing, jnp.sqrt(jnp.where(missing, miss_squared, 1.0)), 0.0),
            angle_excess=jnp.where(moving, jnp.cos(net.max_angle) - facing, -1.0),
        )

    def _unpack(self, point: Array, context: CatchContext) -> tuple[Chain, Catch]:
        """Return segments and catches at a point."""
        scale = jnp.asarray(self.scale, point.dtype)
        natural = point.reshape(-1, scale.size) * scale
        catch = self.catches(natural[:, self.num_offsets :], context)
        piece_durations = catch.durations / self.num_pieces
        rows = chain_rows(context.case.head_state, catch.tail_states, piece_durations)
        offsets = natural[:, : self.num_offsets].reshape(natural.shape[0], -1, 3)
        return Chain(rows=rows, offsets=offsets, piece_durations=piece_durations), catch

    def _at_ends(self, chain: Chain, catch: Catch, context: CatchContext) -> Array:
        """Return the cost of energy, catches and time, ()."""
        at_catch = self.miss_weight * steep_hinge(catch.miss, context.case.net.radius)
        at_catch += self.angle_weight * steep_hinge(catch.angle_excess, self.hinge_width)
        energy = jax.vmap(lambda *segment: trajectory_energy(self.maps, *segment))(
            chain.rows, chain.offsets, chain.piece_durations
        )
        rest = jnp.sum(jnp.where(context.active, at_catch + energy, 0.0))
        return rest + self.time_weight * catch.times[-1]

    def _along(self) -> Along:
        """Return the penalties on limits along the trajectory."""
        return Along(
            maps=self.maps,
            nodes=self.nodes,
            excess=limits_excess,
            margins=(0.0,) * 4,
            hinge_width=self.hinge_width,
            hinge_weights=(self.limit_weight,) * 3 + (self.ground_weight,),
        )

    def objective(self, point: Array, context: CatchContext) -> Evaluation:
        """Return the paper's cost divided by 1000.

        The violation is zero, so that the solver returns its last iterate.
        """
        chain, catch = self._unpack(point, context)
        given = (context.case.gravity, context.case.limits)
        along, _ = integrate_along(self._along(), chain.columns, chain.piece_durations, given)
        penalty = jnp.sum(jnp.where(context.active, along, 0.0))
        cost = penalty + self._at_ends(chain, catch, context)
        return Evaluation(cost=cost / COST_UNIT, violation=jnp.zeros_like(cost))

    def rules_out(self, context: CatchContext) -> Array:
        """Return whether a target is never within reach."""
        return is_too_far(context)

    def decode(self, point: Array, context: CatchContext) -> CatchPlan:
        """Return the plan at a point; its violation is evaluated at the protocol's samples."""
        chain, catch = self._unpack(point, context)
        gravity, limits, net = context.case.gravity, context.case.limits, context.case.net
        motion = jax.vmap(lambda *segment: sample_motion(self.maps, self.nodes, *segment))(
            chain.columns, chain.piece_durations
        )
        along = jnp.stack(limits_excess(motion, (gravity, limits)))  # (4, N, K)
        least, most = limits.thrust_bounds
        half = 0.5 * (most - least)
        units = jnp.stack([limits.speed**2, limits.body_rate**2, half**2, limits.min_height])
        relative = jnp.max(along / units[:, None, None], axis=2)  # (4, N)
        relative = jnp.concatenate(
            [relative, (catch.miss / net.radius - 1.0)[None], catch.angle_excess[None]]
        )
        violation = jnp.max(jnp.where(context.active, relative, -1.0))
        return CatchPlan(
            trajectory=chain_trajectory(self.maps, chain, context.active),
            gravity=context.case.gravity,
            order=context.case.order,
            decided_times=context.times,
            times=catch.times,
            **pending(violation),
        )
