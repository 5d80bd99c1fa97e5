"""The command `planner-jax library`, which builds, shows, checks and repairs block libraries."""

import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from planner_jax.baselines.block.library.build import PLANNERS, build, repair
from planner_jax.baselines.block.library.cells import LAYOUTS, Face
from planner_jax.baselines.block.library.coverage import Coverage, check, coverage
from planner_jax.baselines.block.library.file import load_library, save_library
from planner_jax.baselines.block.library.table import Library, Setting, fingerprint
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.choices import (
    require,
    require_one_of,
    require_seed,
    require_size,
)
from planner_jax.core.room import require_memory
from planner_jax.robot.arm import REGIMES
from planner_jax.robot.arm_file import irb1600, read_arm
from planner_jax.robot.arm_scene import Box, paper_scene
from planner_jax.runs import style
from planner_jax.runs.environment import require_backend

_CASE_BYTES = 60_000  # [bytes], memory per ball while the referee judges stored motions


def build_library(
    path: str,
    *,
    layout: str = "full",
    regime: str = "R2",
    planner: str = "least-squares",
    pole: bool = True,
    arm: str | None = None,
    home: Sequence[float] | None = None,
) -> None:
    """Build a library in the scene of [Natarajan2024], or continue an interrupted build.

    Args:
        path: path of the library file.
        layout: a key of `LAYOUTS`, the division of the two boxes around the arm into cells.
        regime: a key of `REGIMES`: whether motions end at standstill, and the joint limits of the
            IRB 1600. Another arm has the limits of its file.
        planner: a key of `PLANNERS`, the planner of the stored motions.
        pole: whether the scene contains the pole.
        arm: path of an MJCF or URDF file; by default the IRB 1600.
        home: joint angles [rad] at which motions start, six for each start pose; by default one
            start pose of the arm.

    Raises:
        ArgumentError: an argument is invalid; the message states which values are valid.
    """
    require_one_of(LAYOUTS, "layout", layout)
    require_one_of(REGIMES, "regime", regime)
    require_one_of(PLANNERS, "planner", planner)
    require(
        home is None or (len(home) > 0 and len(home) % 6 == 0),
        "home",
        "six angles for each home",
        shown=f"{len(home or ())} numbers",
    )
    finite = home is None or all(map(math.isfinite, home))
    require(finite, "home", "finite angles", shown=" ".join(map(str, home or ())))
    if Path(path).exists():
        load_library(path)  # raises for a file of another kind, which must not be overwritten
    require_backend()
    body = irb1600() if arm is None else read_arm(arm)
    chosen, scene = REGIMES[regime], paper_scene(has_pole=pole)
    limits = chosen.limits if arm is None else body.limits
    setting = Setting(
        arm=body, limits=limits, ends_at_rest=host_leaf(chosen.ends_at_rest), scene=scene
    )
    homes = np.reshape(body.home if home is None else home, (-1, 6))
    start = time.perf_counter()
    library = build(path, setting, homes, LAYOUTS[layout], planner=planner)
    print(f"Built in {time.perf_counter() - start:.1f} s, compilation included.")
    _print(path, library, coverage(library))


def show_library(path: str, *, map: str | None = None) -> None:
    """Print which share of pairs of cells has a stored motion; draw it into the file `map`."""
    library = load_library(path)
    covered = coverage(library)
    _print(path, library, covered)
    if map is not None:
        style.draw(Path(map), coverage_map, (12.0, 7.0), library, covered)
        print(f"Map: {map}")


def check_library(path: str, *, num: int = 2000, seed: int = 0) -> None:
    """Print how many of `num` random balls the stored motions block, judged by the referee."""
    require_size("num", num)
    require_seed(seed)
    require_memory("num", num, _CASE_BYTES)
    library = load_library(path)
    require_backend()
    for home in range(len(library.table.homes)):
        found = check(library, num, seed, home)
        blocked = found.verdict.success
        wrong = found.claimed & ~blocked
        print(
            f"Home {home}: {num} balls through tunnels with a motion; by the referee "
            f"{100 * blocked.mean():.2f} % are blocked. It rejects {wrong.sum()} of "
            f"{found.claimed.sum()} claims."
        )
        for k in np.flatnonzero(wrong)[:5]:
            print(f"  pair {found.pairs[k]}: {found.verdict.sentence(int(k))}")


def repair_library(path: str, *, pole: Sequence[float], out: str, retry: bool = False) -> None:
    """Plan the motions again that touch a pole at a new position (x, y) [m]; write the file `out`.

    With `retry`, motions are also planned where the library has none.
    """
    library = load_library(path)
    require(len(pole) == 2, "pole", "two numbers [m]", shown=f"{len(pole)} numbers")
    require(bool(np.isfinite(pole).all()), "pole", "finite", list(pole))
    require_backend()
    moved, scene = paper_scene(pole=pole), library.setting.scene
    rod = {"capsule_ends": moved.capsule_ends, "capsule_radius": moved.capsule_radius}
    scene = dataclasses.replace(scene, **rod)
    start = time.perf_counter()
    repaired, touched = repair(library, scene, retry=retry)
    save_library(out, repaired)
    print(
        f"Planned {touched.sum()} of {library.found.sum()} motions again in "
        f"{time.perf_counter() - start:.1f} s, compilation included."
    )
    _print(out, repaired, coverage(repaired))


def _print(path: str, library: Library, covered: Coverage) -> None:
    table, setting = library.table, library.setting
    faces = [
        " ".join(f"{face.name} {face.cells[0]}x{face.cells[1]}" for face in side)
        for side in (table.layout.outer, table.layout.inner)
    ]
    print(f"{path}: {table.layout.num_pairs} pairs of cells, outer {faces[0]}; inner {faces[1]}")
    print(f"Setting {fingerprint(setting)}, {library.num_bytes / 1e6:.1f} MB.")
    limits = setting.limits
    ends = "at rest" if setting.ends_at_rest else "in motion"
    velocity = " ".join(f"{x:.3g}" for x in np.asarray(limits.velocity))
    acceleration = " ".join(f"{x:.3g}" for x in np.asarray(limits.acceleration))
    print(f"Joints up to {velocity} rad/s and {acceleration} rad/s^2; motions end {ends}.")
    scene = setting.scene
    rods = zip(np.asarray(scene.capsule_ends), np.asarray(scene.capsule_radius), strict=True)
    poles = [f"({x:.3f}, {y:.3f}) m" for ((x, y, _), _), radius in rods if radius >= 0.0]
    print(f"Pole at {' and '.join(poles)}." if poles else "No pole.")
    of_all = covered.found.mean(axis=1)
    of_feasible, of_centred = (
        covered.share(of) for of in (covered.is_feasible, covered.is_centred)
    )
    sure = covered.is_sure.sum(axis=1) / np.maximum(covered.found.sum(axis=1), 1)
    print(
        f"Balls can pass through {covered.is_feasible.sum()} pairs, from the centre of the outer "
        f"cell through {covered.is_centred.sum()}."
    )
    for home, angles in enumerate(np.asarray(table.homes)):
        print(
            f"Home {home} ({' '.join(f'{x:.4f}' for x in angles)}): motions for "
            f"{100 * of_feasible[home]:.1f} % of these, {100 * of_centred[home]:.1f} % of those, "
            f"{100 * of_all[home]:.1f} % of all; {100 * sure[home]:.1f} % of the shields block "
            "their whole tunnel."
        )


def coverage_map(figure: Figure, library: Library, covered: Coverage) -> None:
    """Draw the cells of both boxes, coloured by the share of their pairs that have a motion."""
    layout, scene = library.table.layout, library.setting.scene
    shape = (layout.num_outer, layout.num_inner)
    found = covered.found.any(axis=0).reshape(shape)
    feasible = covered.is_feasible.reshape(shape)
    sides = ((layout.outer, scene.outer, 1, "outer"), (layout.inner, scene.inner, 0, "inner"))
    columns = max(len(faces) for faces, *_ in sides)
    panels = figure.subplots(2, columns, squeeze=False)
    picture = None
    for row, (faces, box, axis, name) in zip(panels, sides, strict=True):
        possible = feasible.sum(axis=axis)
        share = (found & feasible).sum(axis=axis) / np.maximum(possible, 1)
        values = np.where(possible > 0, 100.0 * share, np.nan)
        offset = 0
        for panel, face in zip(row, faces, strict=False):
            cells = values[offset : offset + face.num].reshape(face.cells)
            picture = panel.imshow(
                cells.T,
                origin="lower",
                vmin=80.0,
                vmax=100.0,
                cmap="viridis",
                extent=_ends(face, box),
            )
            first, second = ("xyz"[each] for each in face.across)
            style.label(panel, f"{first} [m]", f"{second} [m]", f"{name} {face.name}")
            panel.grid(False)
            offset += face.num
        for panel in row[len(faces) :]:
            panel.set_axis_off()
    if picture is not None:
        figure.colorbar(picture, ax=panels, label="pairs with a motion, % of those possible")


def _ends(face: Face, box: Box) -> tuple[float, float, float, float]:
    (left, bottom), (right, top) = (
        (float(side[face.across[0]]), float(side[face.across[1]]))
        for side in (box.lower, box.upper)
    )
    return left, right, bottom, top
