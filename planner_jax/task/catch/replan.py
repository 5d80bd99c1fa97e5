"""Re-planning of catches for new estimates of the targets, while a plan is being flown.

Between two observations the estimated path of a ball moves by millimetres, and so does the best
plan. A few iterations from the remainder of the previous plan suffice. The first observation, and
large changes, still need planning from scratch.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.ball.target import TargetPath
from planner_jax.core.arithmetic import numpy_of, to_host
from planner_jax.core.paths import require_path
from planner_jax.optimise.chain_remainder import evaluate_pieces, fit_offsets
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.planning.replan import Replanning, check_elapsed, planned_state, resolve_argument
from planner_jax.planning.replanner import TRIALS, Remaining
from planner_jax.robot.quadrotor import add_drag, body_z
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.context import CatchContext, targets_at
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.trajectory import polynomial

_LATEST = 0.05  # [s], greatest shift of a catch's time in the starting point
_SHORTEST = 0.01  # [s], least duration of a segment in the starting point
_CLOSING = 0.1  # [m/s], least speed towards the net's plane at which a catch's time is shifted
_BINOMIALS, _SHIFTS = polynomial.shift_basis(8)


def begin(
    cases: CatchCase,
    previous: CatchPlan,
    elapsed: ArrayLike,
    *,
    targets: TargetPath,
    head_state: ArrayLike | None = None,
) -> Replanning:
    """Return the catches that remain `elapsed` [s] after the start of their plans `previous`.

    `cases` are one case or a batch of B cases as they were planned, `elapsed` () or (B,) is
    >= 0. Caught targets become absent; the remaining targets keep their order. `targets` are
    the targets' paths as estimated at the present, which is time 0 of these paths. `head_state`
    (..., 4, 3) has position, velocity, acceleration and jerk of the quadrotor, by default as
    planned, after the end of a plan as at its end.
    """
    elapsed = check_elapsed(cases, elapsed)
    require_path("targets", targets, np.shape(cases.present), 3)
    own = planned_state(previous.trajectory, elapsed)
    head_state = resolve_argument("head_state", head_state, own, elapsed)
    since = elapsed[..., None]
    order, times = to_host(previous.order), to_host(previous.times)
    present, horizon = to_host(cases.present), to_host(cases.horizon)
    is_past = times <= since
    xp = numpy_of(order, is_past)  # jax.numpy if plans or times are traced
    if times.shape[-1] == 1:  # a single target needs no new order
        present = present & ~is_past
    elif xp is jnp or is_past.any():
        caught = xp.take_along_axis(is_past, xp.argsort(order, axis=-1), axis=-1)
        present = present & ~caught
        next_first = xp.argsort(is_past, axis=-1, stable=True)
        order, times = (xp.take_along_axis(x, next_first, axis=-1) for x in (order, times))
    left = dataclasses.replace(
        cases,
        targets=targets,
        present=present,
        horizon=horizon - since,
        order=order,
        times=numpy_of(is_past).maximum(times - since, _SHORTEST),
        head_state=head_state,
    )
    return Replanning(case=left, previous=previous, elapsed=elapsed)


def start_from(problem: CatchProblem, task: Replanning, context: CatchContext) -> Array:
    """Return the decision variables (n,) of the previous plan, fitted to the new targets.

    The start is the remainder of the previous trajectory, sampled at the new waypoints. Its catches
    are moved to the times at which the targets are expected to pass the net's plane. For unchanged
    targets and no elapsed time it is the previous plan up to rounding. A target that has moved is
    caught at another point of the net. If it would miss the net, the trajectory is changed as
    smoothly as possible to reach it.
    """
    net = task.case.net
    trajectory = task.previous.trajectory
    segments, times = _segments(task)
    last = (segments + 1) * problem.num_pieces - 1
    coeffs, ends = trajectory.coeffs[last], trajectory.durations[last]
    tails = evaluate_pieces(coeffs, ends)
    load = add_drag(task.case.limits.air, tails[:, 1], tails[:, 2])
    axis = body_z(load, task.case.gravity)
    ball = targets_at(context.targets, times)
    above = jnp.sum((ball.pos - tails[:, 0]) * axis, axis=1) - net.height
    closing = jnp.sum((tails[:, 1] - ball.vel) * axis, axis=1)
    meeting = context.active & (closing > _CLOSING)
    later = jnp.where(meeting, above / jnp.where(meeting, closing, 1.0), 0.0)
    later = jnp.clip(later, -_LATEST, _LATEST)
    tails = evaluate_pieces(coeffs, ends + later)
    times = times + later
    begins = jnp.concatenate([jnp.zeros_like(times[:1]), times[:-1]])
    durations = jnp.maximum(times - begins, _SHORTEST)
    begins = begins + task.elapsed
    offsets = fit_offsets(problem, trajectory, begins, durations, tails)
    return problem.encode(context, durations, tails, offsets)


def time_left(task: Replanning, context: CatchContext) -> Array:
    """Return the time () [s] until the next catch; no time after the last catch."""
    return jnp.where(context.active[0], _segments(task)[1][0], -jnp.inf)


def _segments(task: Replanning) -> tuple[Array, Array]:
    times = task.previous.times
    segments = jnp.minimum(jnp.sum(times <= task.elapsed) + np.arange(times.size), times.size - 1)
    return segments, times[segments] - task.elapsed


def keep(task: Replanning, context: CatchContext) -> CatchPlan:
    """Return the remainder of the previous plan, in the same number of polynomial pieces."""
    previous, num = task.previous, context.times.size
    segments, times = _segments(task)
    path = previous.trajectory
    size = path.coeffs.shape[1]
    ends = jnp.cumsum(path.durations)
    knots = jnp.concatenate([jnp.zeros_like(ends[:1]), ends]) - task.elapsed
    each = path.durations.size // num
    knots = knots[segments[:, None] * each + np.arange(each + 1)[None]]  # (N, M + 1)
    coeffs = path.coeffs.reshape(num, each, size, 3)[segments]
    begin = jnp.maximum(knots[:, :1], 0.0)
    done = jnp.minimum(jnp.sum(begin >= knots[:, 1:], axis=1, keepdims=True), each - 1)
    until = jnp.take_along_axis(knots, done + 1, axis=1)
    index = np.arange(each + 1)[None]
    part = (until - begin) / (done + 1).astype(begin.dtype)
    new = jnp.where(index <= done, begin + part * jnp.asarray(index, part.dtype), knots)
    source = jnp.maximum(index[:, :-1], done)
    local = new[:, :-1] - jnp.take_along_axis(knots, source, axis=1)
    shift = local[..., None, None] ** jnp.asarray(_SHIFTS, local.dtype)[None, None]
    shift *= jnp.asarray(_BINOMIALS, local.dtype)[None, None]
    coeffs = jnp.take_along_axis(coeffs, source[:, :, None, None], axis=1)
    coeffs = jnp.sum(shift[..., None] * coeffs[:, :, None], axis=3)
    last = evaluate_pieces(path.coeffs[-1:], path.durations[-1:])[0, 0]
    still = jnp.zeros_like(coeffs).at[:, :, 0].set(last)
    active = context.active[:, None]
    durations = jnp.where(active, jnp.diff(new, axis=1), 0.0)
    coeffs = jnp.where(active[..., None, None], coeffs, still)
    trajectory = polynomial.PiecewisePolynomial(
        coeffs=coeffs.reshape(-1, size, 3), durations=durations.ravel()
    )
    return dataclasses.replace(
        previous,
        trajectory=trajectory,
        order=task.case.order,
        times=jnp.maximum(times, 0.0),
        iterations=jnp.zeros_like(previous.iterations),
    ).with_heading(task.case)


# The first attempt makes one iteration, and the next re-plan continues from its result: the
# real-time iteration of [Diehl2005]. One iteration usually suffices to keep all limits. After the
# last catch the remainder is empty, and stays at the position of that catch.
REMAINDER = Remaining(
    plan_type=CatchPlan,
    begin=begin,
    start_from=start_from,
    attempts=(
        Attempt(starts=1, solver=LbfgsConfig(max_steps=1, memory=1, trial_steps=TRIALS)),
        Attempt(starts=1, solver=LbfgsConfig(max_steps=40, trial_steps=TRIALS)),
        Attempt(starts=3, solver=LbfgsConfig(max_steps=80)),
    ),
    shortest=0.05,
    time_left=time_left,
    keep=keep,
)
