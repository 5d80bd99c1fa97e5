"""Files of plans: written whole, read as they were, and refused in one line if they are not."""

import json
import zipfile

import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.plan_files import PlanFileError
from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.hit.plan import HitPlan


@pytest.fixture(scope="module")
def plans():
    """Three plans that nobody has to make."""
    lanes = np.arange(3.0, dtype=np.float32)
    vectors = np.stack([lanes, -lanes, lanes / 3.0], axis=1)
    return HitPlan(
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


def rewritten(path, change):
    """The file with its arrays changed."""
    with np.load(path) as file:
        arrays = dict(file)
    change(arrays)
    with path.open("wb") as file:
        np.savez(file, **arrays)
    return path


def header(**fields):
    return np.array(json.dumps({"version": 1, "class": "HitPlan", **fields}))


def assert_refused(kind, path, says):
    with pytest.raises(PlanFileError, match=says) as caught:
        kind.load(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_what_is_read_is_what_was_written_bit_for_bit(plans, path):
    again = HitPlan.load(str(path))
    assert jax.tree.structure(again) == jax.tree.structure(plans)
    for ours, theirs in zip(jax.tree.leaves(again), jax.tree.leaves(plans), strict=True):
        assert isinstance(ours, np.ndarray) and ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)


def test_the_file_has_the_name_that_was_asked_for_and_nothing_is_left_beside_it(path):
    assert [file.name for file in path.parent.iterdir()] == ["three"]


def test_numpy_alone_reads_the_arrays_by_the_names_of_their_places(plans, path):
    with np.load(path, allow_pickle=False) as file:
        assert {"cost", "status", "trajectory.coeffs", "stroke.ball_vel_after"} < set(file)
        np.testing.assert_array_equal(file["stroke.normal"], plans.stroke.normal)
        assert json.loads(str(file["header"])) == {"version": 1, "class": "HitPlan"}


def test_jax_arrays_and_single_plans_are_written_too(plans, tmp_path):
    one = pj.take(jax.tree.map(jax.numpy.asarray, plans), 1)
    one.save(tmp_path / "one.npz")
    again = HitPlan.load(tmp_path / "one.npz")
    assert again.cost.shape == () and again.status == 1


def test_a_write_that_fails_leaves_the_old_file_as_it_was(plans, path):
    before = path.read_bytes()
    with pytest.raises(OSError):
        plans.save(path.parent / "no folder" / "plans")
    with pytest.raises(TypeError, match="^cost must be an array of numbers, got object$"):
        plans.replace(cost=object()).save(path)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["three"]


def test_a_file_that_is_not_there_or_is_a_folder(tmp_path):
    assert_refused(HitPlan, tmp_path / "nothing", "path must be a file of plans, got")
    assert_refused(HitPlan, tmp_path, "path must be a whole file of plans, got")


@pytest.mark.parametrize(
    "content", [b"", b"serve,landing\n1,2\n", b"PK\x03\x04 and no more", b"\x93NUMPY\x01\x00"]
)
def test_a_file_of_something_else(tmp_path, content):
    path = tmp_path / "other"
    path.write_bytes(content)
    assert_refused(HitPlan, path, "path must be a whole file of plans, got")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95, 0.999])
def test_a_file_that_is_cut_off(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert_refused(HitPlan, path, "path must be a whole file of plans, got")


def test_a_file_with_a_byte_that_has_changed(path):
    with zipfile.ZipFile(path) as file:
        place = file.getinfo("trajectory.coeffs.npy").header_offset + 400
    content = bytearray(path.read_bytes())
    content[place] ^= 0xFF
    path.write_bytes(content)
    assert_refused(HitPlan, path, "path must be a whole file of plans, got .*BadZipFile")


def test_a_single_array(tmp_path):
    path = tmp_path / "array.npy"
    np.save(path, np.zeros(3))
    assert_refused(HitPlan, path, "path must be a whole file of plans, got")


def test_arrays_without_a_header_or_with_a_strange_one(path):
    for strange in ("no json", "[1, 2]", "3", '{"version": 1}'):
        rewritten(path, lambda arrays, text=strange: arrays.update(header=np.array(text)))
        assert_refused(HitPlan, path, "path must be a whole file of plans, got")
    rewritten(path, lambda arrays: arrays.pop("header"))
    assert_refused(HitPlan, path, "path must be a whole file of plans, got")


@pytest.mark.parametrize("kind", [CatchPlan, QuadrotorPlan, pj.Plan])
def test_a_file_of_another_class(path, kind):
    says = f"path must be a file of {kind.__name__} of version 1, got HitPlan of version 1 in"
    assert_refused(kind, path, says)


def test_a_file_of_another_version(path):
    rewritten(path, lambda arrays: arrays.update(header=header(version=2)))
    assert_refused(HitPlan, path, "of HitPlan of version 1, got HitPlan of version 2 in")


@pytest.mark.parametrize("name", ["cost", "stroke.normal", "trajectory.durations"])
def test_a_field_that_is_missing_is_named(path, name):
    rewritten(path, lambda arrays: arrays.pop(name))
    assert_refused(HitPlan, path, f"path must hold {name}, got")


def test_an_array_too_many_is_named(path):
    rewritten(path, lambda arrays: arrays.update(wind=np.zeros(3)))
    assert_refused(HitPlan, path, "path must not hold wind, got")


class Trap:
    """Says when it is unpickled."""

    sprung: list = []

    def __reduce__(self):
        return Trap.sprung.append, (1,)


@pytest.mark.parametrize("name", ["cost", "header"])
def test_a_file_is_never_unpickled(path, name):
    rewritten(path, lambda arrays: arrays.update({name: np.array([Trap()], object)}))
    assert_refused(HitPlan, path, "path must be a whole file of plans, got .*ValueError")
    assert not Trap.sprung
