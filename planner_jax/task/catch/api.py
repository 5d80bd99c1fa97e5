"""The words of the task: `pj.catch.planner` and `judge`; `case` and `draw` stand beside."""

import jax
import numpy as np
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.prediction import PathTable
from planner_jax.ball.target import BallPath, HarmonicPath, TargetPath
from planner_jax.core.choices import with_effort
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
    ending: str | None = None,
    **options: object,
) -> Planner[CatchCase, CatchPlan]:
    """The catch planner of a name, behind a decision about order and times.

    * `exact`: the ball is in the net by construction; the one to use.
    * `catch`: the published planner of paper 000, which meets the ball by penalties.
    * `mpp`: the motion primitives that paper 000 compares with; nothing is optimised.

    Args:
        name: one of these, or one that another package offers.
        decide: "best" plans the most promising of all orders and keeps the earliest last catch,
            "greedy" catches next what it can reach first, "given" takes order and times of the
            cases, "policy" asks a network that was trained by reinforcement; "policy:rush6"
            asks one that was trained on that suite alone, and "policy:FILE" one of your own; or
            a decision with settings, such as `Best(finalists=3)`.
        ending: what is flown behind the last contact, within all limits: "brake" to rest where that
            is cheapest, "home" for the way back to where the case begins; by default the plan ends
            at the contact.
        effort: "feasible" is done with a case as soon as every limit holds; "good" and "best"
            search on for less cost. Of 1,000 `throws` it is above that of a very long search by
            38, 0.06 and 0.00 % (median), 76, 1.5 and 0.00 % (90 % quantile); of two balls,
            `parabola2`, by 95, 11 and 0.00 %, and 182, 17 and 0.02 %.
        **options: fields of that planner's dataclass, for example `rounds`.

    Returns:
        A planner for `pj.plan`; its `planner` is an `ExactCatch`, `PaperCatch` or `MppCatch`, or
        with an ending a planner that has such a one. The plans hold the order and the times that
        were decided.

    Raises:
        ValueError: there is no planner or decision of that name, the planner has no such effort,
            or a file cannot be read.
        TypeError: the planner has no such field.
    """
    decision = find_decision(DECISIONS, decide, TRAINED)
    own = with_effort(TASK.make_planner(name, options), effort)
    decided = DecidedPlanner(own, decision)
    if ending is None:
        return decided
    from planner_jax.recovery.with_recovery import add_recovery  # few catches need it

    return add_recovery(decided, ending)


def judge(cases: CatchCase, plans: CatchPlan, **settings: object) -> CatchVerdict:
    """What the referee says of one plan or of a batch: the physics alone decides.

    Targets of the library's classes are followed by the referee itself. Those of a class of one's
    own are where its `at` says in float64; their velocity is the central difference over 2e-4 s.

    Args:
        cases: one case, or a batch.
        plans: of them.
        **settings: such as `tolerance` and `net_test`; see `referee_catches`.

    Returns:
        A verdict with the batch shape of the cases: `success`, `sentence(k)`, and what was
        measured.

    Raises:
        TypeError: the cases or plans are not catches.
        ValueError: shapes that do not fit, or a setting out of its range.
    """
    if isinstance(cases, CatchCase) and _is_own(cases.targets):
        settings = {"target_states": _states_by_class, **settings}
    return judge_by(referee_catches, cases, plans, (CatchCase, CatchPlan), settings)


def _is_own(targets: object) -> bool:
    """Return whether targets are paths of a class that the referee does not follow by itself."""
    return isinstance(targets, TargetPath) and type(targets) not in (
        BallPath,
        HarmonicPath,
        PathTable,
    )


def _states_by_class(
    targets: TargetPath, order: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities (B, N, 3) of the targets `order` at `times`, both (B, N).

    A velocity that the class itself may give is not asked for: it is what the planner has used.

    Args:
        targets: leaves (B, N, ...).
        order: places of the targets.
        times: [s].
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
