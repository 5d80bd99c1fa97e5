"""The chain of hinge joints in an arm's file, MJCF or URDF, as MuJoCo's compiler reads the file."""

import importlib
import itertools
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from planner_jax.core.errors import ArgumentError
from planner_jax.robot.arm_text import ArmText
from planner_jax.robot.capsule_fit import Cover, ball_points, prism_points

COUNTS = (6, 7)  # numbers of hinges that a chain may have
DENSITY = 1000.0  # [kg/m^3], of geoms whose file states neither mass nor density
BASE, OUTSIDE = -1, -2  # indices of the base and of other bodies; links 1 to n are 0 to n - 1

Frame = tuple[np.ndarray, np.ndarray]  # position (3,) [m] of the origin, and rotation (3, 3)


class ArmModel:
    """An arm's file, compiled by MuJoCo, and the chain of n hinges that is the arm.

    A body without a joint of the chain belongs to the link that carries it. Joints behind the chain
    stay at their home positions. The frame of a link is at its joint, with the axes of its body.
    """

    def __init__(self, path: str | os.PathLike, tip: str | None) -> None:
        """Read the file, or the text of a file, which begins with "<"."""
        self.source = ArmText(path)
        self.path, self.name, self.error = self.source.path, self.source.name, self.source.error
        # `weighed` has the bodies whose masses the file does not state.
        self.mujoco, self.model, self.weighed = _compile(self.source)
        model = self.model
        bodies = self._follow(tip)
        joints = [j for body in bodies for j in self._joints_of(body)]
        self.joints = self._require_hinges(joints, has_tip=tip is not None)
        self.num = len(self.joints)
        names = [model.joint(j).name or f"joint_{k + 1}" for k, j in enumerate(self.joints)]
        self.joint_names = tuple(names)
        moving = model.jnt_bodyid[self.joints].tolist()
        self.link_names = [model.body(b).name or f"link_{k + 1}" for k, b in enumerate(moving)]
        root = bodies[1]  # the base frame is the frame of this body, unless the body moves
        if root not in moving:
            model.body_pos[root], model.body_quat[root] = 0.0, (1.0, 0.0, 0.0, 0.0)
        self.link = np.full(model.nbody, OUTSIDE)  # index of the link of each body
        for body in range(1, model.nbody):
            self.link[body] = BASE if body == root else self.link[model.body_parentid[body]]
            if body in moving:  # the last of several hinges of a body
                self.link[body] = self.num - 1 - moving[::-1].index(body)
        keys = [k for k in range(model.nkey) if model.key(k).name == "home" or model.nkey == 1]
        self._key = model.key_qpos[keys[0]] if keys else None
        self._data = self.mujoco.MjData(model)  # in the pose in which all angles are 0
        self.zero = self.frames(np.zeros(self.num), self._data)
        self.tip = self.pose_of(
            *(self._find_tip(tip)[:2] if tip else ("body", moving[-1])), self.num - 1
        )
        _require_open(self)

    def pose_of(self, kind: str, index: int, link: int) -> tuple[np.ndarray, np.ndarray]:
        """Return position (3,) [m] and rotation (3, 3) of an element in the frame of a link."""
        prefix = {"body": "x", "inertia": "xi", "site": "site_x", "geom": "geom_x"}[kind]
        position = getattr(self._data, f"{prefix}pos")[index]
        rotation = getattr(self._data, f"{prefix}mat")[index].reshape(3, 3)
        origin, turn = self.zero[link] if link != BASE else (np.zeros(3), np.eye(3))
        return turn.T @ (position - origin), turn.T @ rotation

    def frames(self, angles: np.ndarray, data: Any = None) -> list[Frame]:
        """Return the frames of the links at joint angles (n,) [rad]."""
        model = self.model
        data = self.mujoco.MjData(model) if data is None else data
        data.qpos[:] = model.qpos0 if self._key is None else self._key
        data.qpos[model.jnt_qposadr[self.joints]] = angles
        self.mujoco.mj_kinematics(model, data)
        bodies = model.jnt_bodyid[self.joints]
        return [
            (data.xanchor[j].copy(), data.xmat[body].reshape(3, 3).copy())
            for j, body in zip(self.joints, bodies, strict=True)
        ]

    def axis(self, k: int) -> np.ndarray:
        """Return the unit vector (3,) along the axis of joint k in the frame of link k."""
        axis = self.model.jnt_axis[self.joints[k]]
        return axis / np.linalg.norm(axis)

    def home(
        self, home: Iterable[float] | None, lower: np.ndarray, upper: np.ndarray
    ) -> tuple[np.ndarray, str]:
        """Return the home angles (n,) [rad] and where they are from; raise unless within limits."""
        if home is not None:
            angles, source = np.array([*home], float), "the argument home"
        elif self._key is not None:
            angles, source = self._key[self.model.jnt_qposadr[self.joints]], "the key of the file"
        else:
            angles, source = np.clip(0.0, lower, upper), "the angles nearest to 0"
        is_within = angles.shape == lower.shape and np.all((angles >= lower) & (angles <= upper))
        if not is_within:
            rule = f"{self.num} angles within the limits; correct them, or pass home="
            raise self.error("home", rule, shown=np.array2string(angles, precision=4))
        return angles, source

    def bodies(self, k: int) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """Return mass [kg], centre (3,) [m], inertia (3, 3) [kg m^2] of the bodies of link k.

        The inertias are about the centres. All are in the frame of link k.
        """
        model, bodies = self.model, []
        for body in np.flatnonzero(self.link == k).tolist():
            centre, turn = self.pose_of("inertia", body, k)
            bodies.append((model.body_mass[body], centre, turn * model.body_inertia[body] @ turn.T))
        return bodies

    def solids(self) -> list[int]:
        """Return the arm's collision geoms: all that can touch others, else group 3, else all."""
        model = self.model
        geoms = [k for k in range(model.ngeom) if self.link[model.geom_bodyid[k]] != OUTSIDE]
        solids = [k for k in geoms if model.geom_contype[k] or model.geom_conaffinity[k]]
        return solids or [k for k in geoms if model.geom_group[k] == 3] or geoms

    def shape(self, geom: int) -> Cover | np.ndarray:
        """Return the capsule that a geom is, or else the corners (V, 3) [m] of the geom's hull.

        The frame is the frame of the geom's link.
        """
        link = int(self.link[self.model.geom_bodyid[geom]])
        model, kinds = self.model, self.mujoco.mjtGeom
        kind, size = kinds(model.geom_type[geom]), model.geom_size[geom]
        origin, turn = self.pose_of("geom", geom, link)
        if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE):
            half = size[1] if kind == kinds.mjGEOM_CAPSULE else 0.0
            ends = origin + np.outer([half, -half], turn[:, 2])  # in the order of `fromto`
            return Cover(ends[None], size[:1].copy())
        if kind == kinds.mjGEOM_MESH:
            mesh = int(model.geom_dataid[geom])
            start, num = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            corners = model.mesh_vert[start : start + num].astype(float)
        elif kind == kinds.mjGEOM_BOX:
            corners = np.array([*itertools.product((-1.0, 1.0), repeat=3)]) * size
        elif kind == kinds.mjGEOM_CYLINDER:
            corners = prism_points() * size[[0, 0, 1]]
        elif kind == kinds.mjGEOM_ELLIPSOID:
            corners = ball_points() * size
        else:
            name = kind.name[len("mjGEOM_") :].lower()
            element = f'geom "{model.geom(geom).name or geom}"'
            rule = "a sphere, capsule, cylinder, box, ellipsoid or mesh; replace it"
            raise self.error(element, rule, "be", name)
        return origin + corners @ turn.T

    def torque(self, joint: int) -> float:
        """Return the greatest torque [N m] of a joint and of its actuator, infinite if unknown.

        The torque is 0 if the joint can be driven in one direction only.
        """
        model = self.model
        ranges = [model.jnt_actfrcrange[joint]] if model.jnt_actfrclimited[joint] else []
        for k in range(model.nu):
            of_joint = model.actuator_trntype[k] == self.mujoco.mjtTrn.mjTRN_JOINT
            if of_joint and model.actuator_trnid[k, 0] == joint and model.actuator_forcelimited[k]:
                ranges.append(model.actuator_forcerange[k] * model.actuator_gear[k, 0])
        # A range of zeros states no limit.
        torques = [min(-least, most) for least, most in map(sorted, ranges) if least or most]
        return max(min(torques, default=math.inf), 0.0)

    def _joints_of(self, body: int) -> list[int]:
        first, count = int(self.model.body_jntadr[body]), int(self.model.body_jntnum[body])
        return list(range(first, first + count))

    def _follow(self, tip: str | None) -> list[int]:
        """Return the bodies from the world to the tip, or to where the chain branches or ends."""
        model, parents = self.model, self.model.body_parentid.tolist()
        if tip is not None:
            bodies = [self._find_tip(tip)[2]]
            while bodies[0]:
                bodies.insert(0, parents[bodies[0]])
            return bodies
        hinge = self.mujoco.mjtJoint.mjJNT_HINGE
        bodies_of = [model.jnt_bodyid[model.jnt_type == hinge], model.jnt_bodyid]
        hinges, moving = (np.bincount(each, minlength=model.nbody) for each in bodies_of)
        for body in range(model.nbody - 1, 0, -1):
            for count in (hinges, moving):
                count[parents[body]] += count[body]
        path, num = [0], 0
        while True:
            above = [b for b in range(1, model.nbody) if parents[b] == path[-1] and moving[b]]
            if path == [0]:  # leave out things beside the arm that move, such as a ball or a door
                least = min(COUNTS[0], max((hinges[b] for b in above), default=0))
                above = [b for b in above if hinges[b] >= least]
            if len(above) > 1 and num < COUNTS[0]:
                names = ", ".join(model.body(b).name or f"body {b}" for b in above)
                rule = "one chain of hinges; name the end of the arm by tip="
                raise self.error(f"body {model.body(path[-1]).name}", rule, "carry", names)
            if len(above) != 1:
                return path
            path.append(above[0])
            num += len(self._joints_of(above[0]))

    def _require_hinges(self, joints: list[int], has_tip: bool) -> list[int]:
        """Return the chain's hinges in front of a gripper; raise unless there are six or seven."""
        model, hinge = self.model, self.mujoco.mjtJoint.mjJNT_HINGE
        others = [k for k, j in enumerate(joints) if model.jnt_type[j] != hinge]
        if others and (has_tip or others[0] not in COUNTS):
            kind = self.mujoco.mjtJoint(model.jnt_type[joints[others[0]]]).name[len("mjJNT_") :]
            element = f'joint "{model.joint(joints[others[0]]).name}"'
            rule = "a hinge; weld it, or name the end of the arm before it by tip="
            raise self.error(element, rule, "be", kind.lower())
        joints = joints[: others[0]] if others else joints
        if len(joints) not in COUNTS:
            names = ", ".join(model.joint(j).name or f"joint {j}" for j in joints) or "none"
            rule = "6 or 7 hinges in a chain; name the end of the arm by tip="
            raise self.error("the arm", rule, shown=f"{len(joints)}: {names}")
        return joints

    def _find_tip(self, tip: str) -> tuple[str, int, int]:
        """Return the kind "site" or "body" of the tip, its index, and the index of its body."""
        model = self.model
        for k in range(model.nsite):
            if model.site(k).name == tip:
                return "site", k, int(model.site_bodyid[k])
        names = [model.body(k).name for k in range(model.nbody)]
        if tip not in names[1:]:
            raise self.error(
                "tip", f"a site, or one of the bodies {', '.join(names[1:])}", "be", tip
            )
        return "body", names.index(tip), names.index(tip)


def _has_default_mass(geom: Any) -> bool:
    return math.isnan(geom.mass) and geom.density == DENSITY


def _compile(source: ArmText) -> tuple[Any, Any, set[int]]:
    """Return the module mujoco, the model of a file, and the bodies without masses in the file.

    MuJoCo computes the masses of these bodies by its own density.
    """
    mujoco: Any = importlib.import_module("mujoco")  # slow to import
    try:
        spec = mujoco.MjSpec.from_string(source.text, include=source.includes)
        spec.modelfiledir = "" if source.path is None else str(source.path.absolute().parent)
        spec.compiler.fusestatic = False  # `tip` may name a body without a joint
        for mesh in spec.meshes:
            _locate(source, spec, mesh)
        model = spec.compile()
        weighed = {
            body.id
            for body in spec.bodies
            if not body.explicitinertial and any(map(_has_default_mass, body.geoms))
        }
        return mujoco, model, weighed
    except ArgumentError:
        raise
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise source.error("the model", f"accepted by MuJoCo: {reason}", "be") from None


def _locate(source: ArmText, spec: Any, mesh: Any) -> None:
    """Find the file of a mesh, also if it is named by a package of ROS; raise without one."""
    _, is_packaged, path = mesh.file.rpartition("://")
    if not mesh.file or source.path is None:
        return
    base = Path(spec.modelfiledir)
    if is_packaged:  # the package is a folder around the file, or beside one of them
        around = [base, *base.parents]
        names = (path, path.partition("/")[2])
        places = [folder / name for folder in around for name in names if name]
    else:
        path = Path(path).name if spec.strippath else path
        places = [base / (spec.meshdir or "") / path]
    found = next(filter(os.path.isfile, places), None)
    element = f'mesh "{mesh.name or Path(path).stem}"'
    if found is None:
        raise source.error(element, f"the file {mesh.file}; put it at {places[0]}")
    if is_packaged:
        source.check(element, found)
        mesh.file = str(found)


def _require_open(arm: ArmModel) -> None:
    """Raise an error if a constraint closes the chain of an arm, or couples its joints."""
    model, kinds = arm.model, arm.mujoco.mjtEq
    for k in range(model.neq):
        both, kind = [int(model.eq_obj1id[k]), int(model.eq_obj2id[k])], kinds(model.eq_type[k])
        element = f'equality "{model.eq(k).name or k}"'
        if not model.eq_active0[k]:
            continue
        if kind == kinds.mjEQ_JOINT and set(both) & set(arm.joints):
            rule = "independent joints of the arm; remove it"
            raise arm.error(element, rule, "leave")
        if kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            if model.eq_objtype[k] == arm.mujoco.mjtObj.mjOBJ_SITE:
                both = [int(model.site_bodyid[site]) for site in both]
            links = {BASE if body == 0 else int(arm.link[body]) for body in both}
            if len(links) > 1 and OUTSIDE not in links:
                names = " and ".join(model.body(body).name for body in both)
                rule = f"the chain open, but connects {names}; remove it"
                raise arm.error(element, rule, "leave")
