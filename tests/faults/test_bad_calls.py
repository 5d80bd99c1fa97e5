"""Every bad call of the library is rejected with one line, before anything is compiled."""

import dataclasses
import os

import hypothesis
import jax
import numpy as np
import pytest
from hypothesis import strategies as st

import planner_jax as pj
from planner_jax.core.rules import part_at
from planner_jax.policies.policy import policy
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.catch.decide import Best
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.hit.plan import HitPlan, Stroke
from planner_jax.task.intercept.plan import InterceptPlan
from tests.faults.bad_calls import ARGUMENTS, ROWS
from tests.trees import as_numpy


def zeros(*shape):
    return np.zeros((2, *shape), np.float32)


def pieces(num, degree, dimensions):
    return pj.PiecewisePolynomial(zeros(num, degree + 1, dimensions), zeros(num) + np.float32(0.1))


def make_plans():
    whole = np.zeros(2, np.int32)
    of_all = {"cost": zeros(), "violation": zeros(), "iterations": whole, "status": whole}
    flown = {**of_all, "gravity": zeros() + np.float32(9.8)}
    vectors = ("ball_pos", "ball_vel", "ball_vel_after", "normal")
    stroke = Stroke(zeros(), *(zeros(3) for _ in vectors), zeros())
    order, times = np.zeros((2, 1), np.int32), {"decided_times": zeros(1), "times": zeros(1)}
    driven = {"start": zeros(3), "time": zeros() + 1, "speed": zeros(33), "curvature": zeros(33)}
    return {
        "hit_plans": HitPlan(**flown, trajectory=pieces(12, 7, 3), stroke=stroke),
        "catch_plans": CatchPlan(**flown, trajectory=pieces(6, 7, 3), order=order, **times),
        "drive_plans": InterceptPlan(**of_all, **driven, origin=zeros(2), meeting=zeros(2)),
        "block_plans": BlockPlan(**of_all, motion=pieces(10, 2, 6), contact_time=zeros()),
    }


def having(tree, name, value):
    """Return a copy of a case in which the leaf `name`, such as "limits.speed", is `value`."""
    first, _, rest = name.partition(".")
    inner = having(getattr(tree, first), rest, value) if rest else value
    return dataclasses.replace(tree, **{first: inner})


def fill(tree, name, value):
    return having(tree, name, np.full_like(part_at(tree, name), value))


def first(num, plans):
    return jax.tree.map(lambda leaf: np.resize(leaf, (num, *leaf.shape[1:])), plans)


def ball_path(num):
    vectors = np.zeros((num, 3), np.float32)
    return pj.BallPath(pj.BallState(vectors, vectors), vectors, vectors[:, 0])


def turning(num):
    vectors = np.zeros((num, 2), np.float32)
    return pj.TurningPath(vectors, vectors, vectors[:, 0])


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calls")
    os.mkfifo(folder / "pipe")
    (folder / "empty").touch()
    (folder / "junk").write_bytes(b"\xff\x00junk" * 100)
    exact, catcher = pj.hit.planner(), pj.catch.planner(decide="given")
    driver, blocker = pj.intercept.planner(), pj.block.planner()
    hits, catches, drives, blocks = (
        as_numpy(task.draw(2)) for task in (pj.hit, pj.catch, pj.intercept, pj.block)
    )
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    ball = pj.take(hits.ball, 0)

    def save(plans):
        plans.save(folder / "saved.npz")
        return folder / "saved.npz"

    names = {
        **{"pj": pj, "np": np, "jax": jax, "nan": np.nan, "inf": np.inf},
        **{"Best": Best, "policy": policy},
        **{"HitPlan": HitPlan, "CatchPlan": CatchPlan, "turning": turning, "SQUARE": square},
        **{"having": having, "fill": fill, "first": first, "save": save},
        **{"exact": exact, "catcher": catcher, "driver": driver, "blocker": blocker},
        **{"hits": hits, "catches": catches, "drives": drives, "blocks": blocks},
        **make_plans(),
        "HIT": {"ball_pos": (0, 5, 1), "ball_vel": (0, -5, 4), "target": (0, 4, 0)},
        "HITS": {name: np.ones((2, 3)) for name in ("ball_pos", "ball_vel", "target")},
        "CATCH": {"targets": ball_path(2), "horizon": (2.0, 2.0)},
        "TABLE": {"times": (0.0, 0.5, 1.0), "positions": np.eye(3)},
        "DRIVE": {"target": pj.take(turning(1), 0)},
        "BLOCK": {"ball_pos": (4, 0, 1), "ball_vel": (-8, 0, 2)},
        "PATH": {"ball": ball, "horizon": 1.0, "drag": 0.06, "gravity": 9.8, "num_nodes": 8},
        "FLY": {"ball": ball, "duration": 1.0, "drag": 0.06, "gravity": 9.8, "num_steps": 8},
    }
    return folder, names


def refuse(given, call):
    folder, names = given
    before = os.getcwd()
    os.chdir(folder)
    try:
        with pytest.raises((TypeError, ValueError)) as caught:
            eval(call, dict(names))
    finally:
        os.chdir(before)
    line, last = str(caught.value), caught.traceback[-1].path
    assert line and "\n" not in line
    assert "site-packages" not in str(last), f"{line}, from {last}"
    return line


@pytest.mark.parametrize(("call", "words"), ROWS, ids=[call for call, _ in ROWS])
def test_it_is_refused_in_one_line(own_checks, given, call, words):
    assert refuse(given, call).startswith(words)


CALLS = st.sampled_from(ARGUMENTS).flatmap(
    lambda row: st.tuples(st.just(row[0]), st.sampled_from(row[1]), st.sampled_from(row[2]))
)


@hypothesis.settings(
    max_examples=200,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],
)
@hypothesis.given(drawn=CALLS)
def test_a_malformed_argument_is_named_with_its_rule_and_value(own_checks, given, drawn):
    call, argument, value = drawn
    line = refuse(given, call.replace("@", f"{argument}={value}"))
    assert line.startswith(f"{argument} must ") and ", got " in line
