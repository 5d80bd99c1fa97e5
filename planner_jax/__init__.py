"""Batched, differentiable planning for robots that meet flying objects.

    import planner_jax as pj

    cases = pj.hit.draw(1000)  # or pj.hit.case(position, velocity, target)
    plans = pj.plan(pj.hit.planner("exact"), cases)
    verdict = pj.hit.judge(cases, plans)

The tasks are `hit`, `catch`, `intercept`, `group`, `block`, and the tasks of other packages
(`task_named`). Every task has the functions `case`, `draw`, `planner` and `judge`. The functions
for all tasks:

* `plan`: plans one case or many, on all devices; `solve`: does so inside compiled functions
* `keep_compiled_programs`: keeps compiled programs on the disk
* `replan`: plans again from a plan that is being executed
* `gradient`: differentiates a number of every plan; `optimal_plan`: does so inside a loss
* `take`, `are_solved`, `Status`: read plans; a plan has `sample`, `save` and `load`
* `export`: writes one plan to a file for a controller

Classes for parts of cases and plans:

* a user's limits and costs, `extras` of a case: `KeepOut`, `KeepOutBox`, `Plane`, `Geofence`,
  `SpeedZone`, `Dislike`, or any class with their methods
* targets in space: `BallState`, `fly`, `BallPath`, `HarmonicPath`, `table_path`, `predict_path`,
  `target_at`; in the plane: `TurningPath`, `PolynomialPath`
* obstacles of a car: `Obstacles`, made by `obstacles`
* trajectories: `PiecewisePolynomial`, `evaluate`
* a user's planners and tasks: `Planner`, `Plan`, `Attempt`, `outcome`, `OptimisedPlanner`,
  `pending`, `Round`, `LbfgsConfig`, `NewtonConfig`, `Evaluation`, `Verdict`, `Task`

All errors are `PlannerJaxError`s. A wrong argument raises an `ArgumentError`, which is a
`ValueError` or, for a wrong type, a `TypeError`. A wrong number in a case raises its subclass
`CaseError`.

Everything is imported on first use, so that `import planner_jax` itself is fast.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
