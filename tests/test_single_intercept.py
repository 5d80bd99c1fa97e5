"""The command `plan intercept`: the file of a case, text, files and rejections."""

import csv
import dataclasses
import json

import numpy as np
import pytest
import yaml
from PIL import Image

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.cli.plan.answer import Answer
from planner_jax.cli.plan.intercept import SingleIntercept, read_case
from planner_jax.cli.plan.settings import SingleInterceptSettings
from planner_jax.plane.maps import MapError
from planner_jax.task.intercept.plan import make_straight_plan
from planner_jax.task.intercept.spec import TASK

CASE = {
    "target": {"position": [3.0, 4.6], "velocity": [0.0, -0.1]},
    "time": 4.0,
    "walls": [[[2, 5], [4, 5], [4, 6], [3, 6], [3, 7], [2, 7]]],
    "movers": [[[6, 1], [6.5, 1], [6.5, 1.5]]],
    "mover_velocities": [0, 0.4],
    "speed": 1.6,
}


def write_case(folder, **fields):
    """Write a case's file without the fields that are None, and return its path."""
    path = folder / "case.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in {**CASE, **fields}.items() if v is not None}))
    return path


def write_grid(folder):
    """Write a map with one occupied cell of 1 m at (7, 7) of 8 x 8 cells."""
    pixels = np.full((8, 8), 254, np.uint8)
    pixels[0, 7] = 0
    Image.fromarray(pixels).save(folder / "cells.pgm")
    fields = {"image": "cells.pgm", "resolution": 1.0, "origin": [-1.0, 0.0, 0.0]}
    (folder / "cells.yaml").write_text(yaml.safe_dump(fields))


def test_a_file_with_utm_coordinates_keeps_millimetres(tmp_path):
    far = {"start": [500000.8, 4600004.0, 0.0], "walls": None, "movers": None}
    far |= {"lower": [500000, 4600000], "upper": [500008, 4600008], "mover_velocities": None}
    target = {"position": [500003.124, 4600004.623]}
    case = read_case(write_case(tmp_path, **far, target=target))
    world = np.asarray(case.origin, float) + np.asarray(vars(case.target)["pos"], float)
    np.testing.assert_allclose(world, target["position"], atol=1e-6)


@pytest.mark.slow
def test_the_command_writes_plan_setpoints_and_picture(tmp_path, capsys):
    out = tmp_path / "out"
    command = ["plan", "intercept", "--map", str(write_case(tmp_path)), "--out", str(out)]
    assert main([*command, "--rate", "50"]) == 0
    assert {path.name for path in out.iterdir()} == {"plan.npz", "setpoints.csv", "plane.png"}
    printed = capsys.readouterr().out
    plan = pj.intercept.InterceptPlan.load(out / "plan.npz")
    assert printed.startswith("Met at 4.000 s at (3.000, 4.200) m, at ")
    assert "m from walls and " in printed and "m from movers." in printed
    assert "Planner spacetime: CONVERGED" in printed and "Referee: success: " in printed
    rows = {line.split("  ")[0]: line for line in printed.splitlines()}
    assert f"{np.abs(np.asarray(plan.speed)).max():.4g}" in rows["speed [m/s]"]
    assert rows["speed [m/s]"].split()[3] == "1.6" and "steering rate [rad/s]" in rows
    setpoints = list(csv.reader((out / "setpoints.csv").read_text().splitlines()))
    assert float(setpoints[2][0]) == pytest.approx(0.02) and float(setpoints[-1][0]) == 4.0


@pytest.mark.slow
def test_a_target_out_of_reach_is_reported_with_the_limit_that_fails(tmp_path, capsys):
    path = write_case(tmp_path, target={"position": [7.5, 4.6]}, time=0.5)
    assert main(["plan", "intercept", "--map", str(path)]) == 1
    printed = capsys.readouterr().out
    assert printed.startswith("No plan that keeps every limit was found.")
    assert "Referee on the best plan found: " in printed


def test_limits_that_need_to_be_relaxed_are_printed_for_an_unsolved_case(tmp_path):
    ahead = {"position": [3.95, 4.0]}  # which a car reaches that speeds up from 0.5 to 1 m/s
    path = write_case(tmp_path, target=ahead, walls=None, movers=None, mover_velocities=None)
    single = SingleIntercept(TASK, SingleInterceptSettings(planner="spacetime", map=str(path)))
    usual = single.case()
    drive = make_straight_plan(usual, 12).replace(speed=np.linspace(0.5, 1.0, 13, dtype=np.float32))
    assert pj.intercept.judge(usual, drive).success
    tight = dataclasses.replace(usual.limits, acceleration=np.float32(1e-3))
    case = dataclasses.replace(usual, limits=tight)
    lines = single.describe(Answer(case, drive, pj.intercept.judge(case, drive)))
    assert lines[1].startswith("Relaxation: a motion exists for the case with acceleration relaxed")


def test_a_file_has_the_arguments_of_a_case_and_json_is_read_too(tmp_path):
    found = read_case(write_case(tmp_path, start=[1.0, 2.0, 0.5], curvature=1.5))
    expected = pj.intercept.case(
        found.target, 4.0, walls=CASE["walls"], movers=CASE["movers"], mover_velocities=(0, 0.4),
        speed=1.6, start=(1.0, 2.0, 0.5), curvature=1.5,
    )  # fmt: skip
    np.testing.assert_array_equal(found.movers.velocity, expected.movers.velocity)
    assert found.limits == expected.limits and found.walls.present.sum() == 2
    path = tmp_path / "case.json"
    path.write_text(json.dumps({**CASE, "tolerance": 1e-6}))
    assert float(read_case(path).tolerance) == pytest.approx(1e-6)


def test_the_cells_of_a_grid_are_walls_and_its_corners_bound_the_map(tmp_path):
    write_grid(tmp_path)
    found = read_case(write_case(tmp_path, grid="cells.yaml"))
    assert found.walls.present.sum() == 3
    np.testing.assert_allclose(found.walls.centre[2], [6.5, 7.5])
    np.testing.assert_allclose([found.lower, found.upper], [[-1.0, 0.0], [7.0, 8.0]])
    grid = {"file": "cells.yaml", "coarsen": 2, "unknown_is_free": True}
    found = read_case(write_case(tmp_path, grid=grid, walls=None, upper=[9.0, 9.0]))
    np.testing.assert_allclose(found.walls.centre[0], [6.0, 7.0])
    np.testing.assert_allclose(found.upper, [9.0, 9.0])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"target": None}, "target must be fields with values .position, .*got None"),
        ({"target": {"velocity": [1, 0]}}, "target.position must be given"),
        ({"target": {"position": [1]}}, r"target.position must have the shape \(2,\), got \(1,\)"),
        ({"target": {"place": [1, 2]}}, "field of target must be one of position, .*'place'"),
        ({"strat": [1, 2, 3]}, "field must be one of grid, target, .*got 'strat'"),
        ({"speed": -1.0}, "speed must be > 0, got -1"),
        ({"walls": [[[0, 0], [1, 1], [1, 0], [0, 1]]]}, "walls must be simple.*at index 0"),
        ({"mover_velocities": [[0, 1], [2, 3]]}, "mover_velocities must have the shape"),
        ({"time": [1.0, 2.0]}, r"time must have the shape \(\), got \(2,\)"),
        ({"grid": "gone.yaml"}, "grid.file must be a file that can be read"),
        ({"grid": {"file": "cells.yaml", "coarsen": 0}}, "coarsen must be >= 1"),
        (
            {"grid": {"file": "cells.yaml", "unknown_is_free": 1}},
            "grid.unknown_is_free must be True",
        ),
        ({"grid": {"file": 3}}, "grid.file must be the path"),
        ({"grid": "cells.yaml", "walls": 3}, "walls must be a list of polygons, got 3"),
    ],
)
def test_a_bad_field_is_reported_in_one_line_with_the_file(tmp_path, fields, message):
    write_grid(tmp_path)
    path = write_case(tmp_path, **{"target": CASE["target"], **fields})
    with pytest.raises(MapError, match=f"case.yaml: {message}") as caught:
        read_case(path)
    assert "\n" not in str(caught.value)


def test_a_bad_field_ends_the_command_with_code_2(tmp_path, capsys):
    path = write_case(tmp_path, speed=-1.0)
    assert main(["plan", "intercept", "--map", str(path)]) == 2
    line = capsys.readouterr().err
    assert line == f"planner-jax: error: {path}: speed must be > 0, got -1\n"


def test_infinite_limits_have_no_row(tmp_path):
    settings = SingleInterceptSettings(map=str(write_case(tmp_path, steering_rate=float("inf"))))
    single = SingleIntercept(TASK, settings.of(TASK))
    case = single.case()
    plan = make_straight_plan(case, 12)
    answer = Answer(case, plan, pj.intercept.judge(case, plan))
    names = [margin.limit for margin in single.margins(answer)]
    assert names[0] == "target to body's middle [m]" and len(names) == 5
