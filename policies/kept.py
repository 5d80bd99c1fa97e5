"""Storage of the network parameters after each part of a training, so that it can be resumed.

Orbax writes the parameters. A digest in a separate file detects incomplete or damaged parameters.
"""

import hashlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as orbax

from planner_jax.host.files import read_plain, replacing
from planner_jax.runs.manifest import LARGEST, JsonError, parse_written, to_write


class KeptParts:
    """The stored parameters of a training: for each PPO run a folder, and a file with a digest.

    Args:
        folder: folder of the storage; it is created if it does not exist.
    """

    def __init__(self, folder: Path):
        self._folder, self._keeper = folder, orbax.StandardCheckpointer()
        folder.mkdir(parents=True, exist_ok=True)

    def save(self, number: int, params: Any) -> None:
        """Store the network's parameters after part (PPO run) `number`, and their digest."""
        place = self._place(number)
        if place.exists():
            shutil.rmtree(place)
        self._keeper.save(place, params)
        self._keeper.wait_until_finished()
        text = json.dumps(to_write({"sha256": _digest(params)}))
        with replacing(self._note(number)) as scratch:
            scratch.write_text(text + "\n", encoding="utf-8")

    def restore(self, number: int, like: Any) -> Any | None:
        """Read the parameters stored after one part (PPO run); None if missing or damaged.

        Damaged parameters are also reported on standard error.

        Args:
            number: number of the part.
            like: parameters with the shapes and types of the stored parameters, of any values.
        """
        try:
            note = parse_written(read_plain(self._note(number), LARGEST))
            found = jax.device_get(self._keeper.restore(self._place(number), like))
            if _digest(found) == note["sha256"]:
                return found
            why = "its digest differs"
        except FileNotFoundError:
            return None
        except JsonError as error:
            why = f"its note {error}"
        except Exception as error:  # Orbax raises many classes of exceptions for damaged files
            why = type(error).__name__
        place = self._place(number)
        print(
            f"planner-jax: {place} is damaged ({why}); the part is trained again", file=sys.stderr
        )
        return None

    def _place(self, number: int) -> Path:
        return (self._folder / f"{number:03d}").absolute()

    def _note(self, number: int) -> Path:
        return self._folder / f"{number:03d}.json"


def _digest(params: Any) -> str:
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(params):
        array = np.asarray(leaf)
        digest.update(f"{array.dtype.str} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
