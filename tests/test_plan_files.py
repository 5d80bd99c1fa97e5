"""Files of plans: written whole, read bit for bit, and rejected in one line if damaged."""

import json
import struct
import zipfile

import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core import plan_files
from planner_jax.core.plan_files import PlanFileError
from planner_jax.robot.quadrotor import QuadrotorPlan
from tests.trees import assert_same


@pytest.fixture(scope="module")
def plans():
    lanes = np.arange(3.0, dtype=np.float32)
    vectors = np.stack([lanes, -lanes, lanes / 3.0], axis=1)
    return pj.hit.HitPlan(
        cost=lanes,
        violation=-lanes,
        iterations=np.arange(3, dtype=np.int32),
        status=np.array([0, 1, 4], np.int32),
        trajectory=pj.PiecewisePolynomial(
            coeffs=np.arange(144.0).reshape(3, 2, 8, 3), durations=np.full((3, 2), np.nan)
        ),
        gravity=np.full(3, 9.8, np.float32),
        stroke=pj.hit.Stroke(lanes, vectors, vectors, vectors, vectors, lanes),
    )


@pytest.fixture
def path(plans, tmp_path):
    path = tmp_path / "three"
    plans.save(path)
    return path


def rewrite(path, change):
    with np.load(path) as file:
        arrays = dict(file)
    change(arrays)
    with path.open("wb") as file:
        np.savez(file, **arrays)


def assert_rejected(path, rule, kind=pj.hit.HitPlan):
    with pytest.raises(PlanFileError, match=rule) as caught:
        kind.load(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_plans_are_read_as_written_bit_for_bit(plans, path):
    assert [file.name for file in path.parent.iterdir()] == ["three"]
    again = pj.hit.HitPlan.load(str(path))
    assert jax.tree.structure(again) == jax.tree.structure(plans)
    assert_same(again, plans)


def test_numpy_reads_the_arrays_by_dotted_names(plans, path):
    with np.load(path, allow_pickle=False) as file:
        assert {"cost", "status", "trajectory.coeffs", "stroke.ball_vel_after"} < set(file)
        np.testing.assert_array_equal(file["stroke.normal"], plans.stroke.normal)
        assert json.loads(str(file["header"])) == {"version": 1, "class": "HitPlan"}


def test_jax_arrays_and_single_plans_are_written_too(plans, tmp_path):
    one = pj.take(jax.tree.map(jax.numpy.asarray, plans), 1)
    one.save(tmp_path / "one.npz")
    again = pj.hit.HitPlan.load(tmp_path / "one.npz")
    assert again.cost.shape == () and again.status == 1


def test_a_failed_write_leaves_the_old_file_unchanged(plans, path):
    before = path.read_bytes()
    with pytest.raises(OSError):
        plans.save(path.parent / "no folder" / "plans")
    with pytest.raises(TypeError, match="^cost must be an array of numbers, got object$"):
        plans.replace(cost=object()).save(path)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["three"]


DAMAGED = "path must be a whole file of plans, got"


@pytest.mark.parametrize(
    "content", [b"", b"serve,landing\n1,2\n", b"PK\x03\x04 and no more", b"\x93NUMPY\x01\x00"]
)
def test_a_file_with_other_content_is_rejected(tmp_path, content):
    path = tmp_path / "other"
    path.write_bytes(content)
    assert_rejected(path, DAMAGED)
    np.save(path.with_suffix(".npy"), np.zeros(3))
    assert_rejected(path.with_suffix(".npy"), DAMAGED)
    assert_rejected(tmp_path, DAMAGED)
    assert_rejected(tmp_path / "nothing", "path must be a file of plans, got")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95, 0.999])
def test_a_truncated_file_is_rejected(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert_rejected(path, DAMAGED)


def test_a_file_with_a_changed_byte_is_rejected(path):
    with zipfile.ZipFile(path) as file:
        offset = file.getinfo("trajectory.coeffs.npy").header_offset + 400
    content = bytearray(path.read_bytes())
    content[offset] ^= 0xFF
    path.write_bytes(content)
    assert_rejected(path, f"{DAMAGED} .*BadZipFile")


def test_a_missing_or_malformed_header_is_rejected(path):
    rewrite(path, lambda arrays: arrays.pop("header"))
    assert_rejected(path, DAMAGED)
    for header in ("no json", "[1, 2]", "3", '{"version": 1}'):
        rewrite(path, lambda arrays, header=header: arrays.update(header=np.array(header)))
        assert_rejected(path, DAMAGED)


def test_a_file_of_another_class_or_version_is_rejected(path):
    for kind in (pj.catch.CatchPlan, QuadrotorPlan, pj.Plan):
        rule = f"path must be a file of {kind.__name__} of version 1, got HitPlan of version 1 in"
        assert_rejected(path, rule, kind)
    header = np.array(json.dumps({"version": 2, "class": "HitPlan"}))
    rewrite(path, lambda arrays: arrays.update(header=header))
    assert_rejected(path, "of HitPlan of version 1, got HitPlan of version 2 in")


@pytest.mark.parametrize("name", ["cost", "stroke.normal", "trajectory.durations"])
def test_a_missing_field_and_an_unknown_array_are_named(path, name):
    rewrite(path, lambda arrays: arrays.update(wind=np.zeros(3)))
    assert_rejected(path, "path must not hold wind, got")
    rewrite(path, lambda arrays: arrays.pop(name))
    assert_rejected(path, f"path must hold {name}, got")


def test_arrays_and_files_above_a_size_are_neither_written_nor_decoded(plans, path, monkeypatch):
    large = plans.replace(cost=np.zeros(1 << 20, np.float32))
    before = path.read_bytes()
    with path.open("wb") as file:
        header = np.array(json.dumps({"version": 1, "class": "HitPlan"}))
        np.savez_compressed(file, header=header, cost=large.cost)
    assert path.stat().st_size < 1 << 14
    monkeypatch.setattr(plan_files, "LARGEST", 1 << 21)
    assert_rejected(path, r"whole file of plans, got .*its arrays are larger than 2097152 bytes")
    with pytest.raises(
        pj.ArgumentError, match="^plans must be of at most 1048576 bytes; save parts"
    ):
        large.save(path.with_name("large"))
    monkeypatch.setattr(plan_files, "LARGEST", 1 << 10)
    path.write_bytes(before)
    assert_rejected(path, r"whole file of plans, got .*it is larger than 1024 bytes")


def test_a_directory_of_millions_of_members_is_not_read(path):
    content = path.read_bytes()
    start, end = content.index(b"PK\1\2"), content.index(b"PK\5\6")
    entries = 2_000_000 * (end - start)
    for second in (b"", struct.pack("<LLQL", 0x07064B50, 0, start, 1)):  # a hidden directory
        size = entries if not second else 9
        last = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 9, 9, size, start, 0)
        path.write_bytes(content[:end] + second + last)
        assert_rejected(path, f"{DAMAGED} .*BadZipFile")


class Trap:
    sprung: list = []

    def __reduce__(self):
        return Trap.sprung.append, (1,)


@pytest.mark.parametrize("name", ["cost", "header"])
def test_a_file_is_never_unpickled(path, name):
    rewrite(path, lambda arrays: arrays.update({name: np.array([Trap()], object)}))
    assert_rejected(path, f"{DAMAGED} .*ValueError")
    assert not Trap.sprung
