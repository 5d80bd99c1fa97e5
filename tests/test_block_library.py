import dataclasses
import json
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.ball.flight import drag_free_flight
from planner_jax.baselines.block.library import build as building
from planner_jax.baselines.block.library import cells, command, table
from planner_jax.baselines.block.library.cells import LAYOUTS, Face, Layout, tunnels
from planner_jax.baselines.block.library.coverage import check, coverage
from planner_jax.baselines.block.library.file import load_library, save_library
from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.baselines.block.library.table import Setting, library_of, pack_rows
from planner_jax.benchmarks.block_library import OneBall
from planner_jax.cli.main import main
from planner_jax.core import GRAVITY
from planner_jax.core.errors import ArgumentError
from planner_jax.robot.arm import REGIMES
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_motion import profiles
from planner_jax.robot.arm_scene import Box, paper_scene
from tests.trees import assert_same

TINY = Layout((Face(0, 1, (2, 2)), Face(2, 1, (1, 2))), (Face(0, 1, (2, 2)),))
PIECES = 4


def setting(regime="R2", **scene):
    chosen: Any = REGIMES[regime]
    at_rest: Any = np.asarray(chosen.ends_at_rest)
    return Setting(irb1600(), chosen.limits, at_rest, dataclasses.replace(paper_scene(), **scene))


def make_library(layout=TINY, regime="R2", homes=1):
    num = layout.num_pairs
    shape = profiles(PIECES, True)[0]
    turn = 1e-4 * (1.0 + np.arange(homes)[:, None] * num + np.arange(num))
    steps = shape[:, None] * turn[..., None, None] * np.ones(6)
    home = irb1600().home + 0.1 * np.arange(homes, dtype=np.float32)[:, None]
    duration = np.full((homes, num), 0.4)
    duration[:, -1] = np.inf
    middle, normal, edge = (0.7, 0.0, 0.9), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    vectors = (np.broadcast_to(each, (homes, num, 3)) for each in (middle, normal, edge))
    row: Any = table.Row(steps, duration, *vectors)  # type: ignore[arg-type]
    return library_of(pack_rows(row), home, layout, setting(regime))


def tunnels_of(layout):
    scene = paper_scene()
    return tunnels(layout, scene.inner, scene.outer)


def ball_through(outer, inner, speed=8.0, before=0.6):
    outer, inner = np.asarray(outer), np.asarray(inner)
    span = np.linalg.norm(inner - outer) / speed
    vel = (inner - outer) / span + np.array([0.0, 0.0, 0.5 * GRAVITY * span])
    away = np.array([0.0, 0.0, -0.5 * GRAVITY * before**2])
    return outer - vel * before + away, vel + np.array([0.0, 0.0, GRAVITY * before])


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_point_of_a_cell_is_in_that_cell(name):
    layout, scene, tunnel = LAYOUTS[name], paper_scene(), tunnels_of(LAYOUTS[name])
    rng = np.random.default_rng(0)
    behind: Any = Box(jnp.array([3.0, 0.0, 0.0]), jnp.array([4.0, 1.0, 1.0]))
    whole = tunnels(dataclasses.replace(layout, inner=(Face(0, -1, (1, 1)),)), behind, scene.outer)
    sides = (
        (layout.inner, scene.inner, tunnel.inner[: layout.num_inner]),
        (layout.outer, scene.outer, whole.outer),
    )
    for faces, box, corners in sides:
        assert len(corners) == sum(face.num for face in faces)
        share = rng.uniform(size=(len(corners), 3))
        points = corners[:, 0] + share * (corners[:, 1] - corners[:, 0])
        at = jax.jit(jax.vmap(lambda p: cells.cell_of(faces, box, tuple(p))))  # noqa: B023
        own, found = at(points)
        assert found.all()
        np.testing.assert_array_equal(own, np.arange(len(corners)))


def test_points_on_edges_are_in_exactly_one_cell():
    box = paper_scene().outer
    at = jax.jit(lambda point: cells.cell_of(TINY.outer, box, tuple(point)))
    assert at(jnp.array([1.0, 0.0, 0.9])) == (2, True)  # On a common edge, greater y counts.
    assert at(jnp.array([1.0, 0.0, 0.9250001])) == (3, True)
    assert at(jnp.array([1.0, 0.3, 1.85])) == (3, True)  # On a box edge, the x face counts.
    assert at(jnp.array([0.999, 0.3, 1.85])) == (5, True)
    assert at(jnp.array([1.0, 1.0, 0.1])) == (2, True)
    assert not at(jnp.array([0.3, 1.0, 0.1]))[1]  # no cells on +y
    assert not at(jnp.array([-1.0, 0.3, 0.1]))[1]
    assert not at(jnp.array([jnp.nan, 0.3, 0.1]))[1]


def test_tunnels_are_cut_off_where_no_ball_can_come_from():
    layout, tunnel = LAYOUTS["full"], tunnels_of(LAYOUTS["full"])
    assert len(tunnel.outer) == layout.num_pairs == 21504
    assert (tunnel.is_feasible | ~tunnel.is_centred).all()
    face = (np.arange(layout.num_pairs) % layout.num_inner) // 28
    for place, (axis, side) in enumerate(((0, 1), (1, 1), (1, -1))):
        here = tunnel.is_feasible & (face == place)
        ahead = side * tunnel.outer[here][..., axis]
        assert ahead.min() >= 0.4 - 1e-6 and here.any()
        behind = side * tunnel.outer[~tunnel.is_feasible & (face == place)][..., axis]
        assert behind.max() <= 0.4 + 1e-6
    # Share of pairs (cell of the outer box, cell of the inner box) for which a ball that starts in
    # the middle of the outer cell can pass the inner cell.
    for name, share in (("A", 0.375), ("B", 11 / 24)):
        assert tunnels_of(LAYOUTS[name]).is_centred.mean() == pytest.approx(share)


def test_a_shield_as_large_as_the_farthest_crossing_blocks_the_tunnel():
    rng, tunnel = np.random.default_rng(1), tunnels_of(LAYOUTS["D"])
    pair = rng.choice(np.flatnonzero(tunnel.is_centred))
    outer, inner = jnp.asarray(tunnel.outer[pair]), jnp.asarray(tunnel.inner[pair])
    ball, span = cells.nominal_ball(outer, inner)
    there = drag_free_flight(ball, 0.5 * span, jnp.asarray(GRAVITY))
    normal = -there.vel / np.linalg.norm(there.vel)
    side = np.cross(normal, (0.0, 0.0, 1.0))
    side /= np.linalg.norm(side)
    rotation = jnp.stack([normal, side, jnp.cross(normal, side)], axis=1)
    far = float(cells.farthest_crossing(outer, inner, there.pos, rotation))
    begin, end = (
        corners[0] + rng.uniform(size=(20000, 3)).round() * (corners[1] - corners[0])
        for corners in (np.asarray(outer), np.asarray(inner))
    )
    share = np.linspace(0.0, 1.0, 2001)[:, None]
    reached = []
    for a, b in zip(begin[:64], end[:64], strict=True):
        way = a + share * (b - a)
        way[:, 2] += 0.5 * GRAVITY * (share * (1.0 - share))[:, 0] * float(span) ** 2
        beside = (way - there.pos) @ rotation
        reached.append(np.abs(beside[np.abs(beside[:, 0]).argmin(), 1:]).max())
    assert max(reached) == pytest.approx(far, abs=4e-3)
    behind = there.pos + 2.0 * (inner.mean(axis=0) - there.pos)
    assert np.isinf(cells.farthest_crossing(outer, inner, behind, rotation))


def test_a_lookup_returns_the_stored_motion_and_its_contact():
    library, tunnel = make_library(homes=2), tunnels_of(TINY)
    pairs = np.flatnonzero(tunnel.is_feasible)[:-1]
    shots = [ball_through(tunnel.outer[p].mean(0), tunnel.inner[p].mean(0)) for p in pairs]
    planner = LibraryBlock(library)
    for home in range(2):
        angles = library.table.homes[home]
        cases = pj.block.case(*np.swapaxes(shots, 0, 1), angles=angles, anywhere=True)
        plans = pj.plan(planner, cases)
        np.testing.assert_allclose(plans.motion.coeffs[:, 1, 0], np.tile(angles, (len(pairs), 1)))
        turned = 1e-4 * (1 + home * TINY.num_pairs + pairs)
        ends = np.einsum("bkj,k->bj", plans.motion.coeffs[:, -1], [1.0, 0.1, 0.01])
        np.testing.assert_allclose(ends[:, 2] - angles[2], turned, rtol=2e-3)
        there = np.array([p + v * t for (p, v), t in zip(shots, plans.contact_time, strict=True)])
        np.testing.assert_allclose(there[:, 0], 0.7, atol=1e-5)
        np.testing.assert_allclose(plans.cost, 0.4)


def test_one_ball_gets_the_answer_of_a_batch():
    library = make_library(homes=2)
    cases = pj.block.draw(40, seed=2)
    of_many = jax.jit(jax.vmap(table.lookup, (None, 0, 0, None)))
    many = of_many(jax.device_put(library.table), cases.ball, cases.gravity, 1)
    one = OneBall(library, home=1)
    assert 0 < np.sum(many.stored) < 40
    for k in np.flatnonzero(many.stored):
        found = one.answer(cases.ball.pos[k], cases.ball.vel[k])
        assert (found.pair, found.stored) == (many.pair[k], True)
        np.testing.assert_array_equal(found.row.steps, many.row.steps[k])
        np.testing.assert_allclose(found.time, many.time[k], rtol=1e-6)
        np.testing.assert_allclose(
            np.array(found.beside), [each[k] for each in many.beside], atol=1e-5
        )
    missed = int(np.flatnonzero(~np.asarray(many.stored))[0])
    assert not one.answer(cases.ball.pos[missed], cases.ball.vel[missed]).stored


def test_statuses_name_the_reason_of_a_failure():
    library = make_library()
    # A stored motion blocks the first ball. The comments state why each other ball is missed.
    good = ball_through((1.0, 0.05, 1.2), (0.4, 0.05, 0.8))
    shots = [
        good,
        ball_through((1.0, 0.05, 1.2), (0.4, 0.05, 0.8), before=0.3),  # The ball arrives too soon.
        ball_through((1.0, 0.9, 1.2), (0.4, 0.05, 0.8)),  # The ball passes the shield.
        ball_through((0.1, 1.0, 1.2), (0.1, 0.4, 0.8)),  # no cells on +y
        ball_through((0.45, 0.5, 1.85), (0.4, 0.3, 0.8)),  # The last pair has no motion.
        (good[0], -good[1]),  # The ball flies away from the arm.
        good,  # A number is replaced by NaN below.
        good,
        good,
    ]
    angles = np.tile(irb1600().home, (len(shots), 1))
    angles[7, 2] += 1e-2  # The arm is not at its home pose.
    cases = pj.block.case(*np.swapaxes(shots, 0, 1), angles=angles, anywhere=True)
    cases = jax.tree.map(np.array, cases)
    cases.ball.pos[6] = np.nan
    cases.limits.velocity[8] *= 0.5
    S = pj.Status
    plans = jax.device_get(pj.plan(LibraryBlock(library), jax.tree.map(jnp.asarray, cases)))
    assert [S(int(s)) for s in plans.status] == [
        *(S.CONVERGED, S.INFEASIBLE, S.INFEASIBLE, S.OUT_OF_REACH, S.OUT_OF_REACH),
        *(S.OUT_OF_REACH, S.BAD_INPUT, S.BLOCKED, S.BLOCKED),
    ]
    strict = pj.block.case(*good)
    assert pj.plan(LibraryBlock(library), strict).status == S.INFEASIBLE


def test_motions_that_end_in_motion_wait_and_others_start_at_once():
    good = ball_through((1.0, 0.05, 1.2), (0.4, 0.05, 0.8))
    for regime in ("R1", "R3"):
        case = pj.block.case(*good, regime=regime, delay=0.05, anywhere=True)
        plan = pj.plan(LibraryBlock(make_library(regime=regime)), case)
        waits = plan.contact_time - 0.05 - 0.4
        assert waits > 0.1
        expected = waits if regime == "R1" else 0.0
        np.testing.assert_allclose(plan.motion.durations[0], expected, atol=1e-6)


def test_a_library_of_other_cases_is_rejected_with_both_hashes():
    planner = LibraryBlock(make_library())
    planner.check(pj.block.draw(2))
    with pytest.raises(ArgumentError, match=r"one of [0-9a-f]{12} for cases of [0-9a-f]{12}$"):
        planner.check(pj.block.draw(1, regime="R3"))
    with pytest.raises(ArgumentError, match="one of"):
        planner.check(pj.block.draw(1, "open"))
    with pytest.raises(ArgumentError, match="angles must be a home of the library"):
        planner.check(pj.block.case(np.ones(3), np.ones(3), angles=np.zeros(6)))


def test_a_file_holds_the_library_bit_for_bit(tmp_path):
    library, path = make_library(homes=2), tmp_path / "a.lib"
    save_library(path, library)
    again = load_library(path)
    assert_same(library, again)
    LibraryBlock(again).check(pj.block.draw(1))
    assert not list(tmp_path.glob("*.tmp"))


def assert_rejected(path, says):
    with pytest.raises(ArgumentError, match=says) as caught:
        load_library(path)
    assert "\n" not in str(caught.value)


def test_damaged_files_are_rejected_in_one_line(tmp_path):
    path = tmp_path / "a.lib"
    missing = "^library must be a file, got .* `planner-jax library build .*a.lib` makes one$"
    assert_rejected(path, missing)
    path.write_bytes(b"PK\x03\x04 something else\n")
    assert_rejected(path, "^library must be a file of a block library, got")
    save_library(path, make_library())
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    rule = f"^library must be a whole file of {len(whole)} bytes, got {len(whole) - 1} in"
    assert_rejected(path, rule)
    path.write_bytes(whole[:100])
    assert_rejected(path, "is cut off or damaged$")
    path.write_bytes(whole.replace(b"library 3 ", b"library 9 ", 1))
    assert_rejected(path, "^library must be of version 3, got version 9 in")
    path.write_bytes(b"planner-jax block library 2\n" + whole)
    assert_rejected(path, "^library must be of version 3, got version 2 in")
    at = whole.index(np.float32(0.806).tobytes())  # byte position of the pole's x coordinate
    path.write_bytes(whole[:at] + np.float32(0.7).tobytes() + whole[at + 4 :])
    assert_rejected(path, "is cut off or damaged in scene")


def test_every_flipped_bit_of_a_library_is_found(tmp_path):
    path = tmp_path / "a.lib"
    save_library(path, make_library())
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    header = whole.index(b"\n", whole.index(b"\n") + 1)
    places = {*range(40), header, len(whole) - 1, *rng.integers(0, len(whole), 400).tolist()}
    for place in sorted({*places, *rng.integers(0, header, 200).tolist()}):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        assert_rejected(path, "^library must")


def forge(whole, change, *blocks):
    """Return a library's bytes with a changed header, whose checksums fit, and blocks appended."""
    first, second, rest = whole.split(b"\n", 2)
    header = json.loads(second)
    change(header)
    second = json.dumps(header).encode() + b"\n"
    first = first[:-8] + f"{zlib.crc32(second):08x}\n".encode()
    return first + second + rest + b"".join(blocks)


def edit(*places, to):
    def change(header):
        inner = header
        for place in places[:-1]:
            inner = inner[place]
        inner[places[-1]] = to

    return change


@pytest.mark.parametrize(
    "change",
    [
        edit("arrays", "homes", 0, to="|O"),
        edit("arrays", "homes", 0, to="<f8"),
        edit("arrays", "rows", 0, to="<i4"),
        edit("arrays", "rows", 0, to=">f4"),
        edit("arrays", "rows", 0, to="<f2"),
        edit("arrays", "homes", 1, to=[2, 3]),
        edit("arrays", "homes", 1, to=[-1, -6]),
        edit("arrays", "homes", 1, to=[10**40, 10**40]),
        edit("arrays", "homes", 1, to="no shape"),
        edit("arrays", "homes", 1, to=[1.5]),
        edit("arrays", "homes", to=3),
        edit("arrays", to=[]),
        edit("arrays", "more", to=["|b1", [0], 0]),
        edit("layout", "outer", 0, "axis", to=7),
        edit("layout", "outer", 0, "side", to="x"),
        edit("layout", "outer", 0, "cells", to=[2, -2]),
        edit("layout", "outer", to=[]),
        edit("layout", to=None),
        edit("arm", to={}),
        edit("fingerprint", to="0" * 12),
        lambda header: header.pop("fingerprint"),
        lambda header: header["arrays"].pop("homes"),
    ],
)
def test_a_forged_header_is_rejected_before_its_arrays_are_used(tmp_path, change):
    path = tmp_path / "a.lib"
    save_library(path, make_library())
    path.write_bytes(forge(path.read_bytes(), change))
    assert_rejected(path, "^library must")


@pytest.fixture
def counted(monkeypatch):
    calls = []

    def plan_pairs(setting, home, tunnel, pairs, old=None):
        calls.append(np.array(pairs))
        row = np.zeros((len(pairs), 70), np.float32)
        row[:, 0], row[:, 1], row[:, 60] = pairs, home[0], 0.3
        row[pairs % 7 == 0, 60] = np.inf
        return row

    monkeypatch.setattr(building, "plan_pairs", plan_pairs)
    monkeypatch.setattr(building, "_ON_CPU", building.Portions(5, (16, 16), 1))
    return calls


@pytest.mark.parametrize("kind", ["folder", "link", "own"])
def test_a_build_deletes_no_files_of_others_beside_the_library(tmp_path, counted, kind):
    parts, victim = tmp_path / "v.lib.parts", tmp_path / "victim"
    given = (setting(), np.array([irb1600().home]), TINY)
    (parts if kind != "link" else victim).mkdir()
    if kind == "link":
        parts.symlink_to(victim)
    (parts / "thesis.txt").write_text("mine")
    (parts / "sub").mkdir()
    if kind == "own":  # the parts of an interrupted build, to which the user has added files
        header = dict.fromkeys(("version", "fingerprint", "homes", "layout", "device"))
        (parts / "what.json").write_text(json.dumps(header))
        (parts / "00000.npy").write_bytes(b"of another build")
        building.build(tmp_path / "v.lib", *given, progress=False)
        assert load_library(tmp_path / "v.lib").found.any()
    else:
        with pytest.raises(ArgumentError, match="^library must be a path beside which v.lib.parts"):
            building.build(tmp_path / "v.lib", *given, progress=False)
    assert sorted(path.name for path in parts.iterdir()) == ["sub", "thesis.txt"]
    assert (parts / "thesis.txt").read_text() == "mine"


def test_a_resumed_build_gives_the_same_library(tmp_path, counted, monkeypatch):
    homes = np.stack([irb1600().home, irb1600().home])
    homes[1, 0] += 0.1
    given = (setting(), homes, TINY)
    whole = building.build(tmp_path / "whole", *given, progress=False)
    num, plain = len(counted), building.plan_pairs

    def stop(*arguments):
        if len(counted) == num + 3:
            raise KeyboardInterrupt
        return plain(*arguments)

    monkeypatch.setattr(building, "plan_pairs", stop)
    with pytest.raises(KeyboardInterrupt):
        building.build(tmp_path / "cut", *given, progress=False)
    assert not (tmp_path / "cut").exists()
    monkeypatch.setattr(building, "plan_pairs", plain)
    building.build(tmp_path / "cut", *given, progress=False)
    assert len(counted) == 2 * num
    assert (tmp_path / "cut").read_bytes() == (tmp_path / "whole").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut", "whole"]
    feasible = tunnels_of(TINY).is_feasible
    pairs = np.arange(TINY.num_pairs)
    np.testing.assert_array_equal(whole.found[0], feasible & (pairs % 7 > 0))
    first = np.asarray(whole.table.rows)[1, whole.found[1], 1]
    np.testing.assert_array_equal(first, homes[1, 0].astype(np.float32))


def test_parts_of_another_library_are_discarded(tmp_path, counted, monkeypatch):
    parts = tmp_path / "a.parts"
    plain = building.plan_pairs
    monkeypatch.setattr(building, "save_library", lambda *_: (_ for _ in ()).throw(OSError))
    home = irb1600().home
    with pytest.raises(OSError):
        building.build(tmp_path / "a", setting("R2"), home, TINY, progress=False)
    kept, num = len(list(parts.glob("*.npy"))), len(counted)
    assert kept == num
    monkeypatch.undo()
    monkeypatch.setattr(building, "plan_pairs", plain)
    monkeypatch.setattr(building, "_ON_CPU", building.Portions(5, (16, 16), 1))
    building.build(tmp_path / "a", setting("R3"), home, TINY, progress=False)
    assert len(counted) == 2 * num


def test_a_repair_plans_only_motions_that_collide(counted, monkeypatch):
    library = make_library(LAYOUTS["A"])
    pairs = np.arange(LAYOUTS["A"].num_pairs)
    hit = (pairs % 100 == 3) & library.found[0]
    monkeypatch.setattr(building, "_is_free", lambda *_: ~hit[library.found[0]])
    rows = np.pad(library.table.rows, ((0, 0), (0, 0), (0, 36)))  # The stub's rows are as long.
    library = library_of(rows, library.table.homes, LAYOUTS["A"], library.setting)
    stored = property(lambda self: np.isfinite(self.table.rows[..., 6 * PIECES]))
    monkeypatch.setattr(type(library), "found", stored)
    scene = paper_scene(pole=(0.806, -0.1))
    fixed, touched = building.repair(library, scene, progress=False)
    np.testing.assert_array_equal(touched[0], hit)
    np.testing.assert_array_equal(np.sort(np.concatenate(counted)), pairs[hit])
    np.testing.assert_array_equal(fixed.table.rows[0, ~hit], rows[0, ~hit])
    assert (fixed.table.rows[0, hit, 0] == pairs[hit]).all()
    assert fixed.setting.scene is scene
    counted.clear()
    _, touched = building.repair(library, scene, retry=True, progress=False)
    feasible = tunnels_of(LAYOUTS["A"]).is_feasible
    np.testing.assert_array_equal(touched[0], hit | (feasible & ~library.found[0]))


def test_a_repair_needs_the_same_boxes():
    scene = paper_scene()
    other = dataclasses.replace(scene, inner=Box(scene.inner.lower, 0.9 * scene.inner.upper))
    with pytest.raises(ValueError, match="^scene.inner must be the library's, got another box$"):
        building.repair(make_library(), other)


def test_a_home_in_collision_is_rejected(tmp_path):
    home = irb1600().home.copy()
    home[1] = 1.9
    with pytest.raises(ValueError, match="^homes must be free, got -.* m to .* at home 0$"):
        building.build(tmp_path / "a", setting(), home, TINY)
    with pytest.raises(ValueError, match="^homes must be free"):
        building.repair(make_library(), paper_scene(pole=(0.806, 0.1)))  # at the forearm


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"layout": "E"}, "^layout must be one of full, A, B, C, D, got 'E'$"),
        ({"regime": "R4"}, "^regime must be one of R1, R2, R3, got 'R4'$"),
        ({"arm": "none.xml"}, "^arm must be an MJCF or URDF file, got 'none.xml' \\(No such"),
        ({"home": [0.0] * 7}, "^home must be six angles for each home, got 7 numbers$"),
    ],
)
def test_invalid_builds_are_rejected(options, says, tmp_path):
    with pytest.raises(ArgumentError, match=says):
        command.build_library(str(tmp_path / "a"), **options)


def test_the_command_line_shows_a_library_with_a_map_and_rejects_other_files(tmp_path, capsys):
    path, picture = tmp_path / "a.lib", tmp_path / "a.png"
    save_library(path, make_library())
    assert main(["library", "show", str(path), "--map", str(picture)]) == 0
    told = capsys.readouterr().out
    assert "Setting " in told and picture.stat().st_size > 10_000
    assert "24 pairs of cells, outer +x 2x2 +z 1x2; inner +x 2x2" in told
    with pytest.raises(ArgumentError, match=r"^pole must be finite, got \[0\.8, nan\]$"):
        command.repair_library(str(path), pole=[0.8, float("nan")], out=str(tmp_path / "b.lib"))
    for arguments in (
        ["library", "check", str(tmp_path / "b.lib")],
        ["sweep", "block", "--planner", f"library:{tmp_path / 'b.lib'}"],
        ["sweep", "block", "--planner", f"library:{path}", "--regime", "R1", "--num", "2"],
    ):
        assert main(arguments) == 2
        told = capsys.readouterr().err
        assert told.startswith("planner-jax: error: ") and told.count("\n") == 1


def test_a_planner_of_a_file_needs_the_file_and_others_take_none():
    with pytest.raises(ValueError, match="library:FILE, which `planner-jax library build FILE`"):
        pj.block.planner("library")
    with pytest.raises(ValueError, match="^planner must be online without a file, got 'online:x'$"):
        pj.block.planner("online:x")


@pytest.mark.slow
@pytest.mark.parametrize("regime, starts", [("R1", 1), ("R2", 1), ("R2", 16)])
def test_the_referee_confirms_a_built_library(regime, starts, tmp_path, monkeypatch):
    monkeypatch.setattr(building, "_ON_CPU", building.Portions(256, (16, 16), starts))
    path = tmp_path / "a.lib"
    layout = Layout((Face(0, 1, (4, 4)),), (Face(0, 1, (2, 2)),))
    home = irb1600().home
    library = building.build(path, setting(regime), home, layout, progress=False)
    covered = coverage(library)
    assert covered.share(covered.is_feasible)[0] >= 0.95
    found = check(library, 200)
    assert found.claimed.any()
    assert not (found.claimed & ~found.verdict.success).any()
    planner = pj.block.planner(f"library:{path}")
    plans = pj.plan(planner, found.cases)
    np.testing.assert_array_equal(pj.are_solved(plans), found.claimed)
    shifted: Any = np.array([0.8926, 0.05], np.float32)
    scene = paper_scene(pole=shifted)
    fixed, touched = building.repair(library, scene, progress=False)
    same = ~touched & library.found
    assert touched.any() and same.any()
    np.testing.assert_array_equal(fixed.table.rows[same], library.table.rows[same])
    again = check(fixed, 200)
    assert not (again.claimed & ~again.verdict.success).any()
    assert table.unpack_rows(fixed.table.rows).duration[fixed.found].max() < 3.0


def test_insat_builds_refereed_motions_and_continues_an_interrupted_build(tmp_path, monkeypatch):
    """Plan for three of all pairs. Any ball through two cells with a motion must be blocked."""
    layout, pairs, planned = LAYOUTS["A"], [1237, 2396, 3516], []
    tunnel = dataclasses.replace(
        tunnels_of(layout), is_feasible=np.isin(np.arange(layout.num_pairs), pairs)
    )
    plan_rows = building.plan_pairs_by_insat

    def plan_some(setting, home, tunnel, pairs):
        planned.extend(pairs)
        if len(planned) == 2:
            raise KeyboardInterrupt
        return plan_rows(setting, home, tunnel, pairs, budget=5.0)

    monkeypatch.setattr(building, "tunnels", lambda *args: tunnel)
    monkeypatch.setitem(building.PLANNERS, "insat", 1)
    monkeypatch.setattr(building, "plan_pairs_by_insat", plan_some)
    settings = tmp_path / "a.lib", setting("R1"), irb1600().home, layout
    with pytest.raises(KeyboardInterrupt):
        building.build(*settings, planner="insat", progress=False)
    library = building.build(*settings, planner="insat", progress=False)
    assert planned == [1237, 2396, 2396, 3516]
    assert_same(load_library(tmp_path / "a.lib").table, library.table)
    np.testing.assert_array_equal(np.flatnonzero(library.found[0]), pairs)
    found = check(library, 30)
    assert found.claimed.all() and found.verdict.success.all()
