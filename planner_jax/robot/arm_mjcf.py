"""An arm from MuJoCo's model format, MJCF; read with the standard library, without MuJoCo.

What the file has to hold is what `models/irb1600.xml` holds: a base body that stands still, on it
a chain of six bodies with one hinge joint, an inertial and any capsules and spheres each; a box on
the base; on the sixth a square box and a site named shield, the site in the middle of the face that
looks along +x; a key named home. MJCF with anything else in these places is refused rather than
half understood, MuJoCo's defaults for classes of elements among it. What surrounds the arm (the
world's geoms, lights, cameras, actuators, sensors, options) is no part of it and passes.
"""

import functools
import importlib.resources
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable

import numpy as np
from numpy.typing import DTypeLike
from scipy.spatial.transform import Rotation

from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.errors import ArgumentError
from planner_jax.host.files import open_plain
from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_ik import misfit

_AROUND = {"option", "visual", "statistic", "size", "asset", "actuator", "sensor", "contact"}
_SEEN = {"light", "camera", "site"}  # in a body, and no part of the arm
_FRAME = {"name", "pos", "quat", "euler"}
_LOOK = {"rgba", "group", "material"}


@functools.cache
def irb1600() -> Arm:
    """Return the ABB IRB 1600-6/1.2 with a shield of 0.30 m, leaves NumPy float32.

    The file `models/irb1600.xml` names the sources of its numbers.
    """
    models = importlib.resources.files("planner_jax.robot") / "models"
    return read_arm((models / "irb1600.xml").read_text("utf-8"))


def read_arm(path_or_xml: str, *, dtype: DTypeLike = np.float32) -> Arm:
    """Return the arm of an MJCF file, or of MJCF text, with NumPy leaves.

    Its base frame is that of the base body, wherever in the world that stands.

    Args:
        path_or_xml: the path of a file, or text that begins with "<".
        dtype: of every leaf.

    Raises:
        ValueError: the text is no XML, an element is not understood, the arm is no chain of six
            hinge joints, or inverse kinematics has no closed form for it; one line that names
            the element.
        OSError: the file cannot be read.
    """
    text = path_or_xml
    try:
        if not text.lstrip().startswith("<"):
            with open_plain(text) as file:
                text = file.read().decode("utf-8-sig")
        root = ET.fromstring(text)
    except (ET.ParseError, UnicodeDecodeError) as error:
        raise ArgumentError("MJCF", f"well-formed XML: {error}", shown="") from None
    _only(root, {"model"}, {"compiler", "worldbody", "keyframe", *_AROUND})
    reader = _Reader(root)
    base, links = _chain(_one(root, "worldbody"))
    frames = [reader.frame(link) for link in links]
    joints = [reader.joint(_one(link, "joint")) for link in links]
    inertials = [reader.inertial(_one(link, "inertial")) for link in links]
    shield, shield_centre, shield_half = _shield(links[5])
    box, base_box = _base_box(base)
    shapes = [
        (k, *reader.capsule(geom))
        for k, body in enumerate((base, *links), start=-1)
        for geom in body.findall("geom")
        if geom is not shield and geom is not box
    ]
    leaves = {
        "origin": [origin for origin, _ in frames],
        "turn": [turn.as_quat(canonical=True, scalar_first=True) for _, turn in frames],
        "axis": [axis for axis, _ in joints],
        "lower": [limits[0] for _, limits in joints],
        "upper": [limits[1] for _, limits in joints],
        "home": _home(root, np.array([limits for _, limits in joints])),
        "mass": [mass for mass, _, _ in inertials],
        "centre": [centre for _, centre, _ in inertials],
        "inertia": [inertia for _, _, inertia in inertials],
        "capsule_ends": np.reshape([ends for _, ends, _ in shapes], (-1, 2, 3)),
        "capsule_radius": [radius for _, _, radius in shapes],
        "base_box": base_box,
        "shield_centre": shield_centre,
        "shield_half": shield_half,
    }
    arrays = {name: host_leaf(leaf, dtype) for name, leaf in leaves.items()}
    arm = Arm(**arrays, capsule_link=tuple(k for k, _, _ in shapes))
    reason = misfit(arm)
    if reason is not None:
        raise ValueError(f"inverse kinematics has no closed form for this arm: {reason}")
    return arm


class _Reader:
    """Places, joints, inertials and capsules, by the units that the file's compiler is told."""

    def __init__(self, root: ET.Element) -> None:
        told: dict[str, str] = {}
        for compiler in root.findall("compiler"):
            _only(compiler, {"angle", "eulerseq"}, ())
            told |= compiler.attrib
        angle, self.sequence = told.get("angle", "degree"), told.get("eulerseq", "xyz")
        if angle not in ("degree", "radian"):
            raise ArgumentError("<compiler>: angle", "degree or radian", shown=f'"{angle}"')
        if not re.fullmatch("[xyz]{3}|[XYZ]{3}", self.sequence):
            raise ArgumentError(
                "<compiler>: eulerseq", "three of xyz or of XYZ", shown=f'"{self.sequence}"'
            )
        self.unit = np.pi / 180.0 if angle == "degree" else 1.0

    def frame(self, element: ET.Element) -> tuple[np.ndarray, Rotation]:
        """Return position (3,) [m] and attitude of an element in its body's or parent's frame."""
        place = _numbers(element, "pos", 3, (0.0, 0.0, 0.0))
        if "quat" in element.attrib and "euler" in element.attrib:
            raise ArgumentError(_tag(element), "quat or euler, not both", verb="have", shown="")
        if "euler" in element.attrib:
            angles = self.unit * _numbers(element, "euler", 3)
            # Small letters turn with the frame here, and stand still in SciPy.
            return place, Rotation.from_euler(self.sequence.swapcase(), angles)
        quaternion = _numbers(element, "quat", 4, (1.0, 0.0, 0.0, 0.0))
        if not np.any(quaternion):
            raise ArgumentError(f"{_tag(element)}: quat", "zero", verb="not be", shown="")
        return place, Rotation.from_quat(quaternion, scalar_first=True)

    def joint(self, joint: ET.Element) -> tuple[np.ndarray, np.ndarray]:
        """Return axis (3,) and position limits (2,) [rad] of a hinge joint."""
        _only(joint, {"name", "type", "pos", "axis", "range", "limited"}, ())
        if np.any(_numbers(joint, "pos", 3, (0.0, 0.0, 0.0))):
            raise ArgumentError(f"{_tag(joint)}: pos", "0 0 0, where its link's frame is", shown="")
        if joint.get("limited", "auto") not in ("auto", "true"):
            raise ArgumentError(_tag(joint), "limited", shown="")
        limits = self.unit * _numbers(joint, "range", 2)
        if not limits[0] < limits[1]:
            raise ValueError(f"{_tag(joint)}: range must rise")
        axis = _numbers(joint, "axis", 3, (0.0, 0.0, 1.0))
        if not np.any(axis):
            raise ArgumentError(f"{_tag(joint)}: axis", "zero", verb="not be", shown="")
        return axis / np.linalg.norm(axis), limits

    def inertial(self, inertial: ET.Element) -> tuple[float, np.ndarray, np.ndarray]:
        """Return mass [kg], its centre (3,) [m] and inertia (3, 3) [kg m^2] along the axes."""
        full = "fullinertia" in inertial.attrib
        how = {"fullinertia"} if full else {"diaginertia", "quat", "euler"}
        _only(inertial, {"pos", "mass", *how}, ())
        (mass,), centre = _numbers(inertial, "mass", 1), _numbers(inertial, "pos", 3)
        if full:
            xx, yy, zz, xy, xz, yz = _numbers(inertial, "fullinertia", 6)
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        else:
            axes = self.frame(inertial)[1].as_matrix()
            inertia = axes * _numbers(inertial, "diaginertia", 3) @ axes.T
        if not mass > 0.0 or not np.all(np.linalg.eigvalsh(inertia) > 0.0):
            raise ArgumentError(f"{_tag(inertial)}: mass and inertia", "positive", shown="")
        return mass, centre, inertia

    def capsule(self, geom: ET.Element) -> tuple[np.ndarray, float]:
        """Return ends (2, 3) [m] and radius [m] of a capsule; a sphere's ends are one point."""
        kind = geom.get("type", "sphere")
        if kind not in ("capsule", "sphere"):
            raise ArgumentError(_tag(geom), "a capsule or a sphere", shown="")
        if kind == "capsule" and "fromto" in geom.attrib:
            _only(geom, {"name", "type", "size", "fromto", *_LOOK}, ())
            ends = _numbers(geom, "fromto", 6).reshape(2, 3)
            (radius,) = _numbers(geom, "size", 1)
        else:
            _only(geom, {"type", "size", *_FRAME, *_LOOK}, ())
            radius, half = (*_numbers(geom, "size", 1 if kind == "sphere" else 2), 0.0)[:2]
            place, turn = self.frame(geom)
            ends = place + np.outer([-half, half], turn.as_matrix()[:, 2])
        if not radius > 0.0:
            raise ArgumentError(f"{_tag(geom)}: its radius", "> 0", shown="")
        return ends, radius


def _chain(world: ET.Element) -> tuple[ET.Element, list[ET.Element]]:
    """Return the base and the six links, each of them with one hinge joint."""
    _only(world, set(), {"body", "geom", *_SEEN})
    body = base = _one(world, "body")
    _only(base, _FRAME, {"body", "geom", *_SEEN})
    links = []
    while body.find("body") is not None:
        body = _one(body, "body")
        _only(body, _FRAME, {"body", "joint", "inertial", "geom", *_SEEN})
        links.append(body)
    kinds = [[joint.get("type", "hinge") for joint in link.findall("joint")] for link in links]
    if kinds != [["hinge"]] * 6:
        counted = ", ".join("+".join(each) or "none" for each in kinds) or "no links"
        rule = "six links with one hinge joint each"
        raise ArgumentError("an arm", rule, verb="have", shown=counted)
    return base, links


def _shield(link: ET.Element) -> tuple[ET.Element, np.ndarray, float]:
    """Return the shield's geom, the middle (3,) [m] of its front face and half [m] of its edge."""
    geom, site = (
        next((each for each in link.findall(tag) if each.get("name") == "shield"), None)
        for tag in ("geom", "site")
    )
    if geom is None or site is None:
        raise ArgumentError(_tag(link), "a geom and a site named shield", verb="have", shown="")
    _only(site, {"name", "pos", "type", "size", *_LOOK}, ())
    (thick, half, other), place = _box(geom)
    if half != other:
        raise ArgumentError(_tag(geom), "square across x", shown="")
    front = place + [thick, 0.0, 0.0]
    middle = _numbers(site, "pos", 3, (0.0, 0.0, 0.0))
    if not np.allclose(middle, front, rtol=0.0, atol=1e-6):
        raise ArgumentError(
            f"{_tag(site)}: pos", "the middle of the shield's face along +x", shown=""
        )
    return geom, middle, half


def _base_box(base: ET.Element) -> tuple[ET.Element, np.ndarray]:
    """Return the base's box as a geom, and its lowest and highest corner (2, 3) [m]."""
    boxes = [geom for geom in base.findall("geom") if geom.get("type") == "box"]
    if len(boxes) != 1:
        raise ArgumentError(_tag(base), "one box", len(boxes), verb="have")
    half, place = _box(boxes[0])
    return boxes[0], np.stack([place - half, place + half])


def _box(geom: ET.Element) -> tuple[np.ndarray, np.ndarray]:
    """Return half the edges (3,) [m] and the middle (3,) [m] of a box along its body's axes."""
    _only(geom, {"name", "type", "pos", "size", *_LOOK}, ())
    if geom.get("type") != "box":
        raise ArgumentError(_tag(geom), "a box", shown="")
    half = _numbers(geom, "size", 3)
    if not np.all(half > 0.0):
        raise ArgumentError(f"{_tag(geom)}: size", "> 0", shown="")
    return half, _numbers(geom, "pos", 3, (0.0, 0.0, 0.0))


def _home(root: ET.Element, limits: np.ndarray) -> np.ndarray:
    """Return angles (6,) [rad] of the key named home, within position limits (6, 2) [rad]."""
    for key in root.iterfind("keyframe/key"):
        if key.get("name") == "home":
            home = _numbers(key, "qpos", 6)
            if np.any((home < limits[:, 0]) | (home > limits[:, 1])):
                raise ArgumentError(
                    f"{_tag(key)}: qpos", "within the ranges of the joints", shown=""
                )
            return home
    raise ArgumentError("<keyframe>", "a key named home", verb="have", shown="")


def _tag(element: ET.Element) -> str:
    """Return an element as it is written, without its children, for messages."""
    written = [f'{name}="{value}"' for name, value in element.items()]
    return f"<{' '.join([element.tag, *written])}>"


def _only(element: ET.Element, attributes: set[str], children: Iterable[str]) -> None:
    """Raise `ValueError` where an element has something else than what is understood."""
    for name in element.keys():
        if name not in attributes:
            raise ValueError(f"{_tag(element)}: {name} is not understood")
    for child in element:
        if child.tag not in children:
            raise ValueError(f"{_tag(child)} in {_tag(element)} is not understood")


def _one(element: ET.Element, tag: str) -> ET.Element:
    """Return the one child of a tag."""
    found = element.findall(tag)
    if len(found) != 1:
        raise ArgumentError(_tag(element), f"one <{tag}>", len(found), verb="have")
    return found[0]


def _numbers(
    element: ET.Element, attribute: str, count: int, default: tuple[float, ...] | None = None
) -> np.ndarray:
    """Return an attribute's numbers (count,); a default of None means that it must be there."""
    text = element.get(attribute)
    if text is None and default is not None:
        return np.array(default)
    try:
        numbers = np.array((text or "").split(), float)
    except ValueError:
        numbers = np.array([])
    if numbers.shape != (count,) or not np.all(np.isfinite(numbers)):
        raise ArgumentError(f"{_tag(element)}: {attribute}", f"{count} finite number(s)", shown="")
    return numbers
