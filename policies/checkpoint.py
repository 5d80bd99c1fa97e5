"""Checkpoints of trained policies: reading and writing, without pickle.

A checkpoint is a NumPy archive. It has one array for each weight, named by the weight's path in
the network, and `about`, a line of JSON with the format, the network and its sizes, the number of
features, the suites and the seed.
"""

import dataclasses
import json
import os
from importlib import resources
from typing import Any

import numpy as np
from flax import traverse_util

from planner_jax.core.checks import require_path_name
from planner_jax.core.errors import ArgumentError
from planner_jax.core.plan_files import UNREADABLE
from planner_jax.host.files import open_plain, replacing
from planner_jax.policies.networks import NETWORKS
from planner_jax.policies.observation import FEATURES

FORMAT = 2
SHIPPED = ("catch", "rush6")  # trained on eight suites, and on `rush6` alone
_OF_FLAX = ("parent", "name")  # fields of every Flax module


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A trained policy as read from a file."""

    params: Any  # weights, NumPy leaves
    network: Any  # a module from `networks`
    about: dict[str, Any]  # suites and seed of the training


def save_checkpoint(
    path: str | os.PathLike, params: Any, network: Any, about: dict[str, Any]
) -> None:
    """Write a checkpoint atomically.

    Args:
        path: path of the file.
        params: weights of the network.
        network: a module from `networks`.
        about: suites and seed of the training, plain JSON.
    """
    name, sizes = name_and_sizes(network)
    head = {"format": FORMAT, "features": FEATURES, "network": name, "sizes": sizes, **about}
    flat = traverse_util.flatten_dict(params, sep="/")
    arrays: Any = {key: np.asarray(leaf, np.float32) for key, leaf in flat.items()}
    with replacing(path) as scratch, open(scratch, "wb") as file:
        np.savez(file, about=np.array(json.dumps(head)), **arrays)


def name_and_sizes(network: Any) -> tuple[str, dict[str, int]]:
    """Return the name of a network and the fields that determine its shape."""
    (name,) = (name for name, kind in NETWORKS.items() if isinstance(network, kind))
    fields = (field.name for field in dataclasses.fields(network))
    return name, {field: getattr(network, field) for field in fields if field not in _OF_FLAX}


def load_checkpoint(path: str | os.PathLike) -> Checkpoint:
    """Read the policy in a file.

    Raises:
        ArgumentError: the file is missing, is not a checkpoint, or has another format.
    """
    require_path_name("checkpoint", path)
    name = os.fspath(path)
    try:
        with open_plain(path) as file, np.load(file, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        about = json.loads(str(arrays.pop("about")))
        found, network = about["format"], about["network"]
    except UNREADABLE as error:
        raise ArgumentError(
            "checkpoint",
            "one that `planner-jax train` wrote",
            shown=f"{name!r} ({type(error).__name__})",
        ) from error
    if found != FORMAT or about["features"] != FEATURES:
        raise ArgumentError(
            "checkpoint",
            f"of format {FORMAT} with {FEATURES} features of a target",
            shown=f"format {found} with {about['features']} in {name!r}",
        )
    if network not in NETWORKS:
        known = ", ".join(NETWORKS)
        raise ArgumentError("network", f"one of {known}", shown=f"{network!r} in {name!r}")
    kind, sizes = NETWORKS[network], about.get("sizes", {})
    known = [field.name for field in dataclasses.fields(kind) if field.name not in _OF_FLAX]
    if not set(sizes) <= set(known):
        raise ArgumentError(
            f"sizes of network {network!r}",
            f"among {', '.join(known)}",
            shown=f"{', '.join(sizes)} in {name!r}",
        )
    params = traverse_util.unflatten_dict(arrays, sep="/")
    return Checkpoint(params=params, network=kind(**sizes), about=about)


def checkpoint_of(file: str | os.PathLike) -> Checkpoint:
    """Read a file, or one of `SHIPPED` by its name; raises as `load_checkpoint`."""
    return load_shipped_checkpoint(os.fspath(file)) if file in SHIPPED else load_checkpoint(file)


def load_shipped_checkpoint(name: str) -> Checkpoint:
    """Read a policy that is shipped with the library, one of `SHIPPED`."""
    with resources.as_file(resources.files("planner_jax.policies") / f"{name}.npz") as path:
        return load_checkpoint(path)
