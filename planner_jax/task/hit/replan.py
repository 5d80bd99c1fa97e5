"""Re-planning of hits for a new estimate of the ball, while a plan is being flown.

The search starts at the previous plan's impact and the smoothest trajectory to it from the
quadrotor's state. A few iterations suffice. [Yu2023bat, Section VI-C] plans once, because "even
minor updates in the terminal state could lead to drastic deformations". In this planner the impact
is part of the search, and it changes as little as the estimate of the ball does.
"""

import dataclasses

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.ball.flight import BallState
from planner_jax.core.checks import require_kind
from planner_jax.core.paths import require_beginning
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.planning.replan import Replanning, check_elapsed, planned_state, resolve_arguments
from planner_jax.planning.replanner import TRIALS, Remaining
from planner_jax.robot.quadrotor import add_drag, net_thrust, tangent_basis
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.context import HitContext
from planner_jax.task.hit.default_planner import HitProblem
from planner_jax.task.hit.plan import HitPlan
from planner_jax.trajectory.polynomial import evaluate, total_duration

_SHORTEST = 0.01  # [s] least time to the impact in a starting point


def begin(
    cases: HitCase,
    previous: HitPlan,
    elapsed: ArrayLike,
    *,
    ball: BallState,
    drag: ArrayLike | None = None,
    head_state: ArrayLike | None = None,
) -> Replanning:
    """Return what remains of hits `elapsed` [s] after the start of their plans `previous`.

    `cases` are one hit or a batch of B hits as they were planned. `ball` is the new estimate of
    the ball's state, leaves (3,) or (B, 3), and `drag` [1/m] its drag coefficient, by default
    as in `cases`. `head_state` (..., 4, 3) has position, velocity, acceleration and jerk of the
    quadrotor, by default as planned, after the end of a plan as at its end.
    """
    elapsed = check_elapsed(cases, elapsed)
    own = planned_state(previous.trajectory, elapsed)
    news = resolve_arguments(elapsed, head_state=(head_state, own), drag=(drag, cases.drag))
    require_kind("ball", ball, BallState)
    require_beginning("ball", ball, cases.batch_shape, f"the batch shape {cases.batch_shape}")
    now = dataclasses.replace(cases, ball=ball, **news)
    return Replanning(case=now, previous=previous, elapsed=elapsed)


def start_from(problem: HitProblem, task: Replanning, context: HitContext) -> Array:  # noqa: ARG001
    """Return the decision variables (n,) of the previous plan's impact, on a smooth path."""
    stroke = task.previous.stroke
    path = task.previous.trajectory
    vel, acc, jerk = (evaluate(path, total_duration(path), order) for order in (1, 2, 3))
    pull = net_thrust(add_drag(task.case.limits.air, vel, acc), task.case.gravity)
    across = jnp.stack([jnp.sum(vel * each) for each in tangent_basis(stroke.normal)])
    times = jnp.stack([stroke.time - task.elapsed, stroke.flight_time])
    sizes = jnp.append(times, jnp.sqrt(jnp.sum(pull**2)))
    natural = jnp.concatenate([jnp.log(jnp.maximum(sizes, _SHORTEST)), across, jerk])
    return problem.join(jnp.zeros((1, problem.num_offsets // 3, 3), sizes.dtype), natural[None])


REMAINDER = Remaining(
    plan_type=HitPlan,
    begin=begin,
    start_from=start_from,
    attempts=(
        Attempt(starts=1, solver=LbfgsConfig(max_steps=2, memory=2, trial_steps=TRIALS)),
        Attempt(starts=1, solver=LbfgsConfig(max_steps=40, trial_steps=TRIALS)),
    ),
)
