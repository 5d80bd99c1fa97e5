"""Properties of all referees, which check plans: each plan is judged alone, also invalid ones."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import test_referee_block
import test_referee_catch
import test_referee_hit
import test_referee_intercept
from referees import assert_same, rows, stack

from planner_jax.referee import judging
from planner_jax.referee.judging import NOT_FINITE, cut

MODULES = (test_referee_block, test_referee_catch, test_referee_hit, test_referee_intercept)
RUNS = [(module, options) for module in MODULES for options in getattr(module, "OPTIONS", ({},))]
VALUES = (1e300, -1e30, np.inf)


@pytest.fixture(params=RUNS, ids=lambda run: f"{run[0].__name__[13:]}{'+' * len(run[1])}")
def judged(request):
    module, options = request.param
    return module, lambda leaves, **more: module.judge(leaves, **options | more)


@pytest.mark.parametrize("chunk", [1, 4, 512])
def test_batch_equals_loop(judged, chunk, monkeypatch):
    tests, judge = judged
    lanes = tests.unequal_lanes()
    with monkeypatch.context() as patch:
        patch.setattr(judging, "cut", lambda num, size: cut(num, min(size, chunk)))
        batch = judge(stack(*lanes))
    for i, lane in enumerate(lanes):
        assert_same(rows(judge(lane)), rows(batch, slice(i, i + 1)))
    if judge(lanes[0]).success[0]:
        np.testing.assert_array_equal(batch.failed_limit, tests.FAILED)


def test_a_nan_fails_its_own_lane_and_no_other(judged):
    tests, judge = judged
    lane, unread = tests.unequal_lanes()[0], getattr(tests, "UNREAD", ())
    names = [k for k, leaf in lane.items() if leaf.dtype.kind == "f" and k not in unread]
    assert len(names) > 15
    leaves = stack(*[lane] * (2 * len(names)))
    for k, name in enumerate(names):
        leaves[name][(2 * k, *[0] * (leaves[name].ndim - 1))] = np.nan
    verdict = judge(leaves)
    clean, broken = slice(1, None, 2), slice(0, None, 2)
    assert not verdict.success[broken].any()
    np.testing.assert_array_equal(verdict.failed_limit[broken], "not finite")
    assert verdict.sentence(0) == f"not finite: {NOT_FINITE}"
    for name in getattr(tests, "UNKNOWN", ()):
        assert np.isnan(getattr(verdict, name)[broken]).all()
    assert_same(rows(judge(stack(*[lane] * len(names)))), rows(verdict, clean))


def test_the_sentence_on_one_plan_needs_no_index_and_on_a_batch_an_index(judged):
    tests, judge = judged
    lanes = tests.unequal_lanes()
    batch = judge(stack(*lanes))
    one = type(batch)(**{name: value[0] for name, value in vars(batch).items()})
    assert one.sentence() == one.sentence(0) == batch.sentence(0) == batch.sentence(np.int64(0))
    with pytest.raises(IndexError, match=r"a single plan has the index 0, got k = 1$"):
        one.sentence(1)
    with pytest.raises(IndexError, match=rf"on {len(lanes)} plans needs its index, got k = None$"):
        batch.sentence()


def test_absurd_numbers_fail_without_a_warning(judged):
    tests, judge = judged
    pairs = [(name, value) for name in tests.ABSURD for value in VALUES]
    leaves = stack(*[tests.unequal_lanes()[0]] * len(pairs))
    for k, (name, value) in enumerate(pairs):
        leaves[name][k] = value
    harmless = getattr(tests, "HARMLESS", "")
    passed = [name == harmless and np.isfinite(value) for name, value in pairs]
    np.testing.assert_array_equal(judge(leaves).success, passed)


def test_float32_arrays_of_jax_are_taken_as_they_are(judged):
    tests, judge = judged
    kinds = {"f": jnp.float32, "i": jnp.int32, "b": bool}
    lanes = stack(tests.unequal_lanes()[0], tests.good())
    verdict = judge({k: jnp.asarray(leaf, kinds[leaf.dtype.kind]) for k, leaf in lanes.items()})
    np.testing.assert_array_equal(verdict.failed_limit, judge(lanes).failed_limit)
    dtypes = {value.dtype for value in rows(verdict).values() if value.dtype.kind == "f"}
    assert dtypes == {np.dtype(float)}


def test_an_empty_batch_has_an_empty_verdict(judged):
    tests, judge = judged
    verdict = judge({name: leaf[:0] for name, leaf in tests.good().items()})
    assert {len(value) for value in rows(verdict).values()} == {0}


@pytest.mark.parametrize(
    ("tests", "changes", "options", "says"),
    [(module, *wrong) for module in MODULES for wrong in module.WRONG],
)
def test_wrong_arguments_are_named(tests, changes, options, says):
    with pytest.raises(ValueError, match=says) as caught:
        tests.judge(tests.good() | changes, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("tests", "key"), [(module, key) for module in MODULES for key in module.FAILURES]
)
def test_every_failure_has_its_limit_size_and_time(tests, key):
    leaves, found, accepted = tests.FAILURES[key]
    tests.assert_fails(leaves, key.split(":")[0], **found)
    for options in accepted:
        tests.assert_good(leaves, **options)


@pytest.mark.parametrize("tests", MODULES)
def test_every_limit_has_its_sentence(tests):
    kind = tests.judge.__annotations__["return"]
    names = tuple(kind.SENTENCES)
    blank = {field.name: np.zeros(len(names)) for field in dataclasses.fields(kind)}
    verdict = kind(**blank | {"failed_limit": np.array(names)})
    for lane, name in enumerate(names):
        assert verdict.sentence(lane).startswith(f"{name}: ")
