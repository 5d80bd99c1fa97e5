"""Joint torques of an arm's motion, by the inverse dynamics of a MuJoCo model of the arm."""

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np

from planner_jax.referee import judging

LONGEST_STEP = 0.005  # [s], greatest time between two samples of a motion
_LEAST = 1e-12  # [kg], [kg m^2], least mass and moment of inertia of a link


class Dynamics:
    """A MuJoCo model of an arm's links, with their masses and inertias, without collisions.

    The torques contain the forces that the motors' rotors need (`armature`), but no friction.
    """

    def __init__(self, leaf: Callable[[str], Any], gravity: float) -> None:
        """Build the model of an arm. `leaf` returns an array of `Arm` or None, by its name."""
        self._mujoco: Any = importlib.import_module("mujoco")  # slow to import
        spec = self._mujoco.MjSpec()
        spec.option.gravity = [0.0, 0.0, -gravity]
        spec.compiler.boundmass = spec.compiler.boundinertia = _LEAST
        body, armature = spec.worldbody, leaf("armature")
        for k, mass in enumerate(leaf("mass")):
            body = body.add_body(pos=leaf("origin")[k], quat=leaf("turn")[k])
            own = 0.0 if armature is None else armature[k]
            kind = self._mujoco.mjtJoint.mjJNT_HINGE
            body.add_joint(type=kind, axis=leaf("axis")[k], armature=own)
            moments, axes = np.linalg.eigh(leaf("inertia")[k])
            axes[:, 0] *= np.sign(np.linalg.det(axes))
            self._mujoco.mju_mat2Quat(body.iquat, axes.ravel())
            # MuJoCo requires A + B >= C, which rounding may break for a flat body.
            moments[2] = min(moments[2], (1.0 - 1e-9) * (moments[0] + moments[1]))
            body.mass, body.inertia, body.ipos = mass, moments, leaf("centre")[k]
            body.explicitinertial = True
        self._model = spec.compile()

    def compare(
        self, coeffs: np.ndarray, durations: np.ndarray, limit: np.ndarray, stays: bool
    ) -> tuple[float, float, int]:
        """Return the greatest excess of a torque, relative to its limit, its time, and the joint.

        The M polynomial pieces have coefficients (D + 1, n, M) and durations (M,). Torques are
        computed at both ends of each piece, and at samples between them. If the arm `stays`, it has
        to hold still at the end.
        """
        count = np.ceil(durations / LONGEST_STEP).astype(int)  # 0 for a piece without duration
        piece = np.repeat(np.arange(len(count)), np.where(count > 0, count + 1, 0))
        local = (np.arange(len(piece)) - np.searchsorted(piece, piece)) / count[piece]
        local *= durations[piece]
        times = np.append((np.cumsum(durations) - durations)[piece] + local, durations.sum())
        piece, local = np.append(piece, len(count) - 1), np.append(local, durations[-1])
        states = [judging.derivative(coeffs[:, :, piece], local, order) for order in range(3)]
        if stays:
            states[1][:, -1] = states[2][:, -1] = 0.0
        excess = np.abs(self.torques(np.stack(states).transpose(2, 0, 1))) / limit - 1.0
        sample, joint = np.unravel_index(excess.argmax(), excess.shape)
        return float(excess[sample, joint]), float(times[sample]), int(joint)

    def torques(self, states: np.ndarray) -> np.ndarray:
        """Return the torques (S, n) [N m] at states (S, 3, n): angles, rates, accelerations."""
        data = self._mujoco.MjData(self._model)
        found = np.empty(states[:, 0].shape)
        for k, (data.qpos[:], data.qvel[:], data.qacc[:]) in enumerate(states):
            self._mujoco.mj_inverse(self._model, data)
            found[k] = data.qfrc_inverse
        return found
