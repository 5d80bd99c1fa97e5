"""Batched, differentiable planning for robots that meet flying objects.

    import planner_jax as pj

    cases = pj.hit.draw(1000)  # or pj.hit.case(position, velocity, target)
    plans = pj.plan(pj.hit.planner("exact"), cases)
    verdict = pj.hit.judge(cases, plans)

Every task, `hit`, `catch`, `intercept`, `group`, `block` and the tasks of other packages
(`task_named`), has the functions `case`, `draw`, `planner` and `judge`. The calls are the same for
all tasks:

* `plan`: one case or many, on all devices; `solve`, the same for the inside of compiled functions;
  `keep_compiled_programs`
* `replan`: from the plan that is being carried out
* `gradient`: of a number of every plan by parts of its case; `optimal_plan` inside a loss
* `take`, `solved`, `Status`: reading plans; a plan has `sample`, `save` and `load`
* `export`: one plan into a file for a controller

Limits and costs of one's own along the way, a case's `extras`: `KeepOut`, `KeepOutBox`, `Plane`,
`Geofence`, `SpeedZone`, `Dislike`, or any class with their methods. Where targets are:
`BallState`, `fly`, `BallPath`, `HarmonicPath`, `table_path`, `predict_path`, `target_at`; in the
plane `TurningPath`, `PolynomialPath`, and what is in a car's way, `Obstacles`, made by `obstacles`.
What a trajectory does: `PiecewisePolynomial`, `evaluate`. For planners and tasks of one's own:
`Planner`, `Plan`, `Attempt`, `outcome`, `OptimisedPlanner`, `pending`, `Round`, `LbfgsConfig`,
`NewtonConfig`, `Evaluation`, `Verdict`, `Task`.

Errors are `PlannerJaxError`s. A wrong argument raises an `ArgumentError`, which is a `ValueError`
or, for a wrong type, a `TypeError`; a wrong number of a case raises its subclass `CaseError`.

Everything is imported on first use, so that `import planner_jax` itself is quick.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
