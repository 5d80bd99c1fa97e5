"""Names of planners and suites of the task `intercept` (a car meets a target), without JAX."""

import dataclasses

from planner_jax.core.registry import Task


@dataclasses.dataclass(frozen=True)
class Suite:
    """A family of random interceptions: numbers of obstacles, and the time of the meeting.

    The arrays of obstacles have the sizes `wall_room` and `mover_room` for any number of obstacles,
    so that all cases of a suite share one compiled program.
    """

    description: str
    num_walls: tuple[int, int]  # least and greatest number of walls; in a maze, across the map
    num_movers: tuple[int, int]  # least and greatest number of moving obstacles
    mover_speed: tuple[float, float] = (0.1, 0.6)  # [m/s], range of moving obstacles' speeds
    time: float = 10.0  # [s], of the meeting
    # [s], time from the estimated earliest arrival to the meeting; None: the meeting is at `time`.
    spare: float | None = None
    is_maze: bool = False
    wall_room: tuple[int, int] = (12, 6)  # sizes of the array of walls: polygons, corners of each
    mover_room: tuple[int, int] = (4, 6)  # sizes of the array of moving obstacles, as for walls
    num_targets: tuple[int, int] = (1, 1)  # least and greatest number of targets
    # [m/s], change of the targets' velocity each second. With (0, 0) half of the targets turn.
    control: tuple[float, float] = (0.0, 0.0)
    # Rectangles x, y, x, y [m] (two opposite corners) of all walls, and of all movers at time 0
    # with their velocities x, y [m/s]; (): random.
    wall_boxes: tuple[tuple[float, float, float, float], ...] = ()
    mover_boxes: tuple[tuple[float, float, float, float, float, float], ...] = ()


# `planner_jax.task.intercept.suites` defines the other ranges of random cases, such as distances.
SUITES = {
    "easy": Suite("Four to six walls and one mover.", (4, 6), (1, 1)),
    "medium": Suite("Seven to nine walls, two or three movers.", (7, 9), (2, 3)),
    "hard": Suite("Ten to twelve walls, three or four movers.", (10, 12), (3, 4)),
    "storm": Suite(
        "Twelve movers, the fastest at 1 m/s, among five to eight walls.",
        (5, 8),
        (12, 12),
        mover_speed=(0.2, 1.0),
        mover_room=(12, 6),
    ),
    "gale": Suite("Eight movers among eight to twelve walls.", (8, 12), (8, 8), mover_room=(12, 6)),
    "maze": Suite(
        "Two or three walls across the map, each with one gap, and dead ends before them.",
        (2, 3),
        (1, 2),
        time=15.0,
        is_maze=True,
    ),
    "rush": Suite(
        "The obstacles of `hard`; the meeting is 0.5 s after a reach set first meets the target.",
        (10, 12),
        (3, 4),
        spare=0.5,
    ),
    "qu-curve": Suite(
        "The obstacles of `easy`; the target's velocity changes by 0.4 m/s each second.",
        (4, 6),
        (1, 1),
        control=(0.0, 0.4),
    ),
    "qu-map": Suite(
        "One map with four walls, and two movers that cross it at constant speed.",
        (4, 4),
        (2, 2),
        wall_boxes=(
            (2.0, 0.0, 2.4, 3.2),
            (2.6, 5.2, 4.0, 5.6),
            (4.4, 2.4, 4.8, 4.2),
            (5.6, 4.8, 6.0, 8.0),
        ),
        mover_boxes=((3.2, 0.2, 3.6, 0.6, 0.0, 0.4), (5.0, 7.2, 5.4, 7.6, 0.0, -0.4)),
    ),
}

TASK = Task(
    name="intercept",
    summary="a car meets a moving target among obstacles that stand and move",
    home="planner_jax.task.intercept",
    planners={
        "spacetime": "planner_jax.task.intercept.default_planner:SpacetimeIntercept",
        "quick": "planner_jax.task.intercept.default_planner:quick",
        "lattice": "planner_jax.baselines.intercept.path_then_speed:lattice",
        "paper": "planner_jax.baselines.intercept.paper:PaperIntercept",
        "em": "planner_jax.baselines.intercept.path_then_speed:em",
        "constant": "planner_jax.baselines.intercept.path_then_speed:constant",
    },
    suites={name: suite.description for name, suite in SUITES.items()},
    sweep="planner_jax.sweep.intercept.settings:InterceptSettings",
    flight="planner_jax.sims.settings:InterceptFly",
    single="planner_jax.cli.plan.settings:SingleInterceptSettings",
    contact="time",
    yardstick={"effort": "best"},
)
