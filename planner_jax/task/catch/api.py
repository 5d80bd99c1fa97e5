"""The public functions `planner` and `judge` of the task `pj.catch`."""

import jax
import numpy as np
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.prediction import PathTable
from planner_jax.ball.target import BallPath, HarmonicPath, TargetPath
from planner_jax.core.decision import Decision
from planner_jax.core.planner import Planner
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.referee.catch import CatchVerdict, referee_catches
from planner_jax.task.arguments import judge_by
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.spec import DECISIONS, TASK, TRAINED
from planner_jax.task.decisions import find_decision

_HALF_STEP = 1e-4  # [s], half the interval of the central differences that estimate velocities


def planner(
    name: str = "exact",
    *,
    decide: str | Decision = "best",
    effort: str = "feasible",
    recovery: str | None = None,
    **options: object,
) -> Planner[CatchCase, CatchPlan]:
    """Make a planner of catches by its name, with a decision on the order and times of catches.

    * `exact`: recommended; its unknowns are such that every plan has each ball within the net.
    * `catch`: the planner of [Yu2023catch], which moves the net to the balls by penalties.
    * `mpp`: the baseline of [Yu2023catch]: sampled motion primitives without optimisation.

    Args:
        name: one of these names, or the name of a planner of another package.
        decide: how the order and first times of the catches are found. "best" plans the orders that
            are estimated to end first, and selects the plan with the earliest last catch. "greedy"
            always catches next the target that can be caught first. "given" uses order and times in
            the cases. "policy" and "policy:rush6" are trained networks, "policy:FILE" is a network
            of yours. An object is also accepted: `Best(finalists=3)` plans only three orders.
        recovery: trajectory after the last catch: "brake" ends at standstill wherever this costs
            least, "home" at the start position. None: no such trajectory.
        effort: "feasible" stops as soon as every limit holds; "good" and "best" lower the cost.
        **options: `attempts`, and fields of the problem's dataclass, such as `margin`.

    Returns:
        A planner for `pj.plan`. Its field `planner` is an `MppCatch`, or a `SearchPlanner` of a
        `CatchProblem` or `PaperCatch`. With a `recovery` this planner is the field `planner` of the
        result. Plans contain the decided order and times.

    Raises:
        ValueError: no planner or decision has the requested name, the planner does not support the
            effort, or a file cannot be read.
        TypeError: there is no field of the name of an option.
    """
    decision = find_decision(DECISIONS, decide, TRAINED)
    decided = DecidedPlanner(TASK.make_planner(name, options).with_effort(effort), decision)
    if recovery is None:
        return decided
    from planner_jax.recovery.with_recovery import add_recovery  # imported only if needed

    return add_recovery(decided, recovery)


def judge(cases: CatchCase, plans: CatchPlan, **settings: object) -> CatchVerdict:
    """Judge one plan, or a batch of plans, by physics that is independent of the planners.

    The referee computes positions of targets of the library's classes itself. For other classes it
    calls their method `at` in float64 and takes velocities by central differences over 2e-4 s.
    The verdict has the batch shape of the cases: `success`, reasons by `sentence(k)`, and measured
    quantities. The settings are keyword arguments of `referee_catches`. `TypeError` is raised for
    cases of other tasks, `ValueError` for different batch shapes or invalid settings.
    """
    if isinstance(cases, CatchCase):
        settings = {**target_setting(cases.targets), **settings}
    return judge_by(referee_catches, cases, plans, (CatchCase, CatchPlan), settings)


def target_setting(targets: TargetPath) -> dict[str, object]:
    """Return the setting by which the referee evaluates targets of a user's own class, or {}."""
    known = (BallPath, HarmonicPath, PathTable)  # classes of targets that the referee computes
    return {} if type(targets) in known else {"target_states": _states_by_class}


def _states_by_class(
    targets: TargetPath, order: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
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
