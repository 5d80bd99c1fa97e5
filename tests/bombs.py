"""Small files that need much memory or time to read: `python -m tests.bombs FOLDER [NAME ...]`.

The program writes one file after another, reads each in a process of its own, and prints a line of
JSON for each: the memory [MB] above the memory of a process that read an ordinary file of the same
kind, the processor time [s], and the error. A process that takes too much memory or time ends.
"""

import dataclasses
import importlib
import io
import json
import os
import resource
import struct
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from planner_jax.core.errors import PlannerJaxError
from planner_jax.plane.maps import read_map
from planner_jax.robot.arm_file import read_arm
from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.robot.quadrotor_file import read_robot

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "tests" / "data"
MOST = 4 << 30  # [B] memory that a process may take beyond what it has, so that the machine is safe
LONGEST = 60  # [s] processor time that a process may take


def read_library(path: Path) -> Any:
    return importlib.import_module("planner_jax.baselines.block.library.file").load_library(path)


def read_policy(path: Path) -> Any:
    return importlib.import_module("planner_jax.policies.checkpoint").load_checkpoint(path)


def read_trials(path: Path) -> Any:
    return importlib.import_module("planner_jax.baselines.hit.published").read_serves(path.parent)


def read_manifest(path: Path) -> Any:
    return importlib.import_module("planner_jax.runs.run_folder").RunFolder(path).read_manifest()


def read_map_and_walls(path: Path) -> Any:
    return read_map(path).walls()


def read_commonroad(path: Path) -> Any:
    sys.path.insert(0, str(ROOT / "benchmarks" / "commonroad_reader"))
    return importlib.import_module("commonroad_reader").read(path)


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of file: its reader, and a writer of an ordinary file into a folder."""

    read: Callable[[Path], Any]
    write: Callable[[Path], Path]


def write_text(name: str, text: str | bytes) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        content = text if isinstance(text, bytes) else text.encode()
        (folder / name).write_bytes(content)
        return folder / name

    return write


def write_sparse(name: str, head: bytes = b"") -> Callable[[Path], Path]:
    """Write a file of 3 GB that takes no space on the disk."""

    def write(folder: Path) -> Path:
        with (folder / name).open("wb") as file:
            file.write(head)
            file.truncate(3 << 30)
        return folder / name

    return write


def write_archive(header: str, text: str) -> Callable[[Path], Path]:
    """Write a NumPy archive with a member of 600 MB of zeros, compressed to 0.6 MB."""

    def write(folder: Path) -> Path:
        path, size = folder / "bomb.npz", 600_000_000
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            with archive.open(f"{header}.npy", "w") as member:
                np.lib.format.write_array(member, np.array(text))
            with archive.open("cost.npy", "w", force_zip64=True) as member:
                shape = {"descr": "<f4", "fortran_order": False, "shape": (size // 4,)}
                np.lib.format.write_array_header_1_0(member, shape)
                for _ in range(60):
                    member.write(bytes(size // 60))
        return path

    return write


def write_members(folder: Path) -> Path:
    """Write an archive whose directory has two million entries, behind one usual member."""
    path = folder / "members.npz"
    np.savez(path, header=np.array("{}"))
    content = path.read_bytes()
    start = content.index(b"PK\1\2")
    entry = content[start : content.index(b"PK\5\6")]
    with path.open("wb") as file:
        file.write(content[:start] + entry * 2_000_000)
        file.write(struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 9, 9, len(entry) * 2_000_000, start, 0))
    return path


def write_ordinary_plan(folder: Path) -> Path:
    plan = importlib.import_module("tests.flown_plans").quadrotor()
    plan.save(folder / "plan.npz")
    return folder / "plan.npz"


def write_ordinary_library(folder: Path) -> Path:
    module = importlib.import_module("tests.test_block_library")
    module.save_library(folder / "a.lib", module.make_library())
    return folder / "a.lib"


def write_forged_library(folder: Path) -> Path:
    """Write a library whose header names 3,000 arrays of one MB each, but has the bytes of one."""
    forge = importlib.import_module("tests.test_block_library").forge
    path = write_ordinary_library(folder)
    arrays = {f"array{k}": ["<f4", [1 << 18], 0] for k in range(3000)}

    def change(header: dict) -> None:
        header["arrays"].update(arrays)

    path.write_bytes(forge(path.read_bytes(), change, bytes(1 << 20)))
    return path


def write_map(content: bytes, name: str = "map.pgm") -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        (folder / "map.yaml").write_text(f"image: {name}\nresolution: 0.05\norigin: [0, 0, 0]\n")
        return folder / "map.yaml"

    return write


def write_png(side: int, bits: int) -> Callable[[Path], Path]:
    """Write a map whose picture is a PNG of side x side equal pixels."""

    def chunk(name: bytes, content: bytes) -> bytes:
        checked = zlib.crc32(name + content)
        return struct.pack(">L", len(content)) + name + content + struct.pack(">L", checked)

    def write(folder: Path) -> Path:
        packer, row, rows = zlib.compressobj(1), bytes(1 + side * bits // 8), io.BytesIO()
        for _ in range(side):
            rows.write(packer.compress(row))
        rows.write(packer.flush())
        head = struct.pack(">2L5B", side, side, bits, 0, 0, 0, 0)
        parts = (chunk(b"IHDR", head), chunk(b"IDAT", rows.getvalue()), chunk(b"IEND", b""))
        return write_map(b"\x89PNG\r\n\x1a\n" + b"".join(parts), "map.png")(folder)

    return write


def write_manifest(text: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "manifest.json").write_text(text)
        return folder

    return write


def write_keys(num: int) -> str:
    return "".join(f"{k}: 1\n" for k in range(num))


def write_serves(num: int) -> str:
    return "".join(f"{k},1 0 2,-7 0 6,3 0 0,-3 0 0,failed,failed,failed\n" for k in range(num))


def mjcf(inside: str, asset: str = "") -> str:
    return f"<mujoco><asset>{asset}</asset><worldbody>{inside}</worldbody></mujoco>"


CELLS = np.where(np.indices((1000, 1000)).sum(axis=0) % 2, 255, 0).astype(np.uint8)
COMMENTED = b"P5\n#" + b"a" * 50_000_000 + b"\n1 1 255\n\0"
HFIELD = '<hfield name="a" nrow="40000" ncol="40000" size="1 1 1 1"/>'
NESTED = "<commonRoad>" + "<a>" * 5_000_000 + "</a>" * 5_000_000 + "</commonRoad>"

ROBOT = Kind(read_robot, write_text("a.yaml", (DATA / "my_quadrotor.yaml").read_bytes()))
MODEL = Kind(read_robot, write_text("a.xml", (DATA / "quadrotor.xml").read_bytes()))
ARM = Kind(read_arm, write_text("arm.xml", (DATA / "askew_arm.xml").read_bytes()))
PLAN = Kind(QuadrotorPlan.load, write_ordinary_plan)
POLICY = Kind(read_policy, write_text("a.npz", (ROOT / "policies" / "catch.npz").read_bytes()))
LIBRARY = Kind(read_library, write_ordinary_library)
MAP = Kind(read_map_and_walls, write_map(b"P5 20 20 255\n" + bytes(400)))
TRIALS = Kind(read_trials, write_text("1_1_1_p.csv", write_serves(1)))
RUN = Kind(read_manifest, write_manifest("{}"))
ROADS = Kind(read_commonroad, write_text("a.xml", (DATA / "commonroad.xml").read_bytes()))

PLAN_HEADER = '{"version": 1, "class": "QuadrotorPlan"}'
BOMBS: dict[str, tuple[Kind, Callable[[Path], Path]]] = {
    "YAML of 20,000 keys": (ROBOT, write_text("b.yaml", write_keys(20_000))),
    "YAML of 5,000 keys": (ROBOT, write_text("b.yaml", write_keys(5_000))),
    "YAML of a long list": (ROBOT, write_text("b.yaml", "a: [" + "1," * 24_000 + "]")),
    "sparse YAML": (ROBOT, write_sparse("b.yaml", b"a: 1\n")),
    "plan of zeros": (PLAN, write_archive("header", PLAN_HEADER)),
    "plan of two million members": (PLAN, write_members),
    "sparse plan": (PLAN, write_sparse("b.npz", b"PK\3\4")),
    "policy of zeros": (POLICY, write_archive("about", "{}")),
    "sparse policy": (POLICY, write_sparse("b.npz")),
    "library of 3,000 arrays": (LIBRARY, write_forged_library),
    "sparse library": (LIBRARY, write_sparse("b.lib", b"planner-jax block library 3 00000000\n")),
    "trials of 200,000 rows": (TRIALS, write_text("1_1_1_p.csv", write_serves(200_000))),
    "trials of 16,000 rows": (TRIALS, write_text("1_1_1_p.csv", write_serves(16_000))),
    "sparse trials": (TRIALS, write_sparse("1_1_1_p.csv")),
    "manifest of lists": (RUN, write_manifest('{"a": [' + "[]," * 20_000_000 + "[]]}")),
    "arm of 40,000 x 40,000 heights": (ARM, write_text("b.xml", mjcf("", HFIELD))),
    "arm of 20 million copies": (
        ARM,
        write_text("b.xml", mjcf('<replicate count="20000000"><geom size="1"/></replicate>')),
    ),
    "arm of 20,000 comments": (ARM, write_text("b.xml", mjcf("<!-- " * 20_000))),
    "arm of 10,000 includes": (ARM, write_text("b.xml", mjcf("<include " * 10_000))),
    "sparse arm": (ARM, write_sparse("b.xml")),
    "quadrotor of 40,000 x 40,000 heights": (MODEL, write_text("b.xml", mjcf("", HFIELD))),
    "quadrotor of 20 million copies": (
        MODEL,
        write_text("b.xml", mjcf('<replicate count="20000000"><geom size="1"/></replicate>')),
    ),
    "sparse quadrotor": (MODEL, write_sparse("b.xml")),
    "map of 13,000 x 13,000 pixels": (MAP, write_png(13_000, 8)),
    "map of 9,400 x 9,400 pixels of 16 bits": (MAP, write_png(9_400, 16)),
    "map with a comment of 50 MB": (
        MAP,
        write_map(COMMENTED),
    ),
    "map of a chequerboard": (MAP, write_map(b"P5 1000 1000 255\n" + CELLS.tobytes())),
    "sparse map": (MAP, write_sparse("b.yaml", b"image: a.pgm\n")),
    "CommonRoad of 5 million elements": (ROADS, write_text("b.xml", NESTED)),
}


def peak() -> float:
    """Return the greatest memory [MB] that this process has taken."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def attempt(read: Callable[[Path], Any], path: Path) -> dict[str, Any]:
    """Read a file; return processor time [s], greatest memory [MB], and the error, "" if none."""
    start, error, is_clear = time.process_time(), "", True
    try:
        read(path)
    except BaseException as found:
        error = f"{type(found).__name__}: {found}"
        is_clear = isinstance(found, PlannerJaxError | OSError) and "\n" not in error
    seconds = time.process_time() - start
    return {"seconds": seconds, "peak": peak(), "error": error[:300], "is_clear": is_clear}


def measure(name: str, folder: Path) -> dict[str, Any]:
    """Read the file `name` of `BOMBS`, after an ordinary file, in a new process."""
    kind, write = BOMBS[name]
    ordinary, bomb = folder / "ordinary", folder / "bomb"
    for each in (ordinary, bomb):
        each.mkdir(parents=True)
    paths = kind.write(ordinary), write(bomb)
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + MOST, taken + MOST))
        resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST))
        before = attempt(kind.read, paths[0])
        after = attempt(kind.read, paths[1])
        result = {**after, "memory": after["peak"] - before["peak"], "ordinary": before["error"]}
        os.write(writer, json.dumps(result).encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as file:
        content = file.read()
    status = os.waitpid(child, 0)[1]
    ended = {"is_clear": False, "error": f"ended with status {status}"}
    for path in sorted(folder.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    folder.rmdir()
    return {"name": name, **(json.loads(content) if content else ended)}


def main(folder: str, *names: str) -> None:
    """Print a line of JSON for each of the named files, by default for all."""
    for place, name in enumerate(names or BOMBS):
        print(json.dumps(measure(name, Path(folder) / str(place))), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
