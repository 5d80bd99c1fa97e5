"""Functions that make and check the quadrotor's part of a case, for the tasks `hit` and `catch`."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import DTypeLike
from jaxtyping import PyTree

from planner_jax.core import rules
from planner_jax.core.arithmetic import numpy_of, to_host
from planner_jax.core.checks import numbers_of
from planner_jax.core.choices import STARTS, require_one_of
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.rules import Field, Table
from planner_jax.robot.quadrotor import QuadrotorLimits, RotorLimits
from planner_jax.robot.quadrotor_model import NET, RECOVERY_TILT, QuadrotorModel, Tool

_LEAST_COSINE = 1e-6  # cosine of half the tilt of a start that is given as upside down
_MOMENTS = rules.Rule("> 0", lambda x, _: (x > 0.0) | (np.arange(x.shape[-1]) > 2))
# Shapes and ranges of the quadrotor's limits, for the cases of hits and of catches.
FLIGHT_RULES: Table = (
    Field("limits.speed", (), rules.POSITIVE),
    Field("limits.body_rate", (), rules.POSITIVE),
    Field("limits.acceleration", (), rules.POSITIVE),
    Field("limits.min_thrust", (), rules.NOT_NEGATIVE),
    Field("limits.min_thrust", (), rules.below("limits.max_thrust")),
    Field("limits.max_thrust", (), rules.POSITIVE_OR_NONE),
    Field("limits.max_tilt", (), rules.POSITIVE),
    Field("limits.recovery_tilt", (), rules.POSITIVE),
    Field("limits.air.drag", (), rules.NOT_NEGATIVE),
    Field("limits.air.thrust_drag", (), rules.NOT_NEGATIVE),
    Field("limits.air.wind", (3,)),
    Field("limits.rotors.mass", (), rules.POSITIVE),
    Field("limits.rotors.inertia", ("I",), _MOMENTS),
    Field("limits.rotors.mixer", ("R", 4)),
    Field("limits.rotors.min_thrust", (), rules.NOT_NEGATIVE),
    Field("limits.rotors.min_thrust", (), rules.below("limits.rotors.max_thrust")),
    Field("limits.rotors.max_thrust", ()),
)

# Maps a field of a case to the argument of `case` that sets it; error messages name the argument.
ARGUMENTS = {
    "head_state": "start",
    **{f"limits.air.{name}": "rotor_drag" for name in ("drag", "thrust_drag")},
    "limits.air.wind": "wind",
    "heading.angles": "heading",
    "heading.max_yaw_rate": "max_yaw_rate",
    **{
        f"limits.{name}": name
        for name in ("speed", "acceleration", "body_rate", "min_thrust", "max_thrust", "min_height")
    },
}


def require_tool(robot: object, kind: str) -> Tool:
    """Return a robot's tool; raise unless it is of the required kind, "racket" or "net"."""
    if not isinstance(robot, QuadrotorModel):
        rule = "a QuadrotorModel, such as pj.robot_named('x500') or pj.read_robot('my.yaml')"
        raise ArgumentTypeError("robot", rule, robot)
    if robot.tool.kind != kind:
        shown = f"{robot.name!r} with a {robot.tool.kind}"
        raise ArgumentError("robot", f"a {kind}", verb="carry", shown=shown)
    return robot.tool


def start_state(
    start: object, motion: tuple, gravity: object, batch: tuple[int, ...], dtype: DTypeLike
) -> Array:
    """Return states (*batch, 4, 3) at time 0 from arguments of `case`, which are named `start...`.

    The rows are the position [m], and of `motion` the velocity [m/s], the acceleration [m/s^2], and
    a jerk of 0. An attitude (4,) at the end of `motion`, a quaternion w x y z, replaces the
    acceleration: the thrust is along body z, and equal to the weight.
    """
    velocity, acceleration, attitude = motion
    given = {"start": start, "start_velocity": velocity, "start_acceleration": acceleration}
    rows = [numbers_of(name, value, batch, (3,)) for name, value in given.items()]
    if attitude is not None:
        if isinstance(rows[2], Tracer) or rows[2].any():
            raise ArgumentError(
                "start_attitude", "left out beside start_acceleration", shown="both"
            )
        quaternion = numbers_of("start_attitude", attitude, batch, (4,))
        xp = numpy_of(quaternion)
        w, x, y, z = xp.moveaxis(quaternion, -1, 0)
        square = xp.asarray(w * w + x * x + y * y + z * z, float)
        if xp is np:  # a traced quaternion of zeros leads to an acceleration of NaN
            rules.require_rule("start_attitude", square, square > 0.0, "a quaternion", batch)
        # Exactly upside down, the thrust alone would not determine the axis of the tilt.
        w = xp.where(w * w + z * z == 0.0, _LEAST_COSINE * xp.sqrt(square), w)
        axis = 2.0 * xp.stack([w * y + x * z, y * z - w * x, -x * x - y * y], axis=-1)
        weight = numbers_of("gravity", gravity, batch, ()).astype(float)
        rows[2] = weight[..., None] * axis / square[..., None]  # weight * (body z - e_3)
    rows = [row.astype(float) for row in (*rows, np.zeros(batch + (3,)))]
    return jnp.asarray(numpy_of(*rows).stack(rows, axis=-2), dtype)


def check_start(cases: PyTree) -> PyTree:
    """Return the cases; raise `CaseError` for a start below `min_height` or too strong a wind.

    Traced cases are marked instead, as by `require_or_mark`.
    """
    height, least = to_host(cases.head_state)[..., 0, 2], to_host(cases.limits.min_height)
    words = "at a height >= min_height"
    cases = rules.require_or_mark(cases, "start", height, height >= least, words)
    if cases.limits.air is None:
        return cases
    from planner_jax.task.air import check_hover  # few cases have drag

    return check_hover(cases)


def require_own_robot(robot: object, usual: QuadrotorModel, suite: str, wind: object) -> None:
    """Raise unless `robot` is the default `usual`, and `wind` None; `suite` has its own robot."""
    is_usual = isinstance(robot, QuadrotorModel) and robot == usual
    if not is_usual or wind is not None:
        name = "wind" if is_usual else "robot"
        raise ArgumentError(name, f"left out with suite {suite!r}, which has its own", shown="")


def add_starts(
    starts: object, cases: PyTree, suite: str, seed: int, first: int | np.ndarray
) -> PyTree:
    """Return drawn cases with states at time 0 of the kind `starts`, one of `STARTS`.

    `first` is the number of the first case, or the numbers (B,) of all cases, in the suite.
    """
    require_one_of(STARTS, "starts", starts)
    if starts == STARTS[0]:
        return cases
    from planner_jax.task.starts import draw_states  # few draws need it

    index = first + np.arange(len(cases.head_state)) if isinstance(first, int) else first
    return draw_states(cases, suite, seed, index)


def add_heading(cases: PyTree, leaf: Callable[..., Array], *given: object) -> PyTree:
    """Return cases with the arguments heading, max_yaw_rate, start_attitude in `given`, if any."""
    if all(each is None for each in given[:2]):
        return cases
    from planner_jax.robot.heading import add_request  # few cases request a heading

    return add_request(cases, leaf, *given)


def limits_of(
    robot: QuadrotorModel, leaf: Callable[..., Array], air: tuple[object, object], **given: object
) -> QuadrotorLimits:
    """Return a case's limits: the values in `given` that are not None, else the robot's limits.

    A robot with a net has limits of thrust, a robot with a racket only if `robot.limits.thrust` is
    not None. The function `leaf(name, value, *shape)` makes an array with the batch's leading axes.
    """
    own = robot.limits
    least, most = robot.thrust_bounds if robot.tool.kind == NET else own.thrust or (None, None)
    names = ("speed", "body_rate", "min_height", "acceleration", "max_tilt")
    values = {name: vars(own)[name] for name in names}
    if own.recovery_tilt != RECOVERY_TILT:
        values["recovery_tilt"] = own.recovery_tilt
    values |= {"min_thrust": least, "max_thrust": most}
    values |= {name: value for name, value in given.items() if value is not None}
    # If only one bound of the thrust is specified, the other is 0 (lower) or infinite (upper).
    if values["max_thrust"] is None and values["min_thrust"] is not None:
        values["max_thrust"] = np.inf
    if values["min_thrust"] is None and values["max_thrust"] is not None:
        values["min_thrust"] = 0.0
    arrays = {name: leaf(name, value) for name, value in values.items() if value is not None}
    found = None
    if any(each is not None for each in (*air, robot.drag)):
        from planner_jax.task.air import air_of  # few cases have drag

        found = air_of(robot, *air, leaf)
    return QuadrotorLimits(**arrays, rotors=_rotors_of(robot, leaf), air=found)


def _rotors_of(robot: QuadrotorModel, leaf: Callable[..., Array]) -> RotorLimits | None:
    if robot.rotor_range is None:
        return None
    least, most = robot.rotor_range
    return RotorLimits(
        mass=leaf("robot.mass", robot.mass),
        inertia=leaf("robot.inertia", robot.inertia, len(robot.inertia)),
        mixer=leaf("robot.rotors", robot.rotors.mixer, len(robot.rotors.places), 4),
        min_thrust=leaf("robot.rotors.min_thrust", least),
        max_thrust=leaf("robot.rotors.max_thrust", most),
    )
