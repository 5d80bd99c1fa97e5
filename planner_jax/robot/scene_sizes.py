"""Sizes to which planners pad the obstacles of an arm's scene, so that many scenes share programs.

A pair of a link and an absent obstacle takes as long as a pair with a present one. Therefore each
kind of obstacle has sizes of its own, and a kind without obstacles stays without.
"""

import dataclasses

import numpy as np

from planner_jax.core.arithmetic import numpy_of
from planner_jax.core.shapes import next_size, on_host, resize
from planner_jax.robot.arm_scene import ABSENT, Scene

BODIES = (1, 8, 64)  # numbers of capsules, boxes and cylinders
_FAR = 1e3  # [m], height of an added box or cylinder, beyond the reach of every arm

# Fields of the obstacles of each kind: the axis of the obstacles, and the entry that is added.
_ADDED: tuple[dict[str, tuple[int, float | np.ndarray]], ...] = (
    {"capsule_ends": (-3, 0.0), "capsule_radius": (-1, ABSENT)},
    {
        "box_middle": (-2, np.array([0.0, 0.0, _FAR])),
        "box_turn": (-2, np.array([1.0, 0.0, 0.0, 0.0])),
        "box_half": (-2, 0.0),
    },
    {
        "cylinder_ends": (-3, np.array([[0.0, 0.0, _FAR], [0.0, 0.0, _FAR + 1.0]])),
        "cylinder_radius": (-1, 0.0),
    },
)


def fit_scene(scene: Scene, batch: tuple[int, ...]) -> Scene:
    """Return the scene of a case, or of a batch of the shape `batch`, in arrays of few sizes.

    The solids that enclose meshes take the place of the meshes. Added capsules are absent, and
    added boxes and cylinders are far away.
    """
    solids = {} if scene.meshes is None else scene.meshes.solids
    fields: dict[str, object] = {"meshes": None} if solids else {}
    for kind in _ADDED:
        for name, (axis, fill) in kind.items():
            leaf = getattr(scene, name)
            num = leaf.shape[axis] + (solids[name].shape[axis] if solids else 0)
            size = next_size(num, BODIES) if num else 0
            if size == leaf.shape[axis]:
                continue
            leaf = on_host(leaf, batch)
            if solids:
                own = on_host(solids[name], batch)
                leaf = numpy_of(leaf).concatenate([leaf, own], axis=axis)
            fields[name] = resize(leaf, axis, size, fill)
    return dataclasses.replace(scene, **fields) if fields else scene
