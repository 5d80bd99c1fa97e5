"""The command `plan block`: text, files and rejections."""

import csv

import matplotlib.figure
import numpy as np
import pytest
from PIL import Image

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.cli.plan.settings import SingleBlockSettings
from planner_jax.sims import view
from planner_jax.task.block.plan import make_empty_plan
from planner_jax.task.block.search.attempts import StraightSearch
from planner_jax.task.block.suites import scene_for

BALL = ["--pos", "9", "0.5", "0.3", "--vel", "-8", "-0.4", "5.4"]


@pytest.fixture
def straight(monkeypatch):
    """Let the command check straight motions alone, because other searches take long to compile."""
    options = {"searches": (StraightSearch(straight=12, tries=0),)}
    monkeypatch.setattr(SingleBlockSettings, "planner_options", lambda self: options)


@pytest.mark.slow
def test_the_command_plans_past_the_pole(capsys):
    assert main(["plan", "block", *BALL]) == 0
    assert capsys.readouterr().out.startswith("Blocked at ")


def test_the_command_writes_plan_setpoints_and_picture(tmp_path, capsys, straight):
    out = tmp_path / "out"
    assert main(["plan", "block", *BALL, "--no-pole", "--out", str(out), "--rate", "50"]) == 0
    assert {path.name for path in out.iterdir()} == {"plan.npz", "setpoints.csv", "block.png"}
    printed = capsys.readouterr().out
    plan = pj.block.BlockPlan.load(out / "plan.npz")
    assert printed.startswith(f"Blocked at {float(plan.contact_time):.3f} s, ")
    case = pj.block.case((9.0, 0.5, 0.3), (-8.0, -0.4, 5.4), scene=scene_for(None, has_pole=False))
    assert pj.block.judge(case, plan).success
    sampled = plan.sample(4000.0)
    for k, joint in enumerate(case.arm.joint_names):
        (row,) = [line for line in printed.splitlines() if line.startswith(f"{joint} [rad/s] ")]
        reached, allowed = (float(text) for text in row.split()[2:4])
        assert reached == pytest.approx(np.abs(sampled.rates[:, k]).max(), rel=1e-3)
        assert allowed == pytest.approx(float(case.limits.velocity[k]), rel=1e-3)
    with Image.open(out / "block.png") as picture:
        assert min(picture.size) > 400 and np.unique(np.asarray(picture)).size > 50
    with open(out / "setpoints.csv") as file:
        assert len(list(csv.reader(line for line in file if line[0] != "#"))) > 10


def test_a_plan_is_played_in_a_browser(monkeypatch, capsys, straight):
    pytest.importorskip("viser")
    shown = []
    monkeypatch.setattr(view.Viewer, "run", lambda viewer: shown.append(viewer))
    assert main(["plan", "block", *BALL, "--no-pole", "--view"]) == 0
    (viewer,) = shown
    viewer.close()
    printed = capsys.readouterr().out
    assert f"Playing the plan at {viewer.url}" in printed
    contact = float(printed.partition("Blocked at ")[2].partition(" s,")[0])
    # The view shows the contact of a ball of 5 cm, one radius before its centre's.
    speed = np.linalg.norm([-8.0, -0.4, 5.4 - 9.81 * contact])
    assert viewer.recording.met[0, 0] == pytest.approx(contact - 0.05 / speed, abs=2e-3)
    at = np.searchsorted(viewer.recording.time[0], contact) - 1
    wanted = viewer.task.robot.place(viewer.recording.robot[0, at])
    np.testing.assert_allclose(viewer.recording.contact[0, 0], wanted, atol=0.06)


def test_a_ball_that_is_not_blocked_is_explained(capsys, straight):
    assert main(["plan", "block", *BALL, "--delay", "0.9", "--no-pole"]) == 1
    printed = capsys.readouterr().out
    assert "Prospects: the ball is too early: the arm is ready " in printed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--regime", "R9"], "regime must be one of R1, R2, R3"),
        (["--pos", "nan", "0", "0"], "pos must be finite"),
        (["--tip", "flange"], "tip must be left out without --arm"),
        (["--arm", "arm.xml", "--regime", "R1"], "regime must be left out with --arm"),
        (["--arm", "nowhere.xml"], "nowhere.xml"),
        (["--delay", "-1"], "delay must be >= 0"),
    ],
)
def test_wrong_options_are_one_line(change, message, capsys):
    assert main(["plan", "block", *BALL, *change]) == 2
    assert message in capsys.readouterr().err


def test_a_drawing_is_of_one_case():
    cases = pj.block.draw(2)
    still = make_empty_plan(pj.take(cases, 0), 10)
    with pytest.raises(ValueError, match="case must be one case, got batch shape"):
        pj.block.draw_plan(cases, still, matplotlib.figure.Figure())
