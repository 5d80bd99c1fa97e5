# Pyright cannot see the names of MuJoCo's compiled module.
# pyright: reportAttributeAccessIssue=false
"""Reader of a quadrotor's mass, inertia and rotors from MJCF, MuJoCo's model format."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from planner_jax.robot.quadrotor_file import RobotError, Value

_Mj = Any  # a structure of MuJoCo, whose package has no types
_SKEW = 0.02  # greatest allowed (product of inertia) / (greatest moment of inertia)


def describe_mjcf(path: Path) -> dict[str, Value]:
    """Read a quadrotor from an MJCF file; return it as the fields of a YAML robot file.

    Mass and inertia are the sums of all bodies below the only free joint, about their centre of
    mass. A rotor is an actuator on a site whose `gear` has a force along z and a torque about z.
    The thrust limits are `ctrlrange` times gain and `gear`; the lag is the time constant of the
    actuator's filter.

    Raises:
        RobotError: the model does not have this form.
    """
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
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
    skew = np.abs(inertia - np.diag(np.diag(inertia))).max()
    if skew > _SKEW * np.diag(inertia).max():
        raise RobotError(
            f"{path}: inertia must be along the body's axes, got a product of {skew:.3g} kg m^2"
        )
    of_site = mujoco.mjtTrn.mjTRN_SITE
    rotors = [
        _rotor(path, model, data, k, centre, turn)
        for k in range(model.nu)
        if model.actuator_trntype[k] == of_site
    ]
    if model.nu != 4 or len(rotors) != 4:
        raise RobotError(
            f"{path}: the model must have 4 actuators, all on sites, got "
            + (f"{model.nu}, {len(rotors)} of them on sites" if model.nu else "none")
        )
    return {"mass": mass, "inertia": np.diag(inertia).tolist(), "rotors": _rotors(path, rotors)}


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
) -> dict[str, Value]:
    """Return position (2,) [m], thrust limits (2,) [N], torque ratio [m] and lag [s] of a rotor."""
    name = model.actuator(k).name or k
    site = int(model.actuator_trnid[k, 0])
    frame = turn.T @ data.site_xmat[site].reshape(3, 3)
    push, spin = frame @ model.actuator_gear[k, :3], frame @ model.actuator_gear[k, 3:]
    if not push[2] > 0.0 or np.abs(np.append(push[:2], spin[:2])).max() > 1e-3 * push[2]:
        shown = " ".join(f"{x:g}" for x in model.actuator_gear[k])
        raise RobotError(f"{path}: gear of actuator {name} must push along z, got {shown}")
    if model.actuator_gaintype[k] != mujoco.mjtGain.mjGAIN_FIXED or model.actuator_biasprm[k].any():
        raise RobotError(f"{path}: actuator {name} must have a fixed gain and no bias")
    if not model.actuator_ctrllimited[k]:
        raise RobotError(f"{path}: actuator {name} must have a ctrlrange")
    filters = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
    lag = float(model.actuator_dynprm[k, 0]) if model.actuator_dyntype[k] in filters else None
    force = push[2] * model.actuator_gainprm[k, 0] * model.actuator_ctrlrange[k]
    place = (turn.T @ (data.site_xpos[site] - centre))[:2]
    return {"place": place, "force": force, "ratio": spin[2] / push[2], "lag": lag}


def _rotors(path: Path, rotors: list[dict[str, Value]]) -> dict[str, Value]:
    rotors = sorted(rotors, key=lambda rotor: np.arctan2(*rotor["place"][::-1]) % 6.28)
    if rotors[0]["ratio"] < 0.0:
        rotors = [*rotors[1:], rotors[0]]
    ratios = np.array([rotor["ratio"] for rotor in rotors]) * [1.0, -1.0, 1.0, -1.0]
    if not np.all(ratios > 0.0) or np.ptp(ratios) > 1e-6 * ratios.max():
        shown = " ".join(f"{rotor['ratio']:g}" for rotor in rotors)
        raise RobotError(
            f"{path}: gear of neighbouring rotors must turn in opposite directions, got {shown}"
        )
    first = rotors[0]
    for name, attribute in (("force", "ctrlrange"), ("lag", "dynprm")):
        if any(not np.array_equal(rotor[name], first[name]) for rotor in rotors):
            raise RobotError(f"{path}: {attribute} must be the same for all rotors")
    return {
        "places": [rotor["place"].tolist() for rotor in rotors],
        "min_thrust": float(first["force"][0]),
        "max_thrust": float(first["force"][1]),
        "torque_ratio": float(ratios[0]),
        "lag": first["lag"],  # None without a filter; then the YAML file must have it
    }
