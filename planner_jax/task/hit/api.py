"""The functions `pj.hit.draw`, `pj.hit.planner` and `pj.hit.judge`."""

from collections.abc import Sequence

import jax.numpy as jnp
from jax.typing import DTypeLike

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
    dtype: DTypeLike = jnp.float32,
) -> HitCase:
    """Draw serves as a batch of cases.

    Args:
        num: number of cases, >= 1.
        suite: "court" (default), a real scenario of [Yu2023bat], "S.1" to "S.6", or a suite of
            another package.
        seed: seed of the suite, >= 0. Case k of a suite and seed is always the same case.
        first: index of the first case, >= 0.
        start: (3,) [m], hover position of the quadrotor; or "uniform" over the half court.
        delay: [s], flight of the ball before planning starts.
        limit_scale: factor on the limits of speed, acceleration and body rate.
        robot: quadrotor with a racket; suites of other packages have their own.
        dtype: type of every floating leaf.

    Raises:
        ValueError: an argument is out of its range, or there is no such suite.
    """
    suite = suite_named(suite, "court")
    if suite not in TASK.suites:
        require_own_robot(robot, PAPER_HITTER, suite)
        return TASK.other_suite(suite)(num, seed, first)
    serves = generate_serves(num, seed, REAL_SCENARIOS.get(suite), first=first)
    return to_cases(
        serves,
        start=start,
        seed=seed,
        delay=delay,
        limit_scale=limit_scale,
        robot=robot,
        dtype=dtype,
    )


def planner(
    name: str = "exact", *, effort: str = "feasible", recovery: str | None = None, **options: object
) -> Planner[HitCase, HitPlan]:
    """Make the hit planner of a name.

    * `exact`: recommended; every plan satisfies the equations of contact, impact and landing.
    * `bat`: the planner of [Yu2023bat], which optimises impact and trajectory together.
    * `bat-lite`: `bat` without the transition point before the impact.
    * `juggle`: the baseline of [Yu2023bat], a primitive to a fixed stroke without optimisation.

    Args:
        name: one of these, or a planner of another package.
        recovery: trajectory after the last contact, within all limits: "brake" to the cheapest
            standstill, "home" back to the start. By default the plan ends at the contact.
        effort: "feasible" stops as soon as every limit holds. "good" and "best" continue to lower
            the cost.
        **options: fields of the planner's dataclass, for example `rounds`.

    Returns:
        `ExactHit`, `BatHit` (`bat` and `bat-lite`) or `JuggleHit`, for `pj.plan`. With a recovery
        it is the field `planner` of the planner that is returned.

    Raises:
        ValueError: there is no planner of that name, or it has no such effort.
        TypeError: the planner has no such field.
        ModuleNotFoundError: the planner needs an extra that is not installed.
    """
    own = TASK.make_planner(name, options).with_effort(effort)
    if recovery is None:
        return own
    from planner_jax.recovery.with_recovery import add_recovery  # few hits need it

    return add_recovery(own, recovery)


def judge(cases: HitCase, plans: HitPlan, **settings: object) -> HitVerdict:
    """Judge one plan, or a batch of plans, by physics independent of the planners.

    Args:
        cases: one case, or a batch.
        plans: one plan for each case.
        **settings: settings of `referee_hits`, such as `drag_after_impact` and `tolerance`.

    Returns:
        A verdict with the batch shape of the cases: `success`, `sentence(k)`, and measured
        quantities.

    Raises:
        TypeError: the cases or plans are of another task.
        ValueError: cases and plans differ in batch shape, or a setting is out of its range.
    """
    return judge_by(referee_hits, cases, plans, (HitCase, HitPlan), settings)
