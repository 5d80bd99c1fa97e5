"""Reader of arms in MuJoCo's model format, MJCF; it does not need MuJoCo.

The file must have the structure of `models/irb1600.xml`. A static base body contains one box and a
chain of six bodies. Each of the six bodies has one hinge joint, an inertial, and any number of
capsules and spheres. The sixth body also has a square box and a site, both named shield; the site
is at the middle of the box's face along +x. A key named home holds the angles at which the arm
waits. Any other element inside the arm is an error, including MuJoCo's defaults for classes of
elements. Elements around the arm, such as lights, cameras, actuators and sensors, are ignored.
"""

import dataclasses
import functools
import importlib.resources
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable

import jax
import numpy as np
from numpy.typing import DTypeLike
from scipy.spatial.transform import Rotation

from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.host.files import open_plain
from planner_jax.robot.arm import REGIMES, Arm
from planner_jax.robot.arm_ik import choose_ik

# Elements that the reader ignores: at the top of the file (`_AROUND`) and in a body (`_IGNORED`).
_AROUND = {"option", "visual", "statistic", "size", "asset", "actuator", "sensor", "contact"}
_IGNORED = {"light", "camera", "site"}
_FRAME = {"name", "pos", "quat", "euler"}
_APPEARANCE = {"rgba", "group", "material"}
_ORIGIN = (0.0, 0.0, 0.0)
_FORK = 0.71  # see `_beside_shield`


@functools.cache
def irb1600() -> Arm:
    """Return the arm ABB IRB 1600-6/1.2 with a square shield of 0.30 m (`models/irb1600.xml`)."""
    models = importlib.resources.files("planner_jax.robot") / "models"
    return read_arm((models / "irb1600.xml").read_text("utf-8"))


def read_arm(path_or_xml: str, *, dtype: DTypeLike = np.float32) -> Arm:
    """Read an arm from an MJCF file, or from MJCF text; its leaves are NumPy arrays.

    The arm's base frame is the frame of the base body, whose pose in the world is ignored.

    Args:
        path_or_xml: path of a file, or text that begins with "<".
        dtype: type of every leaf.

    Raises:
        ValueError: the text is not XML, an element is not supported, or the arm is not a chain of
            six hinge joints. The message is one line that names the element.
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
    _require_known(root, {"model"}, {"compiler", "worldbody", "keyframe", *_AROUND})
    reader = _Reader(root)
    base, links = _chain(_one(root, "worldbody"))
    origin, turns = zip(*(reader.frame(link) for link in links), strict=True)
    axis, limits = zip(*(reader.joint(_one(link, "joint")) for link in links), strict=True)
    inertials = (reader.inertial(_one(link, "inertial")) for link in links)
    mass, centre, inertia = zip(*inertials, strict=True)
    shield, shield_centre, shield_half = _shield(links[5])
    box, base_box = _base_box(base)
    shapes = [
        (k, *reader.capsule(geom))
        for k, body in enumerate((base, *links), start=-1)
        for geom in body.findall("geom")
        if geom is not shield and geom is not box
    ]
    leaves = {
        "origin": origin,
        "axis": axis,
        "mass": mass,
        "centre": centre,
        "inertia": inertia,
        "turn": [turn.as_quat(canonical=True, scalar_first=True) for turn in turns],
        "lower": np.array(limits)[:, 0],
        "upper": np.array(limits)[:, 1],
        "home": _home(root, np.array(limits)),
        "capsule_ends": np.reshape([ends for _, ends, _ in shapes], (-1, 2, 3)),
        "capsule_radius": [radius for _, _, radius in shapes],
        "base_box": base_box,
        "shield_centre": shield_centre,
        "shield_turn": (1.0, 0.0, 0.0, 0.0),
        "shield_half": (shield_half, shield_half),
    }
    leaves["shield_gap_radius"] = _beside_shield(leaves, [k for k, _, _ in shapes])
    arrays = {name: host_leaf(leaf, dtype) for name, leaf in leaves.items()}
    link = tuple(k for k, _, _ in shapes)
    every, numbered = range(len(link)), enumerate(links, start=1)
    arm = Arm(
        **arrays,
        limits=jax.tree.map(lambda leaf: host_leaf(leaf, dtype), REGIMES["R2"].limits),
        capsule_link=link,
        pairs=tuple((k, j) for k in every for j in every if link[k] >= 2 and link[j] == 0),
        shield_pairs=tuple(k for k in every if 0 <= link[k] <= 3),
        base_pairs=tuple(k for k in every if link[k] >= 1),
        joint_names=tuple(_one(link, "joint").get("name", f"joint_{k}") for k, link in numbered),
        turns_in_plane=True,
        ik="numerical",
    )
    return dataclasses.replace(arm, ik=choose_ik(arm))


def _beside_shield(leaves: dict, links: list[int]) -> np.ndarray:
    """Return the radii (C,) [m] of the capsules in their distances from the shield.

    The forearm, link 4, ends in a fork around the wrist, and its capsule extends beyond the fork.
    The capsule's radius is therefore reduced to a fraction of the distance between the wrist and
    the shield's face.
    """
    radius = np.array(leaves["capsule_radius"], float)
    wrist = np.linalg.norm(np.add(leaves["origin"][5], leaves["shield_centre"]))
    return np.where(np.equal(links, 3), np.minimum(radius, _FORK * wrist), radius)


class _Reader:
    """Parser of the elements of one MJCF file, by the units and conventions that it declares."""

    def __init__(self, root: ET.Element) -> None:
        options: dict[str, str] = {}
        for compiler in root.findall("compiler"):
            _require_known(compiler, {"angle", "eulerseq"}, ())
            options |= compiler.attrib
        angle, self.sequence = options.get("angle", "degree"), options.get("eulerseq", "xyz")
        known, name = ("degree", "radian"), "<compiler>: eulerseq"
        require(angle in known, "<compiler>: angle", " or ".join(known), shown=f'"{angle}"')
        is_sequence = re.fullmatch("[xyz]{3}|[XYZ]{3}", self.sequence) is not None
        require(is_sequence, name, "three of xyz or of XYZ", shown=f'"{self.sequence}"')
        self.unit = np.pi / 180.0 if angle == "degree" else 1.0

    def frame(self, element: ET.Element) -> tuple[np.ndarray, Rotation]:
        """Return the position (3,) [m] and rotation of an element relative to its parent body."""
        position = _numbers(element, "pos", 3, _ORIGIN)
        if "quat" in element.attrib and "euler" in element.attrib:
            raise ArgumentError(_tag(element), "quat or euler, not both", verb="have", shown="")
        if "euler" in element.attrib:
            angles = self.unit * _numbers(element, "euler", 3)
            # In MJCF lower-case letters are axes that rotate with the frame. In SciPy they are
            # fixed axes, and upper-case letters are axes that rotate with the frame.
            return position, Rotation.from_euler(self.sequence.swapcase(), angles)
        quaternion = _numbers(element, "quat", 4, (1.0, 0.0, 0.0, 0.0))
        _require(np.any(quaternion), element, "other than zero", "quat")
        return position, Rotation.from_quat(quaternion, scalar_first=True)

    def joint(self, joint: ET.Element) -> tuple[np.ndarray, np.ndarray]:
        """Return the axis (3,) and the position limits (2,) [rad] of a hinge joint."""
        _require_known(joint, {"name", "type", "pos", "axis", "range", "limited"}, ())
        at_origin = not np.any(_numbers(joint, "pos", 3, _ORIGIN))
        _require(at_origin, joint, "0 0 0, the origin of its link's frame", "pos")
        _require(joint.get("limited", "auto") in ("auto", "true"), joint, "limited")
        limits = self.unit * _numbers(joint, "range", 2)
        _require(limits[0] < limits[1], joint, "in ascending order", "range")
        axis = _numbers(joint, "axis", 3, (0.0, 0.0, 1.0))
        _require(np.any(axis), joint, "other than zero", "axis")
        return axis / np.linalg.norm(axis), limits

    def inertial(self, inertial: ET.Element) -> tuple[float, np.ndarray, np.ndarray]:
        """Return mass [kg], centre of mass (3,) [m] and inertia (3, 3) [kg m^2] of a link."""
        full = "fullinertia" in inertial.attrib
        attributes = {"fullinertia"} if full else {"diaginertia", "quat", "euler"}
        _require_known(inertial, {"pos", "mass", *attributes}, ())
        (mass,), centre = _numbers(inertial, "mass", 1), _numbers(inertial, "pos", 3)
        if full:
            xx, yy, zz, xy, xz, yz = _numbers(inertial, "fullinertia", 6)
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        else:
            axes = self.frame(inertial)[1].as_matrix()
            inertia = axes * _numbers(inertial, "diaginertia", 3) @ axes.T
        is_body = mass > 0.0 and np.all(np.linalg.eigvalsh(inertia) > 0.0)
        _require(is_body, inertial, "positive", "mass and inertia")
        return mass, centre, inertia

    def capsule(self, geom: ET.Element) -> tuple[np.ndarray, float]:
        """Return ends (2, 3) [m] and radius [m] of a capsule; the ends of a sphere coincide."""
        kind = geom.get("type", "sphere")
        _require(kind in ("capsule", "sphere"), geom, "a capsule or a sphere")
        if kind == "capsule" and "fromto" in geom.attrib:
            _require_known(geom, {"name", "type", "size", "fromto", *_APPEARANCE}, ())
            ends = _numbers(geom, "fromto", 6).reshape(2, 3)
            (radius,) = _numbers(geom, "size", 1)
        else:
            _require_known(geom, {"type", "size", *_FRAME, *_APPEARANCE}, ())
            radius, half = (*_numbers(geom, "size", 1 if kind == "sphere" else 2), 0.0)[:2]
            position, turn = self.frame(geom)
            ends = position + np.outer([-half, half], turn.as_matrix()[:, 2])
        _require(radius > 0.0, geom, "> 0", "its radius")
        return ends, radius


def _chain(world: ET.Element) -> tuple[ET.Element, list[ET.Element]]:
    """Return the base body and the six bodies of the links; raise for any other structure."""
    _require_known(world, set(), {"body", "geom", *_IGNORED})
    body = base = _one(world, "body")
    _require_known(base, _FRAME, {"body", "geom", *_IGNORED})
    links = []
    while body.find("body") is not None:
        body = _one(body, "body")
        _require_known(body, _FRAME, {"body", "joint", "inertial", "geom", *_IGNORED})
        links.append(body)
    kinds = [[joint.get("type", "hinge") for joint in link.findall("joint")] for link in links]
    if kinds != [["hinge"]] * 6:
        shown = ", ".join("+".join(each) or "none" for each in kinds) or "no links"
        rule = "six links with one hinge joint each"
        raise ArgumentError("an arm", rule, verb="have", shown=shown)
    return base, links


def _shield(link: ET.Element) -> tuple[ET.Element, np.ndarray, float]:
    """Return the shield's geom, the middle (3,) [m] of its front face, and half its edge [m]."""
    geom, site = (
        next((each for each in link.findall(tag) if each.get("name") == "shield"), None)
        for tag in ("geom", "site")
    )
    if geom is None or site is None:
        raise ArgumentError(_tag(link), "a geom and a site named shield", verb="have", shown="")
    _require_known(site, {"name", "pos", "type", "size", *_APPEARANCE}, ())
    (thick, half, other), centre = _box(geom)
    _require(half == other, geom, "square across x")
    middle = _numbers(site, "pos", 3, _ORIGIN)
    is_front = np.allclose(middle, centre + [thick, 0.0, 0.0], rtol=0.0, atol=1e-6)
    _require(is_front, site, "the middle of the shield's face along +x", "pos")
    return geom, middle, half


def _base_box(base: ET.Element) -> tuple[ET.Element, np.ndarray]:
    """Return the box of the base body, and the box's lowest and highest corner (2, 3) [m]."""
    boxes = [geom for geom in base.findall("geom") if geom.get("type") == "box"]
    if len(boxes) != 1:
        raise ArgumentError(_tag(base), "one box", len(boxes), verb="have")
    half, centre = _box(boxes[0])
    return boxes[0], np.stack([centre - half, centre + half])


def _box(geom: ET.Element) -> tuple[np.ndarray, np.ndarray]:
    """Return half edges (3,) [m] and centre (3,) [m] of a box geom that is not rotated."""
    _require_known(geom, {"name", "type", "pos", "size", *_APPEARANCE}, ())
    _require(geom.get("type") == "box", geom, "a box")
    half = _numbers(geom, "size", 3)
    _require(np.all(half > 0.0), geom, "> 0", "size")
    return half, _numbers(geom, "pos", 3, _ORIGIN)


def _home(root: ET.Element, limits: np.ndarray) -> np.ndarray:
    """Return the joint angles (6,) [rad] of the key named home; raise unless within the limits."""
    for key in root.iterfind("keyframe/key"):
        if key.get("name") == "home":
            home = _numbers(key, "qpos", 6)
            is_within = np.all((home >= limits[:, 0]) & (home <= limits[:, 1]))
            _require(is_within, key, "within the ranges of the joints", "qpos")
            return home
    raise ArgumentError("<keyframe>", "a key named home", verb="have", shown="")


def _tag(element: ET.Element) -> str:
    attributes = [f'{name}="{value}"' for name, value in element.items()]
    return f"<{' '.join([element.tag, *attributes])}>"


def _require(holds: object, element: ET.Element, rule: str, attribute: str = "") -> None:
    """Raise `ArgumentError` that names an element, or an attribute of it, unless `holds`."""
    require(bool(holds), f"{_tag(element)}{attribute and f': {attribute}'}", rule, shown="")


def _require_known(element: ET.Element, attributes: set[str], children: Iterable[str]) -> None:
    for name in element.keys():
        if name not in attributes:
            raise ValueError(f"{_tag(element)}: {name} is not supported")
    for child in element:
        if child.tag not in children:
            raise ValueError(f"{_tag(child)} in {_tag(element)} is not supported")


def _one(element: ET.Element, tag: str) -> ET.Element:
    children = element.findall(tag)
    if len(children) != 1:
        raise ArgumentError(_tag(element), f"one <{tag}>", len(children), verb="have")
    return children[0]


def _numbers(
    element: ET.Element, attribute: str, count: int, default: tuple[float, ...] | None = None
) -> np.ndarray:
    """Return the numbers (count,) of an attribute; without a default the attribute must exist."""
    text = element.get(attribute)
    if text is None and default is not None:
        return np.array(default)
    try:
        numbers = np.array((text or "").split(), float)
    except ValueError:
        numbers = np.array([])
    is_sound = numbers.shape == (count,) and np.all(np.isfinite(numbers))
    _require(is_sound, element, f"{count} finite number(s)", attribute)
    return numbers
