"""Public functions of the task `pj.hit`, in which a quadrotor returns a ball with a racket."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
from jax.typing import DTypeLike

from planner_jax.core.choices import STARTS, require
from planner_jax.core.origin import to_world
from planner_jax.core.planner import Planner
from planner_jax.core.registry import suite_named
from planner_jax.referee.hit import HitVerdict, referee_hits
from planner_jax.robot.quadrotor_model import PAPER_HITTER, QuadrotorModel
from planner_jax.task.arguments import judge_by
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.plan import HitPlan
from planner_jax.task.hit.spec import REAL_SCENARIOS, START, TASK
from planner_jax.task.hit.suites import generate_serves, to_cases
from planner_jax.task.quadrotor import require_own_robot


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    start: Sequence[float] | str = START,
    delay: float = 0.0,
    limit_scale: float = 1.0,
    robot: QuadrotorModel = PAPER_HITTER,
    wind: Sequence[float] | None = None,
    starts: str = STARTS[0],
    dtype: DTypeLike = jnp.float32,
) -> HitCase:
    """Draw a batch of random cases: serves that a hovering quadrotor has to return.

    Args:
        num: number of cases, >= 1.
        suite: name of a family of random cases: "court" (default) has serves from the whole court,
            "S.1" to "S.6" have serves as in the real experiments of [Yu2023bat]. Suites of other
            packages are also accepted.
        seed: seed of the suite, >= 0. Case k of a suite and seed is always the same case.
        first: index k of the first case of the batch, >= 0.
        start: (3,) [m], hover position of the quadrotor; or "uniform": random in its half court.
        delay: [s], time for which the ball has flown when planning starts.
        limit_scale: factor on the limits of speed, acceleration and body rate.
        robot: quadrotor with a racket. Suites of other packages define their own robot.
        wind: (3,) [m/s], velocity of the air, for a robot with drag.
        starts: "hover" at `start`, or "random", moving near it; see `task.starts.with_states`.
        dtype: type of every floating leaf.

    Raises:
        ValueError: an argument is out of its range, or no suite has the requested name.
    """
    suite = suite_named(suite, "court")
    if suite not in TASK.suites:
        require_own_robot(robot, PAPER_HITTER, suite, wind)
        require(starts == STARTS[0], "starts", f"left out with suite {suite!r}", starts)
        return TASK.other_suite(suite)(num, seed, first)
    serves = generate_serves(num, seed, REAL_SCENARIOS.get(suite), first=first)
    return to_cases(
        serves,
        start=start,
        seed=seed,
        delay=delay,
        limit_scale=limit_scale,
        robot=robot,
        wind=wind,
        starts=starts,
        dtype=dtype,
    )


def planner(
    name: str = "exact", *, effort: str = "feasible", recovery: str | None = None, **options: object
) -> Planner[HitCase, HitPlan]:
    """Make a planner of hits by its name.

    * `exact`: recommended; every plan satisfies the equations of contact, impact and landing.
    * `bat`: the planner of [Yu2023bat], which optimises impact and trajectory together.
    * `bat-lite`: `bat` without its extra state before the impact, at which the swing starts.
    * `bat-fitted` and `bat-lite-fitted`: the same with 80 iterations, fitted to published rates.
    * `juggle`: the baseline of [Yu2023bat]: a motion primitive to a fixed impact, not optimised.

    Args:
        name: one of these names, or the name of a planner of another package.
        recovery: trajectory after the impact, which keeps all limits: "brake" ends at standstill
            wherever this costs least, "home" at the start position. None: no such trajectory.
        effort: "feasible" stops as soon as every limit holds; "good" and "best" lower the cost.
        **options: `attempts`, and fields of the problem's dataclass, such as `margin`.

    Returns:
        A planner for `pj.plan`: a `JuggleHit`, a `SearchPlanner` of a `HitProblem` or `BatHit`
        (the fitted planners), or a `LitePlanner` of a `BatHit`. With a `recovery` the result is a
        planner whose field `planner` holds this planner.

    Raises:
        ValueError: no planner has the requested name, or it does not support the effort.
        TypeError: there is no field of the name of an option.
        ModuleNotFoundError: the planner needs an optional dependency that is not installed.
    """
    own = TASK.make_planner(name, options).with_effort(effort)
    if recovery is None:
        return own
    from planner_jax.recovery.with_recovery import add_recovery  # imported only if needed

    return add_recovery(own, recovery)


def judge(cases: HitCase, plans: HitPlan, **settings: object) -> HitVerdict:
    """Judge one plan, or a batch of plans, by physics that is independent of the planners.

    Args:
        cases: one case, or a batch.
        plans: one plan for each case.
        **settings: settings of `referee_hits`, such as `drag_after_impact` of the returned ball.

    Returns:
        A verdict with the batch shape of the cases: whether each plan is a `success`, the reason
        as text by `sentence(k)`, and the measured quantities.

    Raises:
        TypeError: the cases or plans belong to another task.
        ValueError: cases and plans differ in batch shape, or a setting is out of its range.
    """
    verdict = judge_by(referee_hits, cases, plans, (HitCase, HitPlan), settings)
    point = to_world(verdict.landing_point, cases.origin)
    return dataclasses.replace(verdict, landing_point=point)
