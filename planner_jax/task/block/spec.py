"""Registry entry of the task `block`: names of planners and suites. The module imports no JAX."""

import dataclasses

from planner_jax.core.registry import Task


@dataclasses.dataclass(frozen=True)
class Suite:
    """A family of random throws: launch distance, and whether a pole stands in front of the arm."""

    description: str
    distance: tuple[float, float] = (6.0, 12.0)  # [m], from the arm's first axis to the launch
    has_pole: bool = True


# `planner_jax.task.block.suites` defines the other ranges of random throws, such as heights.
SUITES = {
    "pole": Suite("Throws from 6 to 12 m, a pole in front of the arm."),
    "open": Suite("Throws from 6 to 12 m, without a pole.", has_pole=False),
    "short": Suite("Throws from 6 to 8 m, a pole in front of the arm.", distance=(6.0, 8.0)),
}

TASK = Task(
    name="block",
    summary="an arm with a shield protects a box from thrown balls",
    home="planner_jax.task.block",
    planners={
        "online": "planner_jax.task.block.default_planner:OnlineBlock",
        "brisk": "planner_jax.task.block.default_planner:brisk",
        "direct": "planner_jax.baselines.block.direct:DirectBlock",
        "rrt-connect": "planner_jax.baselines.block.rrt_connect:RrtConnectBlock",
        "epase": "planner_jax.baselines.block.epase:EpaseBlock",
        "insat": "planner_jax.baselines.block.insat:InsatBlock",
        "pinsat": "planner_jax.baselines.block.insat:PinsatBlock",
        "library": "planner_jax.baselines.block.library.planner:library_planner",
    },
    from_file={"library": "planner-jax library build FILE"},
    suites={name: suite.description for name, suite in SUITES.items()},
    sweep="planner_jax.sweep.block.settings:BlockSettings",
    flight="planner_jax.sims.block_settings:BlockFly",
    contact="contact_time",
    single="planner_jax.cli.plan.settings:SingleBlockSettings",
    yardstick={"name": "brisk", "effort": "best"},
)
