"""Functions that damage a file: flipped bits, cut ends, replaced values, deep nesting."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Values with which `swap` replaces a value of a JSON file; most have a wrong type or range.
ODD = (None, True, -1, 0, 10**400, 1.5, float("nan"), float("inf"), "", "x", [], {}, [[]], {"a": 1})


def flip(content: bytes, random: Any) -> bytes:
    changed = bytearray(content)
    for _ in range(random.choice((1, 1, 2, 64))):
        place = random.randrange(len(changed))
        changed[place] ^= 1 << random.randrange(8)
    return bytes(changed)


def cut(content: bytes, random: Any) -> bytes:
    return content[: random.choice((0, random.randrange(len(content)), len(content) - 1))]


def overwrite(content: bytes, random: Any) -> bytes:
    """Overwrite 1 to 64 bytes with zeros, or with bytes from another part of the file."""
    length = random.randrange(1, 65)
    place, other = (random.randrange(len(content)) for _ in range(2))
    stretch = random.choice((bytes(length), content[other : other + length]))
    return content[:place] + stretch + content[place + len(stretch) :]


def append(content: bytes, random: Any) -> bytes:
    return content + random.choice((b"\0", b"{}", content))


def nest(content: bytes, random: Any) -> bytes:
    depth = random.choice((1_000, 100_000))
    return random.choice((b"[", b'{"a":')) * depth


def swap(content: bytes, random: Any) -> bytes:
    lines = content.decode().splitlines()
    if lines[0] == "{":  # one object in the whole file
        lines = [content.decode()]
    line = random.randrange(len(lines))
    tree = json.loads(lines[line])
    at, places = tree, []
    while isinstance(at, dict | list) and at:
        keys = list(at) if isinstance(at, dict) else list(range(len(at)))
        places.append((at, random.choice(keys)))
        at = places[-1][0][places[-1][1]]
    holder, key = random.choice(places)
    if isinstance(holder, dict) and random.random() < 0.3:
        del holder[key]
    else:
        holder[key] = random.choice(ODD)
    lines[line] = json.dumps(tree)
    return "\n".join(lines).encode()


ANY: tuple[Callable[[bytes, Any], bytes], ...] = (flip, cut, overwrite, append)
OF_JSON = (*ANY, nest, swap)


def damage(path: Path, random: Any) -> str:
    """Damage a file by a random function of this module, and return the function's name."""
    kinds = OF_JSON if path.suffix in (".json", ".jsonl") else ANY
    kind = random.choice(kinds)
    path.write_bytes(kind(path.read_bytes(), random))
    return kind.__name__
