"""Helpers for tests of the referees, which check plans in float64 independently of planners."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.polynomial import Polynomial


def tree(leaves, root="", **optional):
    inside = {k.removeprefix(root): v for k, v in leaves.items() if k.startswith(root)}
    parts = {k.split(".")[0] for k in inside if "." in k}
    plain = {k: v for k, v in inside.items() if "." not in k}
    nested = {part: tree(inside, f"{part}.") for part in parts}
    return SimpleNamespace(**optional | plain | nested)


def flight(leaves, **optional):
    case = tree(leaves, extras=(), **optional)
    limits = dict.fromkeys(("acceleration", "min_thrust", "max_thrust", "rotors", "max_tilt"))
    limits |= {"recovery_tilt": None, "air": None}
    case.limits = SimpleNamespace(**limits | vars(case.limits))
    case.trajectory = SimpleNamespace(coeffs=case.coeffs, durations=case.durations)
    case.recovery = case.heading = None
    return case


def cut(path, durations, degree=7):
    coeffs = np.zeros((len(durations), degree + 1, 3))
    for piece, start in enumerate(np.cumsum(durations) - durations):
        for axis, line in enumerate(path):
            powers = line(Polynomial([start, 1.0])).coef
            coeffs[piece, : len(powers), axis] = powers
    return coeffs


def edit(leaves, edits):
    """Change arrays `leaves` in place by a dict `edits`, and return all arrays.

    A key of `edits` is the name of an array, or (name, *index) for its entry [0, *index]. The
    replacement is a value, or a function of the old value.
    """
    for key, change in edits.items():
        name, *index = [key] if isinstance(key, str) else key
        leaf, entry = leaves[name], (0, *index) if index else ...
        leaf[entry] = change(leaf[entry]) if callable(change) else change
    return leaves


def add(value):
    return lambda leaf: leaf + value


def failure(leaves, excess=None, time=None, *accepted, **found):
    return leaves, {"excess": excess, "time": time, **found}, accepted


def stack(*lanes):
    return {name: np.concatenate([lane[name] for lane in lanes]) for name in lanes[0]}


def rows(verdict, lanes=slice(None)):
    return {name: value[lanes] for name, value in vars(verdict).items()}


def assert_same(left, right):
    """Assert that two verdicts are equal: floating-point numbers to 1e-12, other fields exactly."""
    for name, value in left.items():
        if value.dtype.kind == "f":
            np.testing.assert_allclose(value, right[name], rtol=1e-12, atol=1e-12, err_msg=name)
        else:
            np.testing.assert_array_equal(value, right[name], err_msg=name)


def checks(judge):
    def assert_good(leaves, **options):
        verdict = judge(leaves, **options)
        assert verdict.success[0], verdict.sentence(0)
        return verdict

    def assert_fails(
        leaves, name, *, excess=None, time=None, rel=1e-6, apart=1e-9, says="", **options
    ):
        verdict = judge(leaves, **options)
        assert not verdict.success[0] and verdict.failed_limit[0] == name, verdict.sentence(0)
        assert verdict.sentence(0).startswith(f"{name}: ") and says in verdict.sentence(0)
        if excess is not None:
            assert verdict.failed_excess[0] == pytest.approx(excess, rel=rel, abs=1e-9)
        if time is not None:
            assert verdict.failed_time[0] == pytest.approx(time, abs=apart)
        return verdict

    return assert_good, assert_fails
