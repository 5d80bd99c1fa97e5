"""Description of a quadrotor: body, rotors, tool and limits, for planner, referee and simulation.

The quadrotors of [Yu2023catch] and [Yu2023bat] are defined here, others in `quadrotor_models`.

Body frame: x forward, y left, z along the thrust. The origin is the centre of mass, which lies in
the plane of the propellers. SI units. This module imports no JAX.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from planner_jax.core import GRAVITY
from planner_jax.core.choices import require, require_one_of
from planner_jax.core.errors import ArgumentError, ArgumentTypeError

RECOVERY_TILT = math.radians(40.0)  # [rad], default of `FlightLimits.recovery_tilt`
# [rad], at least this much more than the tilt at its start is allowed to a recovery
MORE_TILT = math.radians(10.0)

NET, RACKET = "net", "racket"
COUNTS = (4, 6, 8)  # numbers of rotors

# Rules of numbers: the text of an error message, and the function that tests a number.
_FINITE = ("finite", lambda x: True)
_POSITIVE = ("> 0", lambda x: x > 0.0)
_NOT_NEGATIVE = (">= 0", lambda x: x >= 0.0)


@dataclasses.dataclass(frozen=True)
class Tool:
    """The disc that meets the ball, perpendicular to the thrust: hoop of a net, or a racket.

    Attributes:
        kind: "net" or "racket".
        height: [m], height of the disc's centre above the propeller plane.
        radius: [m], radius of the disc.
        restitution: coefficient of restitution beta of a racket.
        max_angle: [rad], greatest angle theta_safe of a net's axis to the ball's reversed velocity.
    """

    kind: str
    height: float
    radius: float
    restitution: float = 0.7
    max_angle: float = math.pi / 6.0

    def __post_init__(self) -> None:
        require_one_of((NET, RACKET), "tool.kind", self.kind)
        _require("tool.radius", self.radius, *_POSITIVE)
        _require("tool.height", self.height, *_FINITE)
        _require("tool.restitution", self.restitution, "in [0, 1]", lambda x: 0.0 <= x <= 1.0)
        _require("tool.max_angle", self.max_angle, "in [0, 3.14159]", lambda x: 0.0 <= x <= math.pi)


@dataclasses.dataclass(frozen=True)
class Rotors:
    """R = 4, 6 or 8 rotors; each rotor turns in the direction opposite to the next rotor's.

    Attributes:
        places: (R, 2) [m], x and y of the rotors, counter-clockwise.
        max_thrust: [N], greatest thrust of one rotor.
        min_thrust: [N], least thrust of one rotor.
        torque_ratio: [m], drag torque of a rotor divided by its thrust.
        lag: [s], time constant of a rotor's thrust.
        radius: [m], radius of a propeller; used only for pictures.
    """

    places: tuple[tuple[float, float], ...]
    max_thrust: float
    min_thrust: float = 0.0
    torque_ratio: float = 0.016
    lag: float = 0.02
    radius: float = 0.06

    def __post_init__(self) -> None:
        rule = "x and y of 4, 6 or 8 rotors"
        try:
            places = np.asarray(self.places, float)
        except (TypeError, ValueError):
            raise ArgumentTypeError("rotors.places", rule, self.places) from None
        is_shaped = places.shape in [(count, 2) for count in COUNTS]
        require(is_shaped, "rotors.places", rule, shown=f"{len(np.atleast_1d(places))} rotors")
        require(bool(np.isfinite(places).all()), "rotors.places", "finite", self.places)
        least = self.min_thrust
        _require("rotors.min_thrust", least, *_NOT_NEGATIVE)
        _require("rotors.max_thrust", self.max_thrust, f"> {least:g}", lambda x: x > least)
        _require("rotors.torque_ratio", self.torque_ratio, *_POSITIVE)
        _require("rotors.lag", self.lag, *_POSITIVE)
        _require("rotors.radius", self.radius, *_POSITIVE)
        square = self.allocation @ self.allocation.T
        if np.linalg.det(square) < 1e-24:
            raise ArgumentError("rotors.places", "them turn the body", self.places, verb="let")

    @property
    def positions(self) -> np.ndarray:
        """Centres of the rotors (R, 3) [m], body frame."""
        return np.pad(np.asarray(self.places, float), ((0, 0), (0, 1)))

    @property
    def torque_arms(self) -> np.ndarray:
        """Drag torque of each rotor about body z, divided by the rotor's thrust, (R,) [m]."""
        return self.torque_ratio * np.resize([1.0, -1.0], len(self.places))

    @property
    def allocation(self) -> np.ndarray:
        """Matrix (4, R) from rotor thrusts [N] to total thrust [N] and torque [N m]."""
        x, y = np.asarray(self.places, float).T
        return np.stack([np.ones(len(x)), y, -x, self.torque_arms])

    @property
    def mixer(self) -> np.ndarray:
        """Matrix (R, 4) from total thrust [N] and torque [N m] to the least rotor thrusts [N]."""
        is_square = len(self.places) == 4
        return np.linalg.inv(self.allocation) if is_square else np.linalg.pinv(self.allocation)

    @property
    def shares(self) -> np.ndarray:
        """Fraction (R,) of the total thrust that each rotor produces if there is no torque."""
        return self.mixer[:, 0]


def place_in_cross(diagonal: float, count: int = 4) -> tuple[tuple[float, float], ...]:
    """Return x and y [m] of rotors on a regular polygon whose `diagonal` [m] joins opposite rotors.

    The front of the body is in the middle between two rotors.
    """
    if count == 4:
        half = 0.5 * diagonal * math.sqrt(0.5)
        return ((half, half), (-half, half), (-half, -half), (half, -half))
    angles = (np.arange(count) + 0.5) * 2.0 * np.pi / count
    places = 0.5 * diagonal * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return tuple((x, y) for x, y in places.tolist())


@dataclasses.dataclass(frozen=True)
class FlightLimits:
    """Limits that planned motions of a quadrotor keep; None means that there is no such limit.

    Attributes:
        speed: [m/s], greatest speed.
        body_rate: [rad/s], greatest body rate, including its component about body z.
        min_height: [m], least height of the propeller plane.
        acceleration: [m/s^2], greatest acceleration.
        thrust: [m/s^2], least and greatest thrust per unit mass.
        rotor_share: fraction of the range of a rotor's thrust that plans may use. The remainder is
            a reserve for the controller. None: plans do not limit the thrusts of single rotors.
        max_tilt: [rad], greatest tilt (angle between thrust and vertical) of the whole flight;
            None: no limit.
        recovery_tilt: [rad], greatest tilt of recoveries.
    """

    speed: float
    body_rate: float
    min_height: float = 0.25
    acceleration: float | None = None
    thrust: tuple[float, float] | None = None
    rotor_share: float | None = 0.9
    max_tilt: float | None = None
    recovery_tilt: float = RECOVERY_TILT

    def __post_init__(self) -> None:
        _require("limits.speed", self.speed, *_POSITIVE)
        _require("limits.body_rate", self.body_rate, *_POSITIVE)
        _require("limits.min_height", self.min_height, *_NOT_NEGATIVE)
        if self.acceleration is not None:
            _require("limits.acceleration", self.acceleration, *_POSITIVE)
        if self.thrust is not None:
            least, most = self.thrust
            _require("limits.thrust, the least,", least, *_NOT_NEGATIVE)
            _require("limits.thrust, the greatest,", most, f"> {least:g}", lambda x: x > least)
        if self.rotor_share is not None:
            _require("limits.rotor_share", self.rotor_share, "in (0, 1]", lambda x: 0.0 < x <= 1.0)
        for name in ("max_tilt", "recovery_tilt"):
            if (tilt := vars(self)[name]) is not None or name == "recovery_tilt":
                _require(f"limits.{name}", tilt, "in (0, 3.14159]", lambda x: 0.0 < x <= math.pi)


@dataclasses.dataclass(frozen=True)
class RotorDrag:
    """Coefficients of the linear drag per unit mass, across and along the thrust [Faessler2018]."""

    across: float  # [1/s]
    along: float  # [1/s]

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            _require(f"drag.{name}", value, *_NOT_NEGATIVE)


@dataclasses.dataclass(frozen=True)
class QuadrotorModel:
    """Description of a quadrotor; hashable, so that it can be a static argument of `jax.jit`.

    Raises:
        ValueError: a number is invalid, such as a negative mass, or the rotors cannot hover.

    Attributes:
        name: name of the quadrotor.
        mass: [kg], mass.
        inertia: [kg m^2], about the body's axes: the moments I_xx, I_yy, I_zz, and if they are not
            0 also the other entries I_xy, I_xz, I_yz of the inertia matrix.
        rotors: positions, thrusts and lag of the rotors.
        tool: net or racket.
        limits: limits that planned motions keep.
        source: source of the numbers.
        drag: drag of the rotors; None: plans and simulated flights have no drag.
    """

    name: str
    mass: float
    inertia: tuple[float, ...]
    rotors: Rotors
    tool: Tool
    limits: FlightLimits
    source: str = ""
    drag: RotorDrag | None = None

    def __post_init__(self) -> None:
        parts = {"rotors": Rotors, "tool": Tool, "limits": FlightLimits}
        parts |= {} if self.drag is None else {"drag": RotorDrag}
        for name, kind in parts.items():
            if not isinstance(vars(self)[name], kind):
                raise ArgumentTypeError(name, f"a {kind.__name__}", vars(self)[name])
        _require("mass", self.mass, *_POSITIVE)
        is_sequence = isinstance(self.inertia, Sequence | np.ndarray)
        is_shaped = is_sequence and len(self.inertia) in (3, 6)
        require(is_shaped, "inertia", "3 or 6 numbers", self.inertia)
        for k, axis in enumerate(self.inertia):
            _require("inertia", axis, *(_POSITIVE if k < 3 else _FINITE))
        moments = np.linalg.eigvalsh(self.inertia_matrix)
        is_body = moments[0] > 0.0 and 2.0 * moments[2] <= sum(moments) * (1.0 + 1e-9)
        require(
            bool(is_body), "inertia", "of a body, none above the other two together", self.inertia
        )
        num = len(self.rotors.places)
        weight, most = self.mass * GRAVITY, num * self.rotors.max_thrust
        rule = f"> the weight of {weight:.3g} N"
        require(most > weight, f"{num} x rotors.max_thrust", rule, shown=f"{most:.3g} N")
        lift = weight * self.rotors.shares
        if not np.all((lift > self.rotors.min_thrust) & (lift < self.rotors.max_thrust)):
            shown = " ".join(f"{each:.3g}" for each in lift)
            rule = "each rotor carry its part of the weight"
            raise ArgumentError("rotors.places", rule, verb="let", shown=f"{shown} N")
        low, high = self.rotor_range or (0.0, math.inf)
        if not np.all((lift > low) & (lift < high)):
            rule = f"the robot hover with {max(lift):.4g} N a rotor"
            used = f"{low:.4g} to {high:.4g} N, {self.limits.rotor_share:.0%} of a rotor's range"
            raise ArgumentError("limits.rotor_share", rule, verb="let", shown=used)
        thrust = self.limits.thrust
        if thrust is not None and not thrust[0] < GRAVITY < thrust[1]:
            rule = f"the weight of {GRAVITY} m/s^2"
            raise ArgumentError("limits.thrust", rule, thrust, verb="include")

    def __str__(self) -> str:
        return repr(self.name)

    @property
    def inertia_matrix(self) -> np.ndarray:
        """Inertia matrix (3, 3) [kg m^2] about the body's axes."""
        x, y, z, xy, xz, yz = (*self.inertia, 0.0, 0.0, 0.0)[:6]
        return np.array([[x, xy, xz], [xy, y, yz], [xz, yz, z]])

    @property
    def thrust_bounds(self) -> tuple[float, float]:
        """Least, greatest thrust per unit mass [m/s^2]: `limits.thrust`; if None, by the rotors."""
        if self.limits.thrust is not None:
            return self.limits.thrust
        low, high = self.rotor_range or (self.rotors.min_thrust, self.rotors.max_thrust)
        num = len(self.rotors.places)
        return num * low / self.mass, num * high / self.mass

    @property
    def rotor_range(self) -> tuple[float, float] | None:
        """Least and greatest thrust [N] that a plan may use of a rotor; None if not limited."""
        share = self.limits.rotor_share
        if share is None:
            return None
        least, most = self.rotors.min_thrust, self.rotors.max_thrust
        spare = 0.5 * (1.0 - share) * (most - least)
        return least + spare, most - spare


def _require(name: str, value: object, rule: str, holds: Callable[[float], bool]) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise ArgumentTypeError(name, "a number", value)
    require(math.isfinite(value) and holds(float(value)), name, rule, value)


# The quadrotor of [Yu2023catch]. Height and radius of the net are from Fig. 6 and the diagonal is
# from the paper. The limits are this library's, since the paper states none. It also states neither
# mass, inertia nor rotors. Assumptions: 0.9 kg of computer, battery and frame within 5 cm of the
# centre, and 75 g of motor and propeller at the end of each arm. The greatest thrust is four times
# the weight; plans use up to 2.5 times, so that a reserve remains for the controller. As in the
# paper, plans do not limit the thrusts of single rotors.
PAPER_CATCHER = QuadrotorModel(
    name="paper-catcher",
    mass=1.2,
    inertia=(0.005, 0.005, 0.009),
    rotors=Rotors(place_in_cross(0.33), max_thrust=11.8),
    tool=Tool(NET, height=0.2, radius=0.125),
    limits=FlightLimits(
        speed=5.0, body_rate=5.0, thrust=(0.3 * GRAVITY, 2.5 * GRAVITY), rotor_share=None
    ),
    source="[Yu2023catch] (Catch Planner); body and rotors assumed",
)
# The quadrotor of [Yu2023bat, Fig. 2 and Section VI-A]. Body and rotors are from `PAPER_CATCHER`.
PAPER_HITTER = dataclasses.replace(
    PAPER_CATCHER,
    name="paper-hitter",
    tool=Tool(RACKET, height=0.06, radius=0.11),
    limits=FlightLimits(speed=5.0, body_rate=5.0, acceleration=15.0, rotor_share=None),
    source="[Yu2023bat] (Bat Planner); body and rotors assumed",
)
