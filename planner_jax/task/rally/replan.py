"""Re-planning of rallies: before a contact for a new estimate of the ball, and after a contact.

The search starts at the remainder of the previous plan. After a contact the second hit becomes the
first one, and a new last hit is guessed. So every plan looks K hits ahead.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.ball.flight import BallState
from planner_jax.core.arithmetic import Numbers, numpy_of, to_host
from planner_jax.core.checks import require_kind
from planner_jax.core.paths import require_beginning
from planner_jax.optimise.chain_remainder import evaluate_pieces, fit_offsets
from planner_jax.planning.replan import Replanning, check_elapsed, planned_state, resolve_arguments
from planner_jax.planning.replanner import Remaining
from planner_jax.robot.quadrotor import add_drag, net_thrust, tangent_basis
from planner_jax.task.rally.case import RallyCase
from planner_jax.task.rally.default_planner import RallyContext, RallyProblem
from planner_jax.task.rally.plan import RallyPlan

_SHORTEST = 0.01  # [s], least duration of a segment in the starting point
_MOST_SHARE = 0.98  # greatest distance of a place from its box's centre in a starting point
_NEW_APEX, _NEW_THRUST = 0.5, 1.1  # of a new last hit, as in the first row of the planner's guesses


def begin(
    cases: RallyCase,
    previous: RallyPlan,
    elapsed: ArrayLike,
    *,
    ball: BallState,
    drag: ArrayLike | None = None,
    restitution: ArrayLike | None = None,
    places: ArrayLike | None = None,
    place_range: ArrayLike | None = None,
    head_state: ArrayLike | None = None,
) -> Replanning:
    """Return what follows in rallies `elapsed` [s] after the start of their plans `previous`.

    `cases` are one case or a batch of B cases as they were planned. `ball` is the new estimate
    of the ball's state, leaves (3,) or (B, 3). `drag` [1/m] and `restitution` are by default as
    in `cases`. `places` and `place_range` (..., K, 3) [m] belong to the hits to plan; by
    default places of finished hits are left out, and the last one is repeated. `head_state`
    (..., 4, 3) is the quadrotor's state, by default as planned.

    A hit counts as done from its planned time on. The plan then continues with the next hits, and
    with as many new hits as are done. Then `ball` is the ball after the last contact.
    """
    elapsed = check_elapsed(cases, elapsed)
    require_kind("ball", ball, BallState)
    require_beginning("ball", ball, cases.batch_shape, f"the batch shape {cases.batch_shape}")
    index = count_done(previous, elapsed)[..., None] + np.arange(cases.places.shape[-2])
    index = index.clip(max=index.shape[-1] - 1)[..., None]

    def later(boxes: Array) -> Numbers:
        known = to_host(boxes)
        return numpy_of(known, index).take_along_axis(known, index, axis=-2)

    news = resolve_arguments(
        elapsed,
        drag=(drag, cases.drag),
        restitution=(restitution, cases.restitution),
        places=(places, later(cases.places)),
        place_range=(place_range, later(cases.place_range)),
        head_state=(head_state, planned_state(previous.trajectory, elapsed)),
    )
    start = 0.0 * cases.ball_time
    now = dataclasses.replace(cases, ball=ball, ball_time=start, **news)
    return Replanning(case=now, previous=previous, elapsed=elapsed)


def start_from(problem: RallyProblem, task: Replanning, context: RallyContext) -> Array:  # noqa: ARG001
    """Return the decision variables (n,) of the hits that follow, and of new last hits."""
    case, previous = task.case, task.previous
    path, strokes, size = previous.trajectory, previous.strokes, case.places.shape[0]
    index = count_done(previous, task.elapsed) + np.arange(size)
    is_new = (index >= size)[:, None]
    guessed = problem.guess_flights(case, case.places[0, 2], jnp.asarray(_NEW_APEX))
    guessed = guessed.astype(strokes.time.dtype)
    flights = jnp.concatenate([strokes.flight_time, guessed])
    flights_between = 1.0 if case.home is None else 2.0
    next_time = strokes.time[-1] + flights_between * strokes.flight_time[-1]
    times = jnp.append(strokes.time, next_time + jnp.cumsum(guessed) - guessed)
    flights, times = flights[index], times[index] - task.elapsed
    begins = jnp.concatenate([jnp.zeros_like(times[:1]), times[:-1]])
    durations = jnp.maximum(times - begins, _SHORTEST)

    index = jnp.minimum(index, size - 1)
    last = (index + 1) * problem.num_pieces - 1
    tails = evaluate_pieces(path.coeffs[last], path.durations[last])
    vel, acc, jerk = tails[:, 1], tails[:, 2], tails[:, 3]
    pull = net_thrust(add_drag(case.limits.air, vel, acc), case.gravity)
    thrust = jnp.sqrt(jnp.sum(pull**2, axis=1))
    across = jnp.stack(jax.vmap(tangent_basis)(strokes.normal[index]), axis=1)
    speeds = jnp.sum(vel[:, None] * across, axis=2)
    is_box = case.place_range > 0.0
    share = (previous.places[index] - case.places) / jnp.where(is_box, case.place_range, 1.0)
    share = jnp.clip(jnp.where(is_box, share, 0.0), -_MOST_SHARE, _MOST_SHARE)
    share = share / jnp.sqrt(1.0 - share**2)
    ends = jnp.concatenate([jnp.log(thrust)[:, None], speeds, jerk, share], axis=1)
    new = jnp.zeros_like(ends).at[:, 0].set(jnp.log(_NEW_THRUST * case.gravity))
    is_last = np.arange(size) == size - 1
    flights = jnp.where(is_last, jnp.log(flights), 0.0)
    natural = jnp.concatenate(
        [jnp.log(durations)[:, None], flights[:, None], jnp.where(is_new, new, ends)], axis=1
    )
    offsets = fit_offsets(problem, path, begins + task.elapsed, durations, tails)
    return problem.join(jnp.where(is_new[..., None], 0.0, offsets), natural)


def count_done(plan: RallyPlan, elapsed: Array | np.ndarray):
    """Return how many hits of a plan are done `elapsed` [s] after its start, () or (B,)."""
    return (to_host(plan.strokes.time) <= elapsed[..., None]).sum(axis=-1)


REMAINDER = Remaining(
    plan_type=RallyPlan, begin=begin, start_from=start_from, attempts=RallyProblem.attempts
)
