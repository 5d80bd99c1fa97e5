"""Batched, differentiable planning for robots that meet flying objects.

The public names, in the order of the data flow:

* where the ball goes: `BallState`, `fly`, `predict_path`, `target_at`, `BallPath`, `HarmonicPath`
* what to hit: `HitScenario`, `hit_scenario`, `generate_serves`, `read_serves`, `to_scenarios`
* what to catch: `CatchScenario`, `catch_scenario`, `make_suite`
* when and in what order to catch: `plan_catches`, `closest_approach`
* the planners: `planner` and `catch_planner` (by name), `ExactHit`, `ExactCatch`, and `plan`, one
  call for one case or many, on all devices; `plan_across_processes`, `keep_compiled_programs`
* plans again while a ball flies: `ReplanCatch`, `replanned`
* gradients through an optimum: `optimal_plan`
* the judges: `referee_hits`, `referee_catches`
* reading a plan: `PiecewisePolynomial`, `evaluate`, `Status`

They are imported on first use, so that `import planner_jax` itself is quick.
"""

import pkgutil

_PUBLIC = {
    "BallState": "planner_jax.ball.flight",
    "fly": "planner_jax.ball.flight",
    "predict_path": "planner_jax.ball.prediction",
    "target_at": "planner_jax.ball.prediction",
    "BallPath": "planner_jax.ball.target",
    "HarmonicPath": "planner_jax.ball.target",
    "HitScenario": "planner_jax.task.hit.scenario",
    "hit_scenario": "planner_jax.task.hit.scenario",
    "generate_serves": "planner_jax.task.hit.serves",
    "read_serves": "planner_jax.task.hit.serves",
    "to_scenarios": "planner_jax.task.hit.serves",
    "CatchScenario": "planner_jax.task.catch.scenario",
    "catch_scenario": "planner_jax.task.catch.scenario",
    "make_suite": "planner_jax.task.catch.suites",
    "plan_catches": "planner_jax.task.catch.decide",
    "closest_approach": "planner_jax.task.catch.decide",
    "planner": "planner_jax.task.hit.planners",
    "catch_planner": "planner_jax.task.catch.planners",
    "ExactHit": "planner_jax.task.hit.exact",
    "ExactCatch": "planner_jax.task.catch.exact",
    "plan": "planner_jax.task.solve",
    "plan_across_processes": "planner_jax.task.solve",
    "keep_compiled_programs": "planner_jax.compile_cache",
    "ReplanCatch": "planner_jax.task.catch.replan",
    "replanned": "planner_jax.task.catch.replan",
    "optimal_plan": "planner_jax.optimise.implicit",
    "referee_hits": "planner_jax.referee.hit",
    "referee_catches": "planner_jax.referee.catch",
    "PiecewisePolynomial": "planner_jax.trajectory.polynomial",
    "evaluate": "planner_jax.trajectory.polynomial",
    "Status": "planner_jax.optimise.status",
}

__all__ = [*_PUBLIC]


def __getattr__(name: str):
    """Import a public name on first use."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'planner_jax' has no attribute {name!r}")
    value = pkgutil.resolve_name(f"{_PUBLIC[name]}:{name}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_PUBLIC])
