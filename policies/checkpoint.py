"""Files of trained policies (checkpoints), which are read and written without pickle.

A checkpoint is a NumPy archive (`.npz`). It has one array for each weight, named by the weight's
path in the network. Its entry `about` is a line of JSON with the version number of the format, the
network and its sizes, the number of features, and the suites (families of cases) and seed of the
training.
"""

import dataclasses
import json
import os
from importlib import resources
from typing import Any

import jax
import numpy as np
from flax import traverse_util

from planner_jax.core.checks import require_path_name
from planner_jax.core.errors import ArgumentError, format_value
from planner_jax.core.plan_files import UNREADABLE, name_damage, read_archive
from planner_jax.host.files import LARGEST, replacing
from planner_jax.policies.networks import KINDS, num_features

FORMAT = 2  # version number of the format of checkpoints
# Names of the trained policies in the package: "catch" is trained on eight suites (families of
# generated cases), and "rush6" on the suite `rush6` alone, whose six targets have deadlines.
SHIPPED = ("catch", "rush6")
_MOST, _MOST_LAYERS = 1024, 32  # greatest width and other sizes of a network; most layers
_OF_FLAX = ("parent", "name")  # fields of every Flax module, which are not sizes of the network


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The contents of a checkpoint, the file of a trained policy."""

    params: Any  # weights of the network, a pytree of NumPy arrays
    network: Any  # a Flax module from `networks`
    about: dict[str, Any]  # entry `about` of the file: format, sizes, suites and seed


def save_checkpoint(
    path: str | os.PathLike, params: Any, network: Any, about: dict[str, Any]
) -> None:
    """Write the weights of a policy to a file, atomically.

    Args:
        path: path of the file.
        params: weights of the network, a pytree of arrays.
        network: a Flax module from `networks`.
        about: suites (families of cases) and seed of the training, as JSON values.
    """
    name, sizes = name_and_sizes(network)
    features = num_features(network)
    head = {"format": FORMAT, "features": features, "network": name, "sizes": sizes, **about}
    flat = traverse_util.flatten_dict(params, sep="/")
    arrays: Any = {key: np.asarray(leaf, np.float32) for key, leaf in flat.items()}
    with replacing(path) as scratch, open(scratch, "wb") as file:
        np.savez(file, about=np.array(json.dumps(head)), **arrays)


def name_and_sizes(network: Any) -> tuple[str, dict[str, int]]:
    """Return a network's name, a key of `KINDS`, and its sizes, such as {"width": 64}."""
    (name,) = (name for name, kind in KINDS.items() if isinstance(network, kind))
    fields = (field.name for field in dataclasses.fields(network))
    return name, {field: getattr(network, field) for field in fields if field not in _OF_FLAX}


def load_checkpoint(path: str | os.PathLike) -> Checkpoint:
    """Read a trained policy from a checkpoint file.

    Raises:
        ArgumentError: the file is missing, is not a checkpoint, has another format, or has weights
            that are not finite or do not fit its network.
    """
    require_path_name("checkpoint", path)
    name = os.fspath(path)
    try:
        text, arrays = read_archive(path, "about", LARGEST)
        about = json.loads(text)
        found, features, network = about["format"], about["features"], about["network"]
        sizes = dict(about.get("sizes", {}))
    except UNREADABLE as error:
        raise ArgumentError(
            "checkpoint",
            "one that `planner-jax train` wrote",
            shown=f"{name!r} ({name_damage(error)})",
        ) from error
    if not isinstance(network, str) or network not in KINDS:
        shown = f"{network!r:.60} in {name!r}"
        raise ArgumentError("network", f"one of {', '.join(KINDS)}", shown=shown)
    kind = KINDS[network]
    known = [field.name for field in dataclasses.fields(kind) if field.name not in _OF_FLAX]
    for size, value in sizes.items():
        most = _MOST_LAYERS if size == "layers" else _MOST
        if size not in known or type(value) is not int or not 0 < value <= most:
            rule = f"among {', '.join(known)}, whole numbers from 1 to {_MOST}"
            rule += f" and at most {_MOST_LAYERS} layers" if "layers" in known else ""
            shown = f"{size:.40} {value!r:.40} in {name!r}"
            raise ArgumentError(f"sizes of network {network!r}", rule, shown=shown)
    made = kind(**sizes)
    if (found, features) != (FORMAT, num_features(made)):
        rule = f"of format {FORMAT} with {num_features(made)} features"
        shown = format_value(f"format {found} with {features} in {name}")
        raise ArgumentError("checkpoint", rule, shown=shown)
    _require_weights(arrays, made, name)
    params = traverse_util.unflatten_dict(arrays, sep="/")
    return Checkpoint(params=params, network=made, about=about)


def _require_weights(arrays: dict[str, np.ndarray], network: Any, name: str) -> None:
    """Raise unless there is one array of finite numbers for each weight of a network."""
    seen = jax.ShapeDtypeStruct((1, num_features(network)), np.float32)
    try:
        shapes = jax.eval_shape(lambda seen: network.init(jax.random.key(0), seen), seen)
    except (TypeError, ValueError) as error:
        shown = f"{' '.join(str(error).split())[:100]} in {name!r}"
        raise ArgumentError("checkpoint", "of a network that exists", shown=shown) from None
    expected: Any = traverse_util.flatten_dict(shapes, sep="/")
    for key in sorted(expected.keys() ^ arrays.keys()):
        verb = "hold" if key in expected else "not hold"
        raise ArgumentError("checkpoint", f"the weight {key:.60}", name, verb=verb)
    for key, array in arrays.items():
        fits = array.shape == expected[key].shape and array.dtype.kind == "f"
        if not fits or not np.isfinite(array).all():
            rule = f"{expected[key].shape} finite numbers in the weight {key}"
            shown = f"{array.dtype} {array.shape}{' that are not' * fits} in {name!r}"
            raise ArgumentError("checkpoint", rule, verb="have", shown=shown)


def checkpoint_of(file: str | os.PathLike) -> Checkpoint:
    """Read a policy: by its name in `SHIPPED`, or from a file with `load_checkpoint`."""
    return load_shipped_checkpoint(os.fspath(file)) if file in SHIPPED else load_checkpoint(file)


def load_shipped_checkpoint(name: str) -> Checkpoint:
    """Read a policy that is part of the package; `name` is one of `SHIPPED`."""
    with resources.as_file(resources.files("planner_jax.policies") / f"{name}.npz") as path:
        return load_checkpoint(path)
