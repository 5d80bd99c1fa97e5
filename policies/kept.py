"""Parameters after each part of a training, stored by Orbax, each with a digest."""

import hashlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as orbax

from planner_jax.host.files import open_plain, replacing
from planner_jax.runs.manifest import JsonError, parse_written, to_write


class KeptParts:
    """Storage of the parameters after every part: a folder and a file with the digest for each.

    Parameters that do not match their digest are ignored, with a message on standard error.

    Args:
        folder: folder of the storage; it is created if it does not exist.
    """

    def __init__(self, folder: Path):
        self._folder, self._keeper = folder, orbax.StandardCheckpointer()
        folder.mkdir(parents=True, exist_ok=True)

    def save(self, number: int, params: Any) -> None:
        """Store the parameters after a part."""
        place = self._place(number)
        if place.exists():
            shutil.rmtree(place)
        self._keeper.save(place, params)
        self._keeper.wait_until_finished()
        text = json.dumps(to_write({"sha256": _digest(params)}))
        with replacing(self._note(number)) as scratch:
            scratch.write_text(text + "\n", encoding="utf-8")

    def restore(self, number: int, like: Any) -> Any | None:
        """Return the stored parameters after a part; None if they are missing or damaged.

        Args:
            number: number of the part.
            like: parameters with the same shapes.
        """
        try:
            with open_plain(self._note(number)) as file:
                note = parse_written(file.read())
            found = jax.device_get(self._keeper.restore(self._place(number), like))
            if _digest(found) == note["sha256"]:
                return found
            why = "its digest differs"
        except FileNotFoundError:
            return None
        except JsonError as error:
            why = f"its note {error}"
        except Exception as error:  # Orbax and its readers raise many kinds
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
