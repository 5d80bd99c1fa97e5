"""The command `plan`: text, table, files and rejections."""

import csv
import dataclasses

import numpy as np
import pytest

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.cli.plan.answer import Margin
from planner_jax.cli.plan.catch import SingleCatch
from planner_jax.cli.plan.hit import SingleHit
from planner_jax.cli.plan.settings import SingleCatchSettings, SingleHitSettings

HIT = "--pos 4 0.3 1.2 --vel -7 -1e-1 6 --target 4 0 0"
CATCH = "--pos 3 0 1 --vel -3 0.3 5 --horizon 1.1"


@pytest.fixture(scope="module")
def hit():
    task = pj.task_named("hit")
    numbers = {"pos": (4.0, 0.3, 1.2), "vel": (-7.0, -0.1, 6.0), "target": (4.0, 0.0, 0.0)}
    single = SingleHit(task, SingleHitSettings(**numbers).of(task))
    return single, single.answer()


@pytest.fixture(scope="module")
def catch():
    task = pj.task_named("catch")
    ball = {"pos": (3.0, 0.0, 1.0), "vel": (-3.0, 0.3, 5.0), "horizon": 1.1}
    single = SingleCatch(task, SingleCatchSettings(**ball).of(task))
    return single, single.answer()


def test_a_hit_is_told_with_its_time_and_place(hit):
    single, answer = hit
    first, planner, referee = single.describe(answer)[:3]
    stroke = answer.plan.stroke
    assert first.startswith(f"Hit at {float(stroke.time):.3f} s at ({stroke.ball_pos[0]:.3f}, ")
    assert planner.startswith("Planner exact: ") and "every limit holds" in planner
    assert referee.startswith("Referee: success: the ball lands ")


def test_a_catch_is_told_with_its_time_and_place(catch):
    single, answer = catch
    ball = answer.case.targets.ball
    time = float(answer.plan.times[0])
    fallen = ball.pos[0] + time * ball.vel[0] - np.array([0.0, 0.0, 0.5 * 9.81 * time**2])
    assert f"Caught at {time:.3f} s at ({fallen[0]:.3f}, " in single.describe(answer)[0]
    assert f", {fallen[2]:.3f}) m, " in single.describe(answer)[0]


@pytest.mark.parametrize("which", ["hit", "catch"])
def test_a_notebook_shows_the_plan_in_space(which, request):
    _, answer = request.getfixturevalue(which)
    figure = pj.show(answer.case, answer.plan)
    sides = [axes.get_title(loc="left") for axes in figure.axes]
    assert any("rom above" in title for title in sides)
    assert any("success" in title for title in sides)
    drawn = [line.get_xydata() for axes in figure.axes for line in axes.lines]
    start = np.asarray(answer.plan.whole.coeffs)[0, 0]
    assert any(np.allclose(points[0], start[[0, 2]], atol=1e-4) for points in drawn)


@pytest.mark.parametrize("which", ["hit", "catch"])
def test_the_table_agrees_with_the_referee_and_says_when(which, request):
    single, answer = request.getfixturevalue(which)
    found = {margin.limit.split(" [")[0]: margin for margin in single.margins(answer)}
    verdict, end = answer.verdict, float(np.sum(answer.plan.whole.durations))
    for name, value in {
        "speed": verdict.max_speed,
        "body rate": verdict.max_body_rate,
        "height, least": verdict.min_height,
        **({"acceleration": verdict.max_acceleration} if which == "hit" else {}),
        **({"thrust, least": verdict.min_thrust} if which == "catch" else {}),
    }.items():
        assert found[name].reached == pytest.approx(float(value), rel=1e-3, abs=1e-3)
        assert 0.0 <= found[name].time <= end + 1e-6
    assert answer.success and all(0.0 <= margin.share <= 1.001 for margin in found.values())


def test_rotors_with_limits_have_two_lines_and_others_none(hit):
    single, answer = hit
    assert not any("rotor" in margin.limit for margin in single.margins(answer))
    given = single.settings
    robot = pj.robot_named("x500")
    case = pj.hit.case(given.pos, given.vel, given.target, robot=robot)
    verdict = pj.hit.judge(case, answer.plan)
    found = single.margins(dataclasses.replace(answer, case=case, verdict=verdict))
    least, most = (margin for margin in found if "rotor" in margin.limit)
    assert (least.allowed, most.allowed) == pytest.approx(robot.rotor_range, rel=1e-6)
    unit = robot.rotor_range[1]  # the referee, which samples less often, has errors in this unit
    assert least.reached == pytest.approx(float(verdict.min_rotor_thrust), abs=1e-3 * unit)
    assert most.reached == pytest.approx(float(verdict.max_rotor_thrust), abs=1e-3 * unit)
    end = float(np.sum(answer.plan.whole.durations))
    assert all(0.0 <= margin.time <= end + 1e-6 for margin in (least, most))
    assert least.least and not most.least


def test_shares_of_bounds_from_either_side():
    assert Margin("speed", 4.0, 5.0, 0.0).share == pytest.approx(0.8)
    assert Margin("height", 0.5, 0.25, 0.0, least=True).share == pytest.approx(0.5)
    assert Margin("height", 0.2, 0.25, 0.0, least=True).share == pytest.approx(1.25)
    assert Margin("height", -0.2, 0.25, 0.0, least=True).share == np.inf
    assert Margin("height", 0.0, 0.0, 0.0, least=True).share == 0.0


def test_the_command_writes_plan_setpoints_and_pictures(hit, tmp_path, capsys):
    out = tmp_path / "out"
    command = ["plan", "hit", *HIT.split(), "--rate", "50", "--out", str(out)]
    assert main(command) == 0
    names = {path.name for path in out.iterdir()}
    assert names == {"plan.npz", "setpoints.csv", "path.png", "motion.png"}
    told = capsys.readouterr().out
    assert all(str(out / name) in told for name in names)
    kept = pj.hit.HitPlan.load(out / "plan.npz")
    np.testing.assert_array_equal(kept.stroke.time, hit[1].plan.stroke.time)
    rows = list(csv.reader((out / "setpoints.csv").read_text().splitlines()))
    assert float(rows[2][0]) == pytest.approx(0.02)
    assert main(command) == 2
    assert "--out must be a new folder, got" in capsys.readouterr().err


@pytest.mark.slow
def test_a_ball_that_flies_away_is_told_so_with_the_limit_that_fails(capsys):
    away = "--pos -2 0 2 --vel -14 0 6 --target 4 0 0"
    assert main(["plan", "hit", *away.split()]) == 1
    told = capsys.readouterr()
    assert "TOO_FAR, no plan exists" in told.out
    assert "Referee on the best plan found: " in told.out and "above its limit" in told.out
    assert not told.err


@pytest.mark.slow
def test_several_balls_are_caught_one_after_another(capsys):
    balls = "--ball 3 0 1 -3 0.3 5 --ball 3.5 1 1 -2.5 0 7 --horizon 1.6"
    assert main(["plan", "catch", *balls.split(), "--decide", "greedy"]) == 0
    told = capsys.readouterr().out
    assert "Ball 1 caught at " in told and "Ball 2 caught at " in told


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (f"hit {HIT} --speed -1", "--speed must be > 0, got -1"),
        (f"hit {HIT} --min-thrust 9 --max-thrust 3", "--min-thrust must be < --max-thrust, got 9"),
        (f"hit {HIT} --min-apex 9", "--min-apex must be < --max-apex, got 9"),
        (f"hit {HIT} --pos 4 0 -2", "--pos must be at a height >= 0 m, got -2"),
        (f"hit {HIT} --start 0 0 0", "--start must be at a height >= min_height, got 0"),
        (f"hit {HIT} --start-attitude 0 0 0 0", "--start-attitude must be a quaternion, got 0"),
        (f"hit {HIT} --robot racer-net", "--robot must carry a racket, got 'racer-net' with a net"),
        (f"catch {CATCH} --robot x500", "--robot must carry a net, got 'x500' with a racket"),
        (f"hit {HIT} --rate 5", "--rate must be left out without --out, got 5"),
        (f"catch {CATCH} --net-radius -1", "--net-radius must be > 0, got -1"),
        (f"catch {CATCH} --drag -1", "--drag must be >= 0, got -1"),
        ("catch --pos 3 0 1 --vel 1 2 3 --horizon -1", "--horizon must be > 0 of a target"),
        ("catch --pos 3 0 1 --horizon 1", "--vel must be given, or --ball, got nothing"),
        (f"catch {CATCH} --ball 1 2 3 4 5 6", "--pos must be left out beside --ball, got both"),
    ],
)
def test_a_number_that_breaks_a_rule_is_refused_by_its_option(command, told, capsys):
    assert main(["plan", *command.split()]) == 2
    line = capsys.readouterr().err
    assert told in line and line.count("\n") == 1
