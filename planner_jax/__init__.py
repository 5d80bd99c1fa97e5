"""Batched, differentiable planning for robots that meet flying objects.

    import planner_jax as pj

    cases = pj.hit.draw(1000)  # or pj.hit.case(position, velocity, target)
    plans = pj.plan(pj.hit.planner("exact"), cases)
    verdict = pj.hit.judge(cases, plans)

The tasks are `hit`, `rally`, `catch`, `team`, `intercept`, `group`, `block` and `reach`.
`task_named` also returns tasks that other installed packages register. Every task has the functions
`case`, `draw`, `planner` and `judge`. These functions apply to every task:

* `plan`: plans one case or a batch, on all devices; `solve`: plans inside `jax.jit` or `jax.vmap`
* `keep_compiled_programs`: stores on disk programs that are compiled before the first plan;
  `quick_options`: makes XLA compile faster on a CPU; `explain`: prints what compiles it anew
* `replan`: updates a plan while a robot executes it
* `gradient`: differentiates one number of every plan by parts of its case; `sensitivity`: the main
  numbers by all parts; `optimal_plan`: a plan that `jax.grad` can differentiate in a loss function
* `take`, `are_solved`, `Status`: read plans; a plan has `sample`, `save` and `load`
* `export`: writes one plan to a file for a controller; `show`: draws one plan

Classes for parts of cases and plans:

* extra limits and costs that a user adds to a case as its `extras`: `KeepOut`, `KeepOutBox`,
  `Plane`, `Geofence`, `SpeedZone`, `Dislike`, or any class with the same methods
* targets in space: `BallState`, `fly`, `BallPath`, `HarmonicPath`, `table_path`, `predict_path`,
  `target_at`; in the plane: `TurningPath`, `PolynomialPath`, `ControlledPath`
* `ball.fit`: estimates and predicts flights from recordings; `perception`: estimates during flights
* `penalties`: the penalties of the published planners, as pure functions
* obstacles of a car: `Obstacles`, made by `obstacles`
* trajectories: `PiecewisePolynomial`, `evaluate`, `snap_energy`; splines: `minco`, `durations_of`
* base classes and settings for planners and tasks that a user writes: `Planner`, `Plan`, `Attempt`,
  `outcome`, `Problem`, `SearchPlanner`, `pending`, `LbfgsConfig`, `NewtonConfig`, `Verdict`, `Task`

All errors are `PlannerJaxError`s. A wrong argument raises an `ArgumentError`, which is a
`ValueError` or, for a wrong type, a `TypeError`. A wrong number in a case raises a `CaseError`, a
subclass of `ArgumentError`.

Every name is imported on its first use, so that `import planner_jax` itself is fast.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
