"""Body and rotors of a quadrotor from MuJoCo's model format, MJCF, as MuJoCo compiles it."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from planner_jax.core.errors import MissingExtra
from planner_jax.robot.quadrotor_file import RobotError, Value

_Mj = Any  # a structure of MuJoCo, whose package has no types
_SKEW = 0.02  # of the greatest moment of inertia, what may lie off the body's axes


def described_by(path: Path) -> dict[str, Value]:
    """Return the quadrotor of an MJCF file, in the fields of a YAML file, in SI units.

    Mass and inertia are those of all that hangs on the one free joint, about its centre of mass. A
    rotor is an actuator on a site whose `gear` pushes along z and turns about it; its thrusts are
    `ctrlrange` times gain and `gear`, its lag is that of its filter.

    Raises:
        RobotError: it is no such model; one line.
        MissingExtra: MuJoCo is not installed.
    """
    try:
        import mujoco
    except ModuleNotFoundError as error:
        raise MissingExtra(path.name, error.name, "sims") from None
    try:
        model = mujoco.MjModel.from_xml_path(str(path))  # type: ignore[attr-defined]
    except ValueError as error:
        raise RobotError(f"{path}: must be MJCF, {' '.join(str(error).split())}") from None
    data = mujoco.MjData(model)  # type: ignore[attr-defined]
    mujoco.mj_forward(model, data)  # type: ignore[attr-defined]
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)  # type: ignore[attr-defined]
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
    of_site = mujoco.mjtTrn.mjTRN_SITE  # type: ignore[attr-defined]
    rotors = [
        _rotor(path, mujoco, model, data, k, centre, turn)
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
    """Return mass [kg], its centre (3,) [m] and inertia (3, 3) [kg m^2] of a tree of bodies."""
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
    mujoco: ModuleType,
    model: _Mj,
    data: _Mj,
    k: int,
    centre: np.ndarray,
    turn: np.ndarray,
) -> dict[str, Value]:
    """Return position (2,) [m], thrusts (2,) [N], torque ratio [m] and lag [s] of an actuator."""
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


def _rotors(path: Path, found: list[dict[str, Value]]) -> dict[str, Value]:
    """Return the rotors counter-clockwise, the first of those that turn the body to the left."""
    found = sorted(found, key=lambda rotor: np.arctan2(rotor["place"][1], rotor["place"][0]) % 6.28)
    if found[0]["ratio"] < 0.0:
        found = [*found[1:], found[0]]
    ratios = np.array([rotor["ratio"] for rotor in found]) * [1.0, -1.0, 1.0, -1.0]
    if not np.all(ratios > 0.0) or np.ptp(ratios) > 1e-6 * ratios.max():
        shown = " ".join(f"{rotor['ratio']:g}" for rotor in found)
        raise RobotError(
            f"{path}: gear of neighbouring rotors must turn one against the other, got {shown}"
        )
    first = found[0]
    for name, word in (("force", "ctrlrange"), ("lag", "dynprm")):
        if any(not np.array_equal(rotor[name], first[name]) for rotor in found):
            raise RobotError(f"{path}: {word} must be the same for all rotors")
    return {
        "places": [rotor["place"].tolist() for rotor in found],
        "min_thrust": float(first["force"][0]),
        "max_thrust": float(first["force"][1]),
        "torque_ratio": float(ratios[0]),
        "lag": first["lag"],  # None without a filter: then somebody else has to say it
    }
