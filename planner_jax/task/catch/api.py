"""The functions `pj.catch.planner` and `judge`; `case` and `draw` are in modules of their own."""

import jax
import numpy as np
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.prediction import PathTable
from planner_jax.ball.target import BallPath, HarmonicPath, TargetPath
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Decision
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.referee.catch import CatchVerdict, referee_catches
from planner_jax.task.arguments import find_decision, judge_by
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.spec import DECISIONS, TASK, TRAINED

_HALF_STEP = 1e-4  # [s], of the central difference


def planner(
    name: str = "exact",
    *,
    decide: str | Decision = "best",
    effort: str = "feasible",
    recovery: str | None = None,
    **options: object,
) -> Planner[CatchCase, CatchPlan]:
    """Return the catch planner of a name, behind a decision about order and times.

    * `exact`: the ball is in the net by construction; the one to use.
    * `catch`: the published planner of [Yu2023catch], which meets the ball by penalties.
    * `mpp`: the motion primitives that [Yu2023catch] compares with; nothing is optimised.

    Args:
        name: one of these, or one that another package offers.
        decide: "best" plans the most promising of all orders and keeps the earliest last catch,
            "greedy" catches next what it can reach first, "given" takes order and times of the
            cases, "policy" asks a network that was trained by reinforcement; "policy:rush6"
            asks one that was trained on that suite alone, and "policy:FILE" one of your own; or
            a decision with settings, such as `Best(finalists=3)`.
        recovery: as of `pj.hit.planner`.
        effort: as of `pj.hit.planner`. Of 1,000 `throws` it is above that of a very long search by
            38, 0.06 and 0.00 % (median), 76, 1.5 and 0.00 % (90 % quantile); of two balls,
            `parabola2`, by 95, 11 and 0.00 %, and 182, 17 and 0.02 %.
        **options: fields of that planner's dataclass, for example `rounds`.

    Returns:
        A planner for `pj.plan`; its `planner` is an `ExactCatch`, `PaperCatch` or `MppCatch`, or
        with a recovery a planner that has such a one. The plans hold the order and the times that
        were decided.

    Raises:
        ValueError: there is no planner or decision of that name, the planner has no such effort,
            or a file cannot be read.
        TypeError: the planner has no such field.
    """
    decision = find_decision(DECISIONS, decide, TRAINED)
    own = TASK.make_planner(name, options).with_effort(effort)
    decided = DecidedPlanner(own, decision)
    if recovery is None:
        return decided
    from planner_jax.recovery.with_recovery import add_recovery  # few catches need it

    return add_recovery(decided, recovery)


def judge(cases: CatchCase, plans: CatchPlan, **settings: object) -> CatchVerdict:
    """Judge one plan, or a batch, by the physics alone.

    The referee computes the positions of targets of the library's classes itself. It calls the
    method `at` of a target of any other class, in float64; the target's velocity is the central
    difference over 2e-4 s.
    Arguments, result and errors are those of `pj.hit.judge`; `referee_catches` has the settings.
    """
    known = (BallPath, HarmonicPath, PathTable)  # classes that the referee follows by itself
    if isinstance(cases, CatchCase) and type(cases.targets) not in known:
        settings = {"target_states": _states_by_class, **settings}
    return judge_by(referee_catches, cases, plans, (CatchCase, CatchPlan), settings)


def _states_by_class(
    targets: TargetPath, order: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities (B, N, 3) of the targets `order` at `times`, both (B, N).

    The velocity of the class itself is not used, because the planner has used it.
    """
    lanes = np.arange(len(order))[:, None]
    with jax.enable_x64(True):
        ordered = jax.tree.map(lambda leaf: _double(leaf)[lanes, order], targets)
        before, at, after = (
            np.asarray(_positions(ordered, times + step)) for step in (-_HALF_STEP, 0.0, _HALF_STEP)
        )
    return at, (after - before) / (2.0 * _HALF_STEP)


def _double(leaf: Array | np.ndarray) -> np.ndarray:
    leaf = np.asarray(leaf)
    return leaf.astype(np.float64) if leaf.dtype.kind == "f" else leaf


@jax.jit
def _positions(targets: TargetPath, times: Array) -> Array:
    def position(target: TargetPath, time: Array) -> Array:
        state = target.at(time)
        return state.pos if isinstance(state, BallState) else state

    return jax.vmap(jax.vmap(position))(targets, times)
