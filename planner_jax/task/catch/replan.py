"""Re-planning: from the plan that is being flown, for what the targets are now thought to do.

Between two looks at a ball the estimate of its path moves by millimetres, and so does the best
plan. What is left of the previous plan is a start from which a few iterations suffice; planning
from scratch stays for the first look and for surprises.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.ball.target import TargetPath
from planner_jax.core.arithmetic import Numbers
from planner_jax.core.checks import require_path
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, Round
from planner_jax.planning.replan import Replanning, given_or_own, moment_of
from planner_jax.robot.quadrotor import body_z
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.context import CatchContext, targets_at
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.trajectory.polynomial import (
    PiecewisePolynomial,
    shift_basis,
    state_basis,
    states_at,
)
from planner_jax.trajectory.proportional_minco import boundary_rows

_ORDERS = 4  # position to jerk
_LATEST = 0.05  # [s], by how much a guessed catch may move for a target that moved
_SHORTEST = 0.01  # [s], least duration of a guessed segment
_CLOSING = 0.1  # [m/s], slower than this a target is not awaited at the net's plane
_BINOMIALS, _SHIFTS = shift_basis(2 * _ORDERS)
_TRIALS = (1.0, 0.2, 0.04)  # step lengths: the first direction, without curvature, is too long


@struct.dataclass
class ReplanContext:
    """What every evaluation needs: the catches, the plan so far, and where the search begins."""

    catch: CatchContext
    task: Replanning
    start: Array  # (n,), the previous plan for the new targets
    keep: Array  # () bool, too little time is left


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ReplanCatch(OptimisedPlanner):
    """Catches re-planned from the previous plan, as `pj.replan` asks for them.

    The search begins on what is left of the previous trajectory: its catches, at the times at
    which the targets are now expected to pass the net's plane there, and its way, read at the
    new waypoints. For a target as before and no time elapsed that is the previous plan to
    rounding. A target that has moved is met at another place in the net as far as the hoop
    reaches, and from there on by the smoothest change of the trajectory.

    With less than `shortest` left until the next catch nothing is planned: what is left of the
    previous plan comes back, cut into as many pieces, with its violation. The same holds after
    the last catch, when the plan is an empty one that stays where that catch was made.

    The first round makes one iteration, and the next re-plan goes on from there: the real-time
    iteration of Diehl et al. 2005. At most of the looks it leaves no limit broken.
    """

    case_type = Replanning
    plan_type = CatchPlan
    planner: ExactCatch = ExactCatch()
    rounds: tuple[Round, ...] = (
        Round(starts=1, solver=LbfgsConfig(max_steps=1, memory=1, trial_steps=_TRIALS)),
        Round(starts=1, solver=LbfgsConfig(max_steps=40, trial_steps=_TRIALS)),
        Round(starts=3, solver=LbfgsConfig(max_steps=80)),
    )
    shortest: float = 0.05  # [s], least time to the next catch that is planned anew

    @property
    def inner(self) -> ExactCatch:
        """The planner of the cases that are planned again."""
        return self.planner

    def begin(
        self,
        cases: CatchCase,
        previous: CatchPlan,
        elapsed: ArrayLike,
        *,
        targets: TargetPath,
        head_state: ArrayLike | None = None,
    ) -> Replanning:
        """Return the remainder of a case, or of a batch, some time into its plan.

        Caught targets are absent from it; the others keep their order. `pj.replan` describes
        cases, the previous plan, the elapsed time and the errors. The estimated `targets` have the
        shapes of the cases' and times that count from now. `head_state` is (4, 3) or (B, 4, 3), by
        default the plan's.
        """
        elapsed = moment_of(cases, elapsed)
        require_path("targets", targets, np.shape(cases.present), 3)
        own = states_at(previous.trajectory, elapsed)
        head_state = given_or_own("head_state", head_state, own, elapsed)
        since = elapsed[..., None]
        order, times = np.asarray(previous.order), np.asarray(previous.times)
        present, horizon = np.asarray(cases.present), np.asarray(cases.horizon)
        made = times <= since
        if times.shape[-1] == 1:  # nothing to reorder
            present = present & ~made
        elif made.any():
            gone = np.empty_like(made)
            np.put_along_axis(gone, order, made, axis=-1)
            present = present & ~gone
            first = np.argsort(made, axis=-1, kind="stable")
            order, times = (np.take_along_axis(x, first, axis=-1) for x in (order, times))
        left = dataclasses.replace(
            cases,
            targets=targets,
            present=present,
            horizon=horizon - since,
            order=order,
            times=np.maximum(times - since, _SHORTEST),
            head_state=head_state,
        )
        return Replanning(case=left, previous=previous, elapsed=elapsed)

    def prepare(self, task: Replanning) -> ReplanContext:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The targets in the order of catching, and the previous plan as a point."""
        context = self.planner.prepare(task.case)
        left = _segments(task)[1][0]
        return ReplanContext(
            catch=context,
            task=task,
            start=self._start(task, context),
            keep=(left < self.shortest) | ~context.active[0],
        )

    def _start(self, task: Replanning, context: CatchContext) -> Array:
        """What is left of the previous plan, for the new targets, as a point (n,)."""
        planner, net = self.planner, task.case.net
        trajectory = task.previous.trajectory
        segments, times = _segments(task)
        last = (segments + 1) * planner.num_pieces - 1
        coeffs, ends = trajectory.coeffs[last], trajectory.durations[last]
        tails = _states(coeffs, ends)
        # Where the targets pass the net's plane, to first order.
        axis = body_z(tails[:, 2], task.case.gravity)
        ball = targets_at(context.targets, times)
        above = jnp.sum((ball.pos - tails[:, 0]) * axis, axis=1) - net.height
        closing = jnp.sum((tails[:, 1] - ball.vel) * axis, axis=1)
        meeting = context.active & (closing > _CLOSING)
        later = jnp.where(meeting, above / jnp.where(meeting, closing, 1.0), 0.0)
        later = jnp.clip(later, -_LATEST, _LATEST)
        tails = _states(coeffs, ends + later)
        times = times + later
        begins = jnp.concatenate([jnp.zeros_like(times[:1]), times[:-1]])
        durations = jnp.maximum(times - begins, _SHORTEST)
        # The old way at the new waypoints, and from where the quadrotor would be on it.
        proportions = planner.maps.proportions
        shares = np.cumsum(proportions) / np.sum(proportions) - proportions / np.sum(proportions)
        knots = begins[:, None] + durations[:, None] * jnp.asarray(shares, times.dtype)
        way = _flown(trajectory, task.elapsed + knots.ravel())  # heads and waypoints
        way = way.reshape(*knots.shape, _ORDERS, 3)
        heads = jnp.concatenate([way[:1, 0], tails[:-1]])
        rows = jax.vmap(boundary_rows)(heads, tails, durations / planner.num_pieces)
        along = jnp.concatenate([rows, way[:, 1:, 0]], axis=1)
        matrix = jnp.asarray(planner.maps.offsets, times.dtype)
        offsets = jnp.sum(matrix[:, :, None] * along[:, None], axis=2)
        return planner.encode(context, durations, tails, offsets)

    def guesses(self, context: ReplanContext, num: int) -> Array:
        """The previous plan, and then those from scratch at its times, (num, n)."""
        first = context.start[None]
        if num == 1:
            return first
        return jnp.concatenate([first, self.planner.guesses(context.catch, num - 1)])

    def objective(self, point: Array, context: ReplanContext) -> Evaluation:
        """Of the planner; constant where the previous plan is kept."""
        return self.planner.objective(jnp.where(context.keep, context.start, point), context.catch)

    def decode(self, point: Array, context: ReplanContext) -> CatchPlan:
        """The plan at a point, or what is left of the previous one."""
        plan = self.planner.decode(point, context.catch)
        rest = lambda: _rest(context.task, context.catch)  # noqa: E731
        return jax.lax.cond(context.keep, rest, lambda: plan)


def _states(coeffs: Array, time: Numbers) -> Array:
    """States (K, 4, 3) on K pieces (K, D + 1, 3), each at its own time (K,) since it began."""
    factors, powers = state_basis(coeffs.shape[1])
    basis = time[:, None, None] ** jnp.asarray(powers, time.dtype)
    basis *= jnp.asarray(factors, time.dtype)
    return jnp.sum(basis[..., None] * coeffs[:, None], axis=2)


def _flown(trajectory: PiecewisePolynomial, times: Numbers) -> Array:
    """States (K, 4, 3) at times (K,) of a trajectory."""
    ends = jnp.cumsum(trajectory.durations)
    piece = jnp.sum(times[:, None] >= ends[:-1], axis=1)
    return _states(trajectory.coeffs[piece], times - (ends - trajectory.durations)[piece])


def _segments(task: Replanning) -> tuple[Array, Array]:
    """Which segment (N,) of the previous plan leads to each catch now, and when (N,) [s]."""
    times = task.previous.times
    made = jnp.sum(times <= task.elapsed)
    segments = jnp.minimum(made + np.arange(times.size), times.size - 1)
    return segments, times[segments] - task.elapsed


def _rest(task: Replanning, context: CatchContext) -> CatchPlan:
    """What is left of the previous plan, in as many pieces.

    What has been flown of a segment is cut off, and what is left of the piece that is being
    flown takes the place of those before it, in equal parts.
    """
    previous, num = task.previous, context.times.size
    segments, times = _segments(task)
    path = previous.trajectory
    size = path.coeffs.shape[1]
    ends = jnp.cumsum(path.durations)
    knots = jnp.concatenate([jnp.zeros_like(ends[:1]), ends]) - task.elapsed
    each = path.durations.size // num
    knots = knots[segments[:, None] * each + np.arange(each + 1)]  # (N, M + 1)
    coeffs = path.coeffs.reshape(num, each, size, 3)[segments]
    begin = jnp.maximum(knots[:, :1], 0.0)
    done = jnp.minimum(jnp.sum(begin >= knots[:, 1:], axis=1, keepdims=True), each - 1)
    until = jnp.take_along_axis(knots, done + 1, axis=1)
    place = np.arange(each + 1)
    share = (until - begin) / (done + 1)
    new = jnp.where(place <= done, begin + share * place, knots)
    source = jnp.maximum(place[:-1], done)
    local = new[:, :-1] - jnp.take_along_axis(knots, source, axis=1)
    moved = local[..., None, None] ** jnp.asarray(_SHIFTS, local.dtype)
    moved *= jnp.asarray(_BINOMIALS, local.dtype)
    coeffs = jnp.take_along_axis(coeffs, source[:, :, None, None], axis=1)
    coeffs = jnp.sum(moved[..., None] * coeffs[:, :, None], axis=3)
    still = (
        jnp.zeros_like(coeffs).at[:, :, 0].set(_states(path.coeffs[-1:], path.durations[-1:])[0, 0])
    )
    active = context.active[:, None]
    durations = jnp.where(active, jnp.diff(new, axis=1), 0.0)
    coeffs = jnp.where(active[..., None, None], coeffs, still)
    trajectory = PiecewisePolynomial(
        coeffs=coeffs.reshape(-1, size, 3), durations=durations.ravel()
    )
    return dataclasses.replace(
        previous,
        trajectory=trajectory,
        order=task.case.order,
        times=jnp.maximum(times, 0.0),
        iterations=jnp.zeros_like(previous.iterations),
    )
