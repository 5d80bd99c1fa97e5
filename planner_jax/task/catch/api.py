"""The functions `pj.catch.planner` and `pj.catch.judge`."""

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

_HALF_STEP = 1e-4  # [s], of central differences


def planner(
    name: str = "exact",
    *,
    decide: str | Decision = "best",
    effort: str = "feasible",
    recovery: str | None = None,
    **options: object,
) -> Planner[CatchCase, CatchPlan]:
    """Make the catch planner of a name, with a decision on the order and times of catches.

    * `exact`: recommended; every plan has the balls in the net.
    * `catch`: the planner of [Yu2023catch], which moves the net to the balls by penalties.
    * `mpp`: the baseline of [Yu2023catch], sampled motion primitives without optimisation.

    Args:
        name: one of these, or a planner of another package.
        decide: "best" plans the most promising orders and selects the earliest last catch.
            "greedy" catches next the target that it can reach first. "given" takes order and times
            from the cases. "policy" and "policy:rush6" are trained networks, "policy:FILE" is your
            own. Or a decision with settings, such as `Best(finalists=3)`.
        recovery: as in `pj.hit.planner`.
        effort: as in `pj.hit.planner`.
        **options: fields of the planner's dataclass, for example `rounds`.

    Returns:
        A planner for `pj.plan`, whose field `planner` is an `ExactCatch`, `PaperCatch` or
        `MppCatch`, or with a recovery a planner with such a field. Its plans contain the decided
        order and times.

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
    """Judge one plan, or a batch of plans, by physics independent of the planners.

    The referee computes positions of targets of the library's classes itself. For other classes it
    calls their method `at` in float64 and takes velocities by central differences over 2e-4 s.
    Arguments, result and errors are as in `pj.hit.judge`, with the settings of `referee_catches`.
    """
    known = (BallPath, HarmonicPath, PathTable)  # classes that the referee computes itself
    if isinstance(cases, CatchCase) and type(cases.targets) not in known:
        settings = {"target_states": _states_by_class, **settings}
    return judge_by(referee_catches, cases, plans, (CatchCase, CatchPlan), settings)


def _states_by_class(
    targets: TargetPath, order: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities (B, N, 3) of the targets `order` at `times`, both (B, N)."""
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
