"""The functions `pj.hit.draw`, `planner` and `judge`; `case` is in a module of its own."""

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
    """Draw serves as a batch of cases; see `generate_serves` and `to_cases`.

    Args:
        num: number of cases, >= 1.
        suite: "court", the default, or one of the six real scenarios of [Yu2023bat], "S.1" to
            "S.6", or a suite that another package offers.
        seed: >= 0. Case k of a suite and seed is always the same case.
        first: index of the first case, >= 0.
        start: (3,) [m], hover position of the quadrotor; or "uniform" over the half court.
        delay: [s] from the serve to the moment at which planning starts.
        limit_scale: factor on the speed, acceleration and body-rate limits; not on the stroke's.
        robot: with a racket; suites of other packages have their own.
        dtype: of every floating leaf.

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
    """Return the hit planner of a name, with some of its fields set.

    * `exact`: contact, impact and landing hold by construction; the one to use.
    * `bat`: the published planner of [Yu2023bat], impact and trajectory optimised together.
    * `bat-lite`: `bat` without the transition point before the impact.
    * `juggle`: a primitive to a stroke that is fixed beforehand; nothing is optimised.

    Args:
        name: one of these, or one that another package offers.
        recovery: the motion behind the last contact, within all limits: "brake" to rest where it
            is cheapest, "home" for the way back to where the case begins; by default the plan ends
            at the contact.
        effort: "feasible" is done with a case as soon as every limit holds; "good" and "best"
            search on for less cost. Of 1,000 hits of `court` it is above that of a very long
            search by 469, 0.00 and 0.00 % (median), 2,467, 0.05 and 0.00 % (90 % quantile), in
            0.05, 3.6 and 21 s on two CPU cores that had other work.
        **options: fields of that planner's dataclass, for example `rounds`.

    Returns:
        `ExactHit`, `BatHit` (`bat` and `bat-lite`) or `JuggleHit`, for `pj.plan`; with a recovery a
        planner whose `planner` is one of these.

    Raises:
        ValueError: there is no planner of that name, or it has no such effort.
        TypeError: the planner has no such field.
        ModuleNotFoundError: the planner needs an extra that is not installed.
    """
    made = TASK.make_planner(name, options).with_effort(effort)
    if recovery is None:
        return made
    from planner_jax.recovery.with_recovery import add_recovery  # few hits need it

    return add_recovery(made, recovery)


def judge(cases: HitCase, plans: HitPlan, **settings: object) -> HitVerdict:
    """Judge one plan, or a batch of plans, by the physics alone.

    Args:
        cases: one case, or a batch.
        plans: of the cases.
        **settings: such as `drag_after_impact` and `tolerance`; see `referee_hits`.

    Returns:
        A verdict with the batch shape of the cases: `success`, `sentence(k)`, and what was
        measured.

    Raises:
        TypeError: the cases or plans are of another task.
        ValueError: shapes that do not fit, or a setting out of its range.
    """
    return judge_by(referee_hits, cases, plans, (HitCase, HitPlan), settings)
