"""The baseline `catch`: the planner of [Yu2023catch], which penalises misses of the net."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.baselines.parts.minimum_jerk import minimum_jerk
from planner_jax.core.choices import require, require_size
from planner_jax.core.protocol import require_settings
from planner_jax.cost.along import Along, integrate_along
from planner_jax.optimise.planner import Problem, pending
from planner_jax.optimise.settings import Attempt, Evaluation, LbfgsConfig, Stage
from planner_jax.penalties.catches import length, net_angle_excess
from planner_jax.penalties.flight import (
    body_rate_excess,
    ground_excess,
    speed_excess,
    thrust_band_excess,
)
from planner_jax.penalties.hinges import smooth_hinge, steep_hinge, trapezoid
from planner_jax.robot.quadrotor import QuadrotorLimits, body_z
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.context import (
    CatchContext,
    is_too_far,
    order_targets,
    targets_at,
)
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.trajectory.minco import minco
from planner_jax.trajectory.polynomial import (
    Motion,
    PiecewisePolynomial,
    evaluate,
    sample_pieces,
    snap_energy,
)
from planner_jax.trajectory.proportional_minco import (
    Chain,
    ProportionalMinco,
    chain_rows,
    chain_trajectory,
    join_segments,
    proportional_minco,
    sample_motion,
    trajectory_energy,
)

_ORDER = 4  # derivative whose square is minimised: snap
# Units of the optimiser's variables, tuned for low costs: a waypoint's shift from the smoothest
# trajectory [m]; then log(duration) and position to jerk of a catch (SI units, x, y, z).
_OFFSET_SCALE = 0.05
_CATCH_SCALE = (0.035, *(0.06,) * 3, *(0.6,) * 3, *(1.2,) * 3, *(2.4,) * 3)
_SHARE_SCALE = 0.1  # unit of the logarithm of a piece's duration relative to the first piece
_PATIENT = {"memory": 16, "trial_steps": (1.0, 2.5, 0.3, 0.05), "tolerance": 1e-8, "patience": 10}
# The search for free durations, which lowers the cost slowly.
_LONG = LbfgsConfig(max_steps=400, **_PATIENT | {"tolerance": 1e-10, "patience": 60})
COST_UNIT = 1e3  # divisor of the cost, so that the Hessian has moderate entries


def limits_excess(motion: Motion, given: tuple[Array, QuadrotorLimits]) -> tuple[Array, ...]:
    """Return excesses over limits of speed, body rate, thrust, height [Yu2023catch, eqs 26-28].

    Each excess is a difference of squares in SI units; for the height it is a difference [m].
    Excesses are computed at samples of the motion. `given` is (gravity [m/s^2], robot's limits).
    """
    gravity, limits = given
    return (
        speed_excess(motion.vel, limits.speed, in_si=True),
        body_rate_excess(motion.acc, motion.jerk, gravity, limits.body_rate, in_si=True),
        thrust_band_excess(motion.acc, gravity, *limits.thrust_bounds),
        ground_excess(motion.height, limits.min_height),
    )


@struct.dataclass
class Catch:
    """Times and states of the catches of the N targets of one case, and misses of the net."""

    times: Array  # (N,) [s], when the balls are caught
    durations: Array  # (N,) [s], durations of the segments that end with a catch
    tail_states: Array  # (N, 4, 3), position to jerk of the quadrotor at the catches
    miss: Array  # (N,) [m], distance from the net's centre to the ball
    # (N,), cos(greatest permitted angle) - cos(angle between the net's axis and the reversed ball
    # velocity); <= 0 if the net faces the ball.
    angle_excess: Array


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class PaperCatch(Problem):
    """The problem of [Yu2023catch], in which catching times and states are optimised together.

    The cost (eqs 18-28) is a sum: the integral of |snap|^2; the weighted total time; smoothed
    penalties of speed, body rate, thrust and ground, integrated by the trapezoid rule; and
    penalties of the net's distance (eqs 22-24) and angle (eq. 25). The paper reports neither
    weights nor thresholds. They come from the authors' published C++ code. All polynomial pieces of
    a segment (the trajectory to one catch) have the same duration. With `free_pieces` their
    durations are variables, too (eq. 17), and a last search continues from the optimum for equal
    durations. Its cost is lower only where limits hold along the trajectory: otherwise the best
    waypoints lie on one polynomial, whatever the durations. The last catch has zero jerk.

    The variables are other coordinates of the paper's variables, so that the optima are the same:
    offsets of the waypoints from the smoothest trajectory, and for each catch the logarithm of the
    segment's duration, the net's position relative to the ball, and the quadrotor's velocity,
    acceleration and jerk. The jerk of the last catch is unused. Free durations add the logarithms
    of the later pieces' durations relative to the first piece.

    This planner ignores the additional limits of a case (`extras`); the referee checks them.
    """

    case_type = CatchCase
    # Penalty weights rise in stages: a search that starts with the final weights converges badly.
    attempts = (
        Attempt(
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
    num_pieces: int = 4  # number of polynomial pieces of one segment
    nodes: int = 16  # number of intervals per piece in which penalties are integrated
    time_weight: float = 1000.0  # weight of the time of the last catch
    limit_weight: float = 1e5
    ground_weight: float = 1e7
    miss_weight: float = 1e4
    angle_weight: float = 1e2
    hinge_width: float = 0.01  # width of the smoothed penalties of limits and of the net's angle
    free_pieces: bool = False  # whether the durations of a segment's pieces differ
    scale: tuple[float, ...] = ()  # units of one segment's variables; () selects tuned units

    def __post_init__(self) -> None:
        require_settings(self)
        require_size("num_pieces", self.num_pieces, 2)
        usual = (_OFFSET_SCALE,) * self.num_offsets + _CATCH_SCALE
        if not self.scale:
            free = (_SHARE_SCALE,) * (self.num_pieces - 1) if self.free_pieces else ()
            object.__setattr__(self, "scale", usual + free)
        if self.free_pieces:  # units of zero keep the durations equal
            equal = (("scale", usual + (0.0,) * (self.num_pieces - 1)),)
            (attempt,) = type(self).attempts
            stages = tuple(Stage(s.solver, s.settings + equal) for s in attempt.all_stages)
            object.__setattr__(
                self, "attempts", (dataclasses.replace(attempt, solver=_LONG, stages=stages),)
            )

    @property
    def maps(self) -> ProportionalMinco:
        """Constant matrices that map end states and waypoints to the trajectory to one catch."""
        return proportional_minco(_ORDER, (1.0,) * self.num_pieces)

    @property
    def num_offsets(self) -> int:
        """The number of waypoint variables of one segment, the trajectory to one catch."""
        return 3 * (self.num_pieces - 1)

    def prepare(self, case: CatchCase) -> CatchContext:
        """Sort the case's targets by the order in which they are caught."""
        return order_targets(case)

    def guesses(self, context: CatchContext, num: int) -> Array:
        """Return an initial guess (1, n): at each catch, standstill with the net at the target."""
        require(num == 1, "starts", "1", num)
        case, dtype = context.case, context.times.dtype
        durations = jnp.maximum(jnp.diff(context.times, prepend=jnp.zeros((1,), dtype)), 0.05)
        ball = targets_at(context.targets, context.times)
        below = ball.pos - case.net.height * jnp.array([[0.0, 0.0, 1.0]], dtype)
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
        scaled = natural / jnp.asarray(self.scale[: natural.shape[1]], dtype)[None]
        return jnp.pad(scaled, ((0, 0), (0, len(self.scale) - natural.shape[1]))).reshape(1, -1)

    def catches(self, natural: Array, context: CatchContext) -> Catch:
        """Return N catches from their unscaled variables `natural` (N, 13 or more).

        They are the logarithm of the segment's duration, the net's position relative to the ball,
        and velocity, acceleration and jerk of the quadrotor.
        """
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
        return Catch(
            times=times,
            durations=durations,
            tail_states=jnp.stack([pos, natural[:, 4:7], acc, jerk], axis=1),
            miss=length(miss),
            angle_excess=net_angle_excess(axis, ball.vel, net.max_angle),
        )

    def _natural(self, point: Array) -> Array:
        scale = jnp.asarray(self.scale, point.dtype)
        return point.reshape(-1, scale.size) * scale[None]

    def _unpack(self, point: Array, context: CatchContext) -> tuple[Chain, Catch]:
        natural = self._natural(point)
        catch = self.catches(natural[:, self.num_offsets :], context)
        piece_durations = catch.durations / self.num_pieces
        rows = chain_rows(context.case.head_state, catch.tail_states, piece_durations)
        offsets = natural[:, : self.num_offsets].reshape(natural.shape[0], -1, 3)
        return Chain(rows=rows, offsets=offsets, piece_durations=piece_durations), catch

    def _free_paths(
        self, point: Array, chain: Chain, catch: Catch, context: CatchContext
    ) -> PiecewisePolynomial:
        """Return the trajectories of N segments with free durations, on a leading axis."""
        logs = self._natural(point)[:, 1 - self.num_pieces :]
        shares = jax.nn.softmax(jnp.pad(logs, ((0, 0), (1, 0))), axis=1)
        heads = jnp.concatenate([context.case.head_state[None], catch.tail_states[:-1]])
        waypoints = jnp.matmul(
            jnp.asarray(self.maps.waypoints, point.dtype)[None],
            chain.columns,
            precision=jax.lax.Precision.HIGHEST,
        )
        durations = catch.durations[:, None] * shares
        return jax.vmap(minco)(heads, catch.tail_states, waypoints, durations)

    def _free_cost(
        self, path: PiecewisePolynomial, given: tuple[Array, QuadrotorLimits]
    ) -> tuple[Array, Array]:
        """Return the penalties along one segment, and its energy."""
        along = jnp.stack(limits_excess(sample_pieces(path, self.nodes), given))
        weights = jnp.array([self.limit_weight] * 3 + [self.ground_weight], along.dtype)
        hinges = jnp.sum(weights[:, None] * smooth_hinge(along, self.hinge_width), axis=0)
        by_piece = jax.vmap(trapezoid)(hinges.reshape(self.num_pieces, -1), path.durations)
        return jnp.sum(by_piece), snap_energy(path, _ORDER)

    def _at_ends(self, energy: Array, catch: Catch, context: CatchContext) -> Array:
        at_catch = self.miss_weight * steep_hinge(catch.miss, context.case.net.radius)
        at_catch += self.angle_weight * steep_hinge(catch.angle_excess, self.hinge_width)
        rest = jnp.sum(jnp.where(context.active, at_catch + energy, 0.0))
        return rest + self.time_weight * catch.times[-1]

    def _along(self) -> Along:
        return Along(
            maps=self.maps,
            nodes=self.nodes,
            excess=limits_excess,
            margins=(0.0,) * 4,
            hinge_width=self.hinge_width,
            hinge_weights=(self.limit_weight,) * 3 + (self.ground_weight,),
        )

    def objective(self, point: Array, context: CatchContext) -> Evaluation:
        """Return the sum of snap, time and penalties [Yu2023catch, eqs 18-28] over `COST_UNIT`.

        The reported violation is always zero, so that the solver does not prefer iterates that keep
        the limits, and returns its last iterate.
        """
        chain, catch = self._unpack(point, context)
        given = (context.case.gravity, context.case.limits)
        if self.free_pieces:
            paths = self._free_paths(point, chain, catch, context)
            along, energy = jax.vmap(lambda path: self._free_cost(path, given))(paths)
        else:
            along, _ = integrate_along(self._along(), chain.columns, chain.piece_durations, given)
            energy = jax.vmap(lambda *segment: trajectory_energy(self.maps, *segment))(
                chain.rows, chain.offsets, chain.piece_durations
            )
        penalty = jnp.sum(jnp.where(context.active, along, 0.0))
        cost = penalty + self._at_ends(energy, catch, context)
        return Evaluation(cost=cost / COST_UNIT, violation=jnp.zeros_like(cost))

    def rules_out(self, context: CatchContext) -> Array:
        """Return whether the quadrotor provably cannot catch some target at any time, () bool."""
        return is_too_far(context)

    def decode(self, point: Array, context: CatchContext) -> CatchPlan:
        """Return the plan of a vector of variables, with its violation at samples of each piece."""
        chain, catch = self._unpack(point, context)
        gravity, limits, net = context.case.gravity, context.case.limits, context.case.net
        if self.free_pieces:
            paths = self._free_paths(point, chain, catch, context)
            trajectory = join_segments(paths, chain, context.active)
            motion = jax.vmap(lambda path: sample_pieces(path, self.nodes))(paths)
        else:
            trajectory = chain_trajectory(self.maps, chain, context.active)
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
            trajectory=trajectory,
            gravity=context.case.gravity,
            order=context.case.order,
            decided_times=context.times,
            times=catch.times,
            **pending(violation),
        ).with_heading(context.case)
