"""Define the quadrotors that users select by name, such as the robots of [Yu2023catch].

They are the robots of [Yu2023catch] and [Yu2023bat], a Crazyflie, a racer, an X500 and an Iris.

Numbers without a source are assumptions; the field `source` of a robot lists them. All tools are
massless. All limits, and the tools of Crazyflie, racer and X500, are assumptions.
"""

import dataclasses
import math

from planner_jax.core import GRAVITY
from planner_jax.core.errors import UnknownName
from planner_jax.robot.quadrotor_model import (
    NET,
    PAPER_CATCHER,
    PAPER_HITTER,
    RACKET,
    FlightLimits,
    QuadrotorModel,
    Rotors,
    Tool,
    place_in_cross,
)

# Crazyflie 2.x. Mass and diagonal are from the manufacturer's data sheet (27 g, and 92 mm between
# opposite motors). Inertia, drag torque and greatest thrust are from [Foerster2015]. The rotors'
# time constant and the net are assumptions; a racket would weigh about as much as the robot.
CRAZYFLIE = QuadrotorModel(
    name="crazyflie",
    mass=0.027,
    inertia=(16.57e-6, 16.66e-6, 29.26e-6),
    rotors=Rotors(
        place_in_cross(0.092), max_thrust=0.16, torque_ratio=0.00596, lag=0.03, radius=0.0225
    ),
    tool=Tool(NET, height=0.05, radius=0.06),
    limits=FlightLimits(speed=3.0, body_rate=8.0),
    source="Crazyflie 2.x: Bitcraze data sheet (mass, diagonal), Foerster 2015 (inertia, thrust, "
    "drag torque); lag, net and limits assumed",
)

# A racing quadrotor. Mass and static thrust (870 g, 35 N) are from [Kaufmann2023], with 6-inch
# propellers. All other numbers are assumptions. A diagonal of 330 mm is usual. The inertia assumes
# 60 g of motor and propeller at the end of each arm, the remainder within 4 cm of the centre.
RACER = QuadrotorModel(
    name="racer",
    mass=0.87,
    inertia=(0.0038, 0.0038, 0.007),
    rotors=Rotors(
        place_in_cross(0.33), max_thrust=8.75, torque_ratio=0.016, lag=0.03, radius=0.076
    ),
    tool=Tool(RACKET, height=0.06, radius=0.11),
    limits=FlightLimits(speed=8.0, body_rate=8.0),
    source="Kaufmann et al., Nature 620, 2023 (mass, thrust); 330 mm, inertia, drag torque, lag, "
    "tool and limits assumed",
)

# The X500. All numbers but tool and limits are from the models x500_base and x500 of PX4's Gazebo
# models. Mass and inertia are sums over base and propellers. The greatest thrust of a rotor is
# 8.54858e-6 N s^2 x (1000 rad/s)^2. The model has two time constants of the rotors; the greater one
# is used. The propellers' mesh has a diameter of 13 inches.
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

# The Iris of the benchmark VolleyBots [Xu2025], from the file iris.yaml of OmniDrones: mass,
# inertia, angles and lengths of arms, and rotors of 8.54858e-6 N s^2 x (838 rad/s)^2. The file's
# moment 0.0977 about z exceeds the sum of the others, which no rigid body has; the sum is taken.
# The racket of [Xu2025] has a radius of 0.2 m and a restitution of 0.8. The ball, with a radius of
# 0.1 m, meets the racket when its centre is 0.15 m above the propellers, which is an assumption.
IRIS = QuadrotorModel(
    name="iris",
    mass=1.52,
    inertia=(0.0347563, 0.0458929, 0.0806),
    rotors=Rotors(
        ((0.22, 0.13), (-0.2, 0.13), (-0.2, -0.13), (0.22, -0.13)),
        max_thrust=6.003,
        torque_ratio=0.016,
        lag=0.025,
        radius=0.12,
    ),
    tool=Tool(RACKET, height=0.15, radius=0.2, restitution=0.8),
    limits=FlightLimits(speed=5.0, body_rate=4.0),
    source="OmniDrones iris.yaml (body, rotors), VolleyBots (racket, restitution); lag, height of "
    "the racket and limits assumed",
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
        IRIS,
        _with_net(X500, 0.3, 0.2),
    )
}


def robot_named(word: str) -> QuadrotorModel:
    """Return the quadrotor of a name, or read a quadrotor from a file.

    The names are `paper-catcher`, `paper-hitter`, `crazyflie`, `racer`, `racer-net`, `x500`, `iris`
    and `x500-net`. The command `planner-jax robots` prints their main numbers. A `word` that ends
    in .yaml, .yml or .xml is the path of a file; see `read_robot`.

    Raises:
        UnknownName: no quadrotor and no file has this name. The message lists the names.
        RobotError: the file is invalid, such as a negative mass. The message is one line.
        MissingExtra: the file needs MuJoCo, which is not installed.
    """
    if word in MODELS:
        return MODELS[word]
    from planner_jax.robot.quadrotor_file import ENDINGS, read_robot, suggestion

    if not word.lower().endswith(ENDINGS):
        shown = f"{word!r:.60}{suggestion(word, MODELS)}"
        raise UnknownName("robot", f"one of {', '.join(MODELS)}", shown=shown)
    try:
        return read_robot(word)
    except OSError as error:
        why = error.strerror or error
        raise UnknownName("robot", "a file that can be read", shown=f"{word!r} ({why})") from None


def format_models() -> str:
    """Format a text table with the main numbers of all named quadrotors, one line for each."""
    rows = [_summarise(model) for model in MODELS.values()]
    columns = [[heading, *(row[heading] for row in rows)] for heading in rows[0]]
    padded = [[cell.ljust(max(map(len, column))) for cell in column] for column in columns]
    return "".join("  ".join(line).rstrip() + "\n" for line in zip(*padded, strict=True))


def _summarise(model: QuadrotorModel) -> dict[str, str]:
    """Return a row of the table of quadrotors: heading of the column -> number as text."""
    rotors, limits = model.rotors, model.limits
    across = max(math.dist(a, b) for a in rotors.places for b in rotors.places)
    return {
        "robot": model.name,
        "mass [kg]": f"{model.mass:g}",
        "across [m]": f"{across:.3g}",
        "thrust/weight": f"{len(rotors.places) * rotors.max_thrust / (model.mass * GRAVITY):.2f}",
        "lag [ms]": f"{1e3 * rotors.lag:g}",
        "tool": f"{model.tool.kind} of {model.tool.radius:g} m",
        "speed [m/s]": f"{limits.speed:g}",
        "body rate [rad/s]": f"{limits.body_rate:g}",
        "tilt, recovery [deg]": ", ".join(
            "-" if tilt is None else f"{math.degrees(tilt):.3g}"
            for tilt in (limits.max_tilt, limits.recovery_tilt)
        ),
    }
