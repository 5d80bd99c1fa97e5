# Pyright cannot see the names of MuJoCo's compiled module.
# pyright: reportAttributeAccessIssue=false
"""Reader of a quadrotor's mass, inertia and rotors from MJCF, MuJoCo's model format."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from planner_jax.core.errors import ArgumentError
from planner_jax.robot.arm_text import ArmText
from planner_jax.robot.quadrotor_file import RobotError, Value
from planner_jax.robot.quadrotor_model import COUNTS

_Mj = Any  # a structure of MuJoCo, whose package has no types
_SKEW = 0.02  # greatest ignored (product of inertia) / (greatest moment of inertia)
_LAG = 0.02  # [s], of motors without a filter


def describe_mjcf(path: Path, over: Mapping[str, Value]) -> dict[str, Value]:
    """Read a quadrotor from an MJCF file; return it as the fields of a YAML robot file.

    Mass and inertia are the sums of all bodies below the only free joint, about their centre of
    mass. A rotor is an actuator on a site whose `gear` has a force along z and a torque about z.
    The thrust limits are `ctrlrange` times gain and `gear`; the lag is the time constant of the
    actuator's filter. If one actuator pushes and the others turn the body, the rotors share
    its thrust. Fields that `over` replaces are neither checked nor returned.

    Raises:
        RobotError: the model does not have this form.
    """
    try:
        model = _compile(path)
    except ArgumentError as error:
        raise RobotError(str(error.with_names({"arm": str(path)}))) from None
    except ValueError as error:
        raise RobotError(f"{path}: must be MJCF, {' '.join(str(error).split())}") from None
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if len(free) != 1:
        raise RobotError(f"{path}: the model must have one free joint, got {len(free)}")
    root = int(model.jnt_bodyid[free[0]])
    turn = data.xmat[root].reshape(3, 3)
    mass, centre, inertia = _body(model, data, root, turn)
    moments, products = np.diag(inertia), inertia[[0, 0, 1], [1, 2, 2]]
    if np.abs(products).max() > _SKEW * moments.max():
        moments = np.append(moments, products)
    found = {"mass": mass, "inertia": moments.tolist()}
    own = over.get("rotors") or {}
    own = own if isinstance(own, Mapping) else vars(own)
    if own.keys() >= {"max_thrust"} and own.keys() & {"diagonal", "places"}:
        return found | {"rotors": {}}
    of_site = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_SITE).tolist()
    pushes = [k for k in of_site if model.actuator_gear[k, :3].any()]
    if len(pushes) == 1 and "diagonal" not in own:
        rule = "rotors must have a diagonal, or places and max_thrust, in a YAML file"
        raise RobotError(f"{path}: {rule}, since one actuator pushes and others turn the body")
    if len(pushes) > 1 and not len(pushes) == len(of_site) == model.nu in COUNTS or not pushes:
        rule = "the model must have 4, 6 or 8 actuators, all on sites"
        raise RobotError(f"{path}: {rule}, got {model.nu}, {len(of_site)} of them on sites")
    rotors = [_rotor(path, model, data, k, centre, turn, own) for k in pushes]
    return found | _rotors(path, rotors, own)


def _compile(path: Path) -> _Mj:
    """Compile a model without meshes and pictures that do not matter, whose files may miss."""
    source, kinds = ArmText(path), mujoco.mjtInertiaFromGeom
    spec = mujoco.MjSpec.from_string(source.text, include=source.includes)
    spec.modelfiledir = str(path.absolute().parent)
    for each in (*spec.geoms, *spec.sites):
        each.material = ""
    for geom in spec.geoms:
        source, is_stated = spec.compiler.inertiafromgeom, geom.parent.explicitinertial
        is_idle = geom.mass == 0.0 or source == kinds.mjINERTIAFROMGEOM_FALSE
        is_idle |= is_stated and source == kinds.mjINERTIAFROMGEOM_AUTO
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and is_idle:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    idle = (mesh for mesh in spec.meshes if mesh.name not in used)
    for each in [*spec.materials, *spec.textures, *idle]:
        spec.delete(each)
    return spec.compile()


def _body(
    model: _Mj, data: _Mj, root: int, turn: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass [kg], centre of mass (3,) [m] and inertia (3, 3) [kg m^2] of a tree of bodies.

    The tree is the body with index `root` and all bodies attached to it. The inertia is about the
    centre of mass, in the frame of the root body, whose rotation is `turn` (3, 3).
    """
    mass, centre = float(model.body_subtreemass[root]), data.subtree_com[root]
    total = np.zeros((3, 3))
    for body in range(root, model.nbody):
        if model.body_rootid[body] == model.body_rootid[root]:
            axes = data.ximat[body].reshape(3, 3)
            away = data.xipos[body] - centre
            own = axes * model.body_inertia[body] @ axes.T
            total += own + model.body_mass[body] * (away @ away * np.eye(3) - np.outer(away, away))
    return mass, centre, turn.T @ total @ turn


def _rotor(
    path: Path,
    model: _Mj,
    data: _Mj,
    k: int,
    centre: np.ndarray,
    turn: np.ndarray,
    own: Mapping[str, Value],
) -> dict[str, Value]:
    """Return position (2,) [m], thrust limits (2,) [N], torque ratio [m] and lag [s] of a rotor."""
    name = model.actuator(k).name or k
    site = int(model.actuator_trnid[k, 0])
    frame = turn.T @ data.site_xmat[site].reshape(3, 3)
    push, spin = frame @ model.actuator_gear[k, :3], frame @ model.actuator_gear[k, 3:]
    if not push[2] > 0.0 or np.abs(np.append(push[:2], spin[:2])).max() > 1e-3 * push[2]:
        shown = " ".join(f"{x:g}" for x in model.actuator_gear[k])
        raise RobotError(f"{path}: gear of actuator {name} must push along z, got {shown}")
    if "max_thrust" not in own:
        if (
            model.actuator_gaintype[k] != mujoco.mjtGain.mjGAIN_FIXED
            or model.actuator_biasprm[k].any()
        ):
            raise RobotError(f"{path}: actuator {name} must have a fixed gain and no bias")
        if not model.actuator_ctrllimited[k]:
            raise RobotError(f"{path}: actuator {name} must have a ctrlrange")
    filters = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
    lag = float(model.actuator_dynprm[k, 0]) if model.actuator_dyntype[k] in filters else _LAG
    force = push[2] * model.actuator_gainprm[k, 0] * model.actuator_ctrlrange[k]
    place = (turn.T @ (data.site_xpos[site] - centre))[:2]
    return {"place": place, "force": force, "ratio": spin[2] / push[2], "lag": lag}


def _rotors(
    path: Path, rotors: list[dict[str, Value]], own: Mapping[str, Value]
) -> dict[str, Value]:
    """Return the fields "rotors" and "source" of a robot, without the fields `own` of rotors."""
    rotors = sorted(rotors, key=lambda rotor: np.arctan2(*rotor["place"][::-1]) % 6.28)
    if rotors[0]["ratio"] < 0.0:
        rotors = [*rotors[1:], rotors[0]]
    first, num = rotors[0], len(rotors)
    for name, attribute, field in (("force", "ctrlrange", "max_thrust"), ("lag", "dynprm", "lag")):
        is_same = all(np.array_equal(rotor[name], first[name]) for rotor in rotors)
        if not is_same and field not in own:
            raise RobotError(f"{path}: {attribute} must be the same for all rotors")
    share = 1.0 if num > 1 else 1.0 / own.get("count", COUNTS[0])
    found = dict(zip(("min_thrust", "max_thrust"), (share * first["force"]).tolist(), strict=True))
    found |= {"lag": first["lag"]}
    notes = ["lag of 20 ms assumed"] if first["lag"] == _LAG and "lag" not in own else []
    if num > 1:
        places = np.array([rotor["place"] for rotor in rotors])
        ratios = np.array([rotor["ratio"] for rotor in rotors])
        signs = np.resize([1.0, -1.0], num)
        is_alternating = np.all(ratios * signs > 0.0)
        allocation = np.stack([np.ones(num), *places.T, ratios])
        if not is_alternating and np.linalg.matrix_rank(allocation, tol=1e-6) < 4:
            notes.append(
                "neighbouring rotors taken to turn in opposite directions, since as the "
                "file states them they cannot turn the body about z alone"
            )
            is_alternating = True
        is_equal = np.ptp(np.abs(ratios)) <= 1e-6 * np.abs(ratios).max()
        if not (is_alternating and is_equal) and "torque_ratio" not in own:
            shown = " ".join(f"{ratio:g}" for ratio in ratios)
            rule = "gear of neighbouring rotors must turn in opposite directions"
            raise RobotError(f"{path}: {rule}, got {shown}; or write torque_ratio in a YAML file")
        found |= {"places": places.tolist(), "torque_ratio": float(np.abs(ratios[0]))}
    found = {name: value for name, value in found.items() if name not in own}
    return {"rotors": found, "source": "; ".join([path.name, *notes])}
