"""Quadrotors by name: those of the papers, and three that are published with their figures.

What no source says is an assumption, and `source` says so. All tools are assumed to weigh nothing,
and all but the papers' are. Limits of speed, body rate and height are assumptions, chosen within
what the rotors can do; so are the shares of the rotors' thrusts that plans use.
"""

import dataclasses

from planner_jax.core.errors import UnknownName
from planner_jax.robot.quadrotor_model import (
    GRAVITY,
    NET,
    PAPER_CATCHER,
    PAPER_HITTER,
    RACKET,
    FlightLimits,
    QuadrotorModel,
    Rotors,
    Tool,
    cross,
)

# Mass and diagonal: the manufacturer's data sheet (27 g; 92 mm from motor to motor). Inertia, drag
# torque and greatest thrust: J. Foerster, "System Identification of the Crazyflie 2.0 Nano
# Quadrocopter", ETH Zurich 2015. Lag and tool are assumptions. A racket would be as heavy as it is.
CRAZYFLIE = QuadrotorModel(
    name="crazyflie",
    mass=0.027,
    inertia=(16.57e-6, 16.66e-6, 29.26e-6),
    rotors=Rotors(cross(0.092), max_thrust=0.16, torque_ratio=0.00596, lag=0.03, radius=0.0225),
    tool=Tool(NET, height=0.05, radius=0.06),
    limits=FlightLimits(speed=3.0, body_rate=8.0),
    source="Crazyflie 2.x: Bitcraze data sheet (mass, diagonal), Foerster 2015 (inertia, thrust, "
    "drag torque); lag, net and limits assumed",
)

# Mass and static thrust (870 g, 35 N): E. Kaufmann et al., "Champion-level drone racing using deep
# reinforcement learning", Nature 620, 2023, whose frame takes propellers of 6 inches. The diagonal
# is that of the 330 mm class. Inertia is an assumption: 60 g of motor and propeller at the end of
# each arm, the rest within 4 cm of the centre. So are drag torque, lag and tools.
RACER = QuadrotorModel(
    name="racer",
    mass=0.87,
    inertia=(0.0038, 0.0038, 0.007),
    rotors=Rotors(cross(0.33), max_thrust=8.75, torque_ratio=0.016, lag=0.03, radius=0.076),
    tool=Tool(RACKET, height=0.06, radius=0.11),
    limits=FlightLimits(speed=8.0, body_rate=8.0),
    source="Kaufmann et al., Nature 620, 2023 (mass, thrust); 330 mm, inertia, drag torque, lag, "
    "tool and limits assumed",
)

# Everything but tool and limits: models x500_base and x500 of PX4's Gazebo models, base and four
# propellers together; greatest thrust 8.54858e-6 N s^2 x (1000 rad/s)^2, the slower of two lags.
# Propellers of 13 inches, as the model shows them.
X500 = QuadrotorModel(
    name="x500",
    mass=2.064,
    inertia=(0.0239, 0.0239, 0.044),
    rotors=Rotors(
        ((0.174, 0.174), (-0.174, 0.174), (-0.174, -0.174), (0.174, -0.174)),
        max_thrust=8.549,
        torque_ratio=0.016,
        lag=0.025,
        radius=0.14,
    ),
    tool=Tool(RACKET, height=0.1, radius=0.15),
    limits=FlightLimits(speed=5.0, body_rate=4.0),
    source="PX4 Gazebo models x500_base and x500 (body, rotors, drag torque, lag); tool and limits "
    "assumed",
)


def _with_net(model: QuadrotorModel, height: float, radius: float) -> QuadrotorModel:
    tool = Tool(NET, height=height, radius=radius)
    return dataclasses.replace(model, name=f"{model.name}-net", tool=tool)


MODELS = {
    model.name: model
    for model in (
        PAPER_CATCHER,
        PAPER_HITTER,
        CRAZYFLIE,
        RACER,
        _with_net(RACER, 0.2, 0.125),
        X500,
        _with_net(X500, 0.3, 0.2),
    )
}


def ready_robot(name: str) -> QuadrotorModel:
    """Return the ready quadrotor of a name.

    There are `paper-catcher`, `paper-hitter`, `crazyflie`, `racer`, `racer-net`, `x500` and
    `x500-net`; `planner-jax robots` shows their figures.

    Raises:
        UnknownName: there is none; one line that lists those there are.
    """
    if name in MODELS:
        return MODELS[name]
    from planner_jax.robot.quadrotor_file import suggestion

    hint = suggestion(str(name), MODELS)
    raise UnknownName("robot", f"one of {', '.join(MODELS)}", shown=f"{name!r:.60}{hint}")


def robot_named(word: str) -> QuadrotorModel:
    """Return the ready quadrotor of a name, or that of a file.

    Raises:
        UnknownName: there is neither a ready one nor such a file; one line.
        RobotError: the file breaks a rule; one line.
        MissingExtra: the file needs MuJoCo, which is not installed.
    """
    from planner_jax.robot.quadrotor_file import ENDINGS, read_robot

    if not word.lower().endswith(ENDINGS):
        return ready_robot(word)
    try:
        return read_robot(word)
    except OSError as error:
        why = error.strerror or error
        raise UnknownName("robot", "a file that can be read", shown=f"{word!r} ({why})") from None


def listing() -> str:
    """Return the ready quadrotors with their main figures, a line each under a heading."""
    rows = [_figures(model) for model in MODELS.values()]
    table = [list(rows[0]), *(list(row.values()) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = (
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table
    )
    return "\n".join(lines) + "\n"


def _figures(model: QuadrotorModel) -> dict[str, str]:
    rotors, limits = model.rotors, model.limits
    places = rotors.positions[:, :2]
    across = max(float(((a - b) ** 2).sum()) for a in places for b in places) ** 0.5
    return {
        "robot": model.name,
        "mass [kg]": f"{model.mass:g}",
        "across [m]": f"{across:.3g}",
        "thrust/weight": f"{4.0 * rotors.max_thrust / (model.mass * GRAVITY):.2f}",
        "lag [ms]": f"{1e3 * rotors.lag:g}",
        "tool": f"{model.tool.kind} of {model.tool.radius:g} m",
        "speed [m/s]": f"{limits.speed:g}",
        "body rate [rad/s]": f"{limits.body_rate:g}",
    }
