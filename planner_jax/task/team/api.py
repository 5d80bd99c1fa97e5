"""The public functions `planner` and `judge` of the task `pj.team`."""

from planner_jax.core.decision import Decision
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.recovery.with_recovery import add_recovery
from planner_jax.referee.catch import referee_catches
from planner_jax.referee.team import TeamVerdict, referee_teams
from planner_jax.task.arguments import judge_by, require_settings
from planner_jax.task.catch.api import target_setting
from planner_jax.task.catch.spec import DECISIONS, TRAINED
from planner_jax.task.decisions import find_decision
from planner_jax.task.team.case import TeamCase
from planner_jax.task.team.default_planner import ExactTeam
from planner_jax.task.team.plan import TeamPlan
from planner_jax.task.team.spec import TASK


def planner(
    name: str = "exact",
    *,
    decide: str | Decision = "best",
    turns: int = 3,
    **options: object,
) -> ExactTeam:
    """Make a planner of teams: several robots that catch targets and keep their distance.

    Args:
        name: `exact`, the planner of one robot's catches.
        decide: how one robot's order of catches is found, as for `pj.catch.planner`. A joint search
            always decides which robot catches which targets.
        turns: how often each robot plans, with the other robots' plans as moving keep-outs.
        **options: fields of the dataclass of `CatchProblem`.

    Returns:
        An `ExactTeam` for `pj.plan`; its field `planner` plans one robot's catches and recovery.
    """
    decision = find_decision(DECISIONS, decide, TRAINED)
    catcher = DecidedPlanner(TASK.make_planner(name, options), decision)
    return ExactTeam(add_recovery(catcher, "brake"), turns=turns)


def judge(cases: TeamCase, plans: TeamPlan, **settings: object) -> TeamVerdict:
    """Judge one plan of a team, or a batch of plans, by physics independent of the planners.

    The catches of each robot are judged as by `pj.catch.judge`, whose settings and errors this
    function has. No target may be caught twice, and every pair of robots must keep its distance.
    """
    require_settings(referee_catches, settings)
    if isinstance(cases, TeamCase):
        settings = {**target_setting(cases.shared.targets), **settings}
    return judge_by(referee_teams, cases, plans, (TeamCase, TeamPlan), settings)
