"""Scenarios of CommonRoad become cases of interceptions: roads, traffic, goals, and states."""

import importlib
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.path import Path as Area

import planner_jax as pj
from planner_jax.robot.car import CarPlan

ROOT = Path(__file__).parents[1]
# Two lanes of 3.5 m and 40 m side by side; the right one, below y = 0, continues in a bend.
SCENARIO = ROOT / "tests" / "data" / "commonroad.xml"


@pytest.fixture(scope="module")
def package():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "benchmarks" / "commonroad_reader")
        yield [importlib.import_module(f"commonroad_{name}") for name in ("reader", "rows")]


@pytest.fixture(scope="module")
def reader(package):
    return package[0]


@pytest.fixture(scope="module")
def problems(reader):
    return reader.read(SCENARIO)


def rectangle_goal(problems):
    return next(each for each in problems if each.arguments["earliest"] == 3.0)


def distance_from_walls(problem, points):
    walls = np.concatenate(
        [np.linspace(wall, np.roll(wall, -1, axis=0), 200) for wall in problem.arguments["walls"]],
        axis=None,
    ).reshape(-1, 2)
    return np.linalg.norm(np.asarray(points, float)[:, None] - walls, axis=2).min(axis=1)


def test_walls_stand_on_the_outer_borders_of_the_road_alone(problems):
    along = np.linspace(1.0, 39.0, 20)
    at = {y: np.stack([along, np.full(20, y)], axis=1) for y in (-3.5, 0.0, 3.5)}
    problem = rectangle_goal(problems)
    assert distance_from_walls(problem, at[-3.5]).max() < 0.1
    assert distance_from_walls(problem, at[3.5]).max() < 0.1
    assert distance_from_walls(problem, at[0.0][:-2]).min() > 1.9  # the circle, 2 m away
    angles = np.linspace(0.1, 1.4, 9)
    for radius in (10.0, 13.5):
        bend = [40.0, 10.0] + radius * np.stack([np.sin(angles), -np.cos(angles)], axis=1)
        assert distance_from_walls(problem, bend).max() < 0.2


def test_the_ends_of_the_road_and_the_way_between_lanelets_are_open(problems):
    gates = [[0.0, -1.75], [0.0, 1.75], [40.0, -1.75], [40.0, 1.75], [51.75, 10.0]]
    assert distance_from_walls(rectangle_goal(problems), gates).min() > 1.0


def test_a_circle_becomes_a_polygon_around_it(problems):
    polygon = rectangle_goal(problems).arguments["walls"][-1]
    radii = np.linalg.norm(polygon - [30.0, 3.0], axis=1)
    assert radii.min() >= 1.0 and radii.max() < 1.03


def test_traffic_exists_from_its_first_to_its_last_state_after_the_start(problems):
    arguments = rectangle_goal(problems).arguments
    (car, pedestrian), (times, poses) = arguments["movers"], arguments["mover_paths"][0]
    np.testing.assert_allclose(times, [0.0, 0.5, 1.0, 1.5, 2.0])  # the problem starts at step 2
    np.testing.assert_allclose(poses[:, 0], [16.0, 14.0, 12.0, 10.0, 8.0])
    np.testing.assert_allclose(np.diff(poses[:, 2]), 0.1, atol=1e-3)  # it does not jump by 2 pi
    np.testing.assert_allclose(np.abs(car), [[2.0, 1.0]] * 4)
    assert pedestrian.max() == 0.6
    np.testing.assert_allclose(arguments["mover_paths"][1][0], [2.0, 2.5, 3.0, 3.5])


def test_a_goal_has_its_region_and_its_intervals(problems):
    problem = rectangle_goal(problems)
    arguments = problem.arguments
    assert (arguments["earliest"], arguments["time"]) == (3.0, 4.0)
    assert arguments["end_heading"] == pytest.approx(0.1)
    assert arguments["heading_tolerance"] == pytest.approx(0.2, rel=0.03)
    assert arguments["end_speed"] == (2.0, 9.0)
    np.testing.assert_allclose(arguments["target"].pos, [36.0, 1.5])
    corner = [3.0 * np.cos(0.1) - np.sin(0.1), 3.0 * np.sin(0.1) + np.cos(0.1)]
    assert np.abs(arguments["region"] - corner).sum(axis=1).min() < 0.1


def test_a_goal_lanelet_is_divided_into_convex_goals_that_lie_inside_it(problems):
    parts = [each for each in problems if each.arguments["time"] == 6.0]
    assert len(parts) > 1 and all(each.arguments["heading_tolerance"] > 3.1 for each in parts)
    corners = np.concatenate(
        [np.asarray(each.arguments["target"].pos) + each.arguments["region"] for each in parts]
    )
    radii = np.linalg.norm(corners - [40.0, 10.0], axis=1)
    assert 9.8 < radii.min() < 10.5 and 13.0 < radii.max() < 13.6


def test_the_body_of_the_car_starts_in_the_middle_that_the_file_states(reader, problems):
    arguments = problems[0].arguments
    np.testing.assert_allclose(arguments["start"], [5.0 - reader.AHEAD, -1.75, 0.0])
    assert (arguments["initial_speed"], arguments["speed"]) == (8.0, reader.SPEED)
    assert arguments["initial_curvature"] == pytest.approx(0.05)
    front = reader.CAR["length"] - reader.CAR["rear_overhang"]
    assert arguments["start"][0] + front == pytest.approx(5.0 + 0.5 * reader.CAR["length"])


def test_the_states_of_a_plan_are_the_middles_of_the_body_at_the_time_steps(package, problems):
    knots = 9
    plan = CarPlan(
        cost=jnp.zeros(()),
        violation=jnp.zeros(()),
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.zeros((), jnp.int32),
        start=jnp.asarray(problems[0].arguments["start"]),
        time=jnp.asarray(4.0),
        speed=jnp.full(knots, 8.0),
        curvature=jnp.full(knots, 0.0),
        origin=jnp.zeros(2),
    )
    row = package[1].row_of(problems[0], plan)
    assert (row["file"], row["problem"]) == ("commonroad.xml", 7)
    expected = [[5.0 + 4.0 * k, -1.75, 0.0, 8.0, 0.0] for k in range(9)]  # every 0.5 s
    np.testing.assert_allclose(row["states"], expected, atol=1e-4)


def test_the_car_does_not_start_in_a_wall(problems):
    walls = problems[0].arguments["walls"]
    body = [5.0, -1.75] + np.array([[-2.25, -0.8], [2.25, -0.8], [2.25, 0.8], [-2.25, 0.8]])
    assert not any(Area(body).intersects_path(Area(wall), filled=True) for wall in walls)


def test_cases_of_a_batch_have_equal_shapes(reader, tmp_path, monkeypatch):
    text = SCENARIO.read_text()
    (tmp_path / "a.xml").write_text(text)
    kept = text[: text.index('<dynamicObstacle id="12"')] + text[text.index("<planningProblem") :]
    (tmp_path / "b.xml").write_text(kept)
    monkeypatch.setenv("COMMONROAD", str(tmp_path))
    cases = reader.draw(2, 0, 0)
    pj.require_sound(cases)
    assert cases.batch_shape == (2,)
    assert sorted(np.asarray(cases.movers.present).sum(axis=1)) == [2, 3]  # one is 1 km away


def exact(name, value):
    return f"<{name}><exact>{value}</exact></{name}>"


def state_at(x, y, time, tag="state", more=""):
    """Return the XML text of a state at standstill."""
    point = f"<position><point><x>{x}</x><y>{y}</y></point></position>"
    return f"<{tag}>{point}{exact('orientation', 0)}{exact('time', time)}{more}</{tag}>"


BOX = "<rectangle><length>4</length><width>2</width></rectangle>"
REGION = BOX.replace("</width>", "</width><center><x>45</x><y>0</y></center>")


def write_scenario(folder, obstacles="", goal=f"<position>{REGION}</position>", signs=""):
    """Write a straight lanelet of 100 m, a start at (10, 0), 20 m/s, and a goal at steps 20 to 60.

    The time step is 0.1 s.
    """
    bounds = "".join(
        f"<{side}><point><x>0</x><y>{y}</y></point><point><x>100</x><y>{y}</y></point></{side}>"
        for side, y in (("leftBound", 4), ("rightBound", -4))
    )
    start = state_at(10, 0, 0, "initialState", exact("velocity", 20) + exact("yawRate", 0))
    time = "<time><intervalStart>20</intervalStart><intervalEnd>60</intervalEnd></time>"
    path = folder / "one.xml"
    path.write_text(
        f'<commonRoad timeStepSize="0.1"><lanelet id="1">{bounds}</lanelet>{signs}{obstacles}'
        f'<planningProblem id="5">{start}<goalState>{time}{goal}</goalState></planningProblem>'
        "</commonRoad>"
    )
    return path


OCCUPIED = (
    "<occupancySet><occupancy><shape><rectangle><length>4</length><width>2</width><center><x>30</x>"
    f"<y>0</y></center></rectangle></shape>{exact('time', 10)}</occupancy></occupancySet>"
)
SHAPE, HERE = f"<shape>{BOX}</shape>", state_at(30, 0, 0, "initialState")
AROUND = [[28.0, -1.0], [28.0, 1.0], [32.0, -1.0], [32.0, 1.0]]


@pytest.mark.parametrize(
    "text",
    [
        f'<dynamicObstacle id="9">{SHAPE}{HERE}</dynamicObstacle>',
        '<environmentObstacle id="9"><shape><rectangle><length>4</length><width>2</width><center>'
        "<x>30</x><y>0</y></center></rectangle></shape></environmentObstacle>",
        f'<staticObstacle id="9">{SHAPE}{HERE}</staticObstacle>',
    ],
    ids=["initial state alone", "environment", "static"],
)
def test_obstacles_that_stand_are_walls(reader, tmp_path, text):
    free, blocked = (
        reader.read(write_scenario(tmp_path, obstacle))[0].arguments for obstacle in ("", text)
    )
    assert len(blocked["walls"]) == len(free["walls"]) + 1 and not blocked["movers"]
    np.testing.assert_allclose(sorted(blocked["walls"][-1].tolist()), AROUND)


@pytest.mark.parametrize("kind", ["dynamicObstacle", "phantomObstacle"])
def test_occupancies_are_movers_around_their_time_steps(reader, tmp_path, kind):
    more = SHAPE + HERE if kind == "dynamicObstacle" else ""
    path = write_scenario(tmp_path, f'<{kind} id="9">{more}{OCCUPIED}</{kind}>')
    arguments = reader.read(path)[0].arguments
    here = {tuple(np.round(times, 9)): poses for times, poses in arguments["mover_paths"]}
    assert set(here) == {(0.95, 1.05)} | ({(-0.05, 0.05)} if more else set())
    corners = arguments["movers"][-1] + here[0.95, 1.05][0, :2]
    np.testing.assert_allclose(sorted(corners.tolist()), AROUND)
    pj.require_sound(reader.read(path)[0].case())


def test_a_trajectory_may_repeat_the_initial_state(reader, tmp_path):
    states = "".join(state_at(30 + k, 0, k) for k in range(4))
    text = f'<dynamicObstacle id="9">{SHAPE}{HERE}<trajectory>{states}</trajectory>'
    problem = reader.read(write_scenario(tmp_path, text + "</dynamicObstacle>"))[0]
    np.testing.assert_allclose(problem.arguments["mover_paths"][0][0], [0.0, 0.1, 0.2, 0.3])
    pj.require_sound(problem.case())


def test_a_goal_heading_may_pass_pi_and_signs_limit_the_speed(reader, tmp_path):
    angles = "<orientation><intervalStart>3.0</intervalStart><intervalEnd>-3.0</intervalEnd>"
    sign = (
        '<trafficSign id="8"><trafficSignElement><trafficSignID>{}</trafficSignID>'
        "<additionalValue>30</additionalValue></trafficSignElement></trafficSign>"
    )
    goal = f"<position>{REGION}</position>{angles}</orientation>"
    problem = reader.read(write_scenario(tmp_path, goal=goal, signs=sign.format("274")))[0]
    assert problem.arguments["end_heading"] == pytest.approx(np.pi)
    assert problem.arguments["heading_tolerance"] == pytest.approx(0.98 * (np.pi - 3.0))
    assert problem.arguments["speed"] == 30.0
    other = reader.read(write_scenario(tmp_path, signs=sign.format("101")))[0]
    assert other.arguments["speed"] == pytest.approx(1.1 * 20.0)  # by the initial speed


def test_a_goal_without_a_position_is_a_square_ahead(reader, tmp_path):
    arguments = reader.read(write_scenario(tmp_path, goal=""))[0].arguments
    np.testing.assert_allclose(arguments["target"].pos, [10.0 + 6.0 * 20.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(np.abs(arguments["region"]), reader.INSIDE * 60.0)
    pj.require_sound(pj.intercept.case(**arguments))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</commonRoad>", "", "no element found"),
        ("commonRoad", "other", "the root commonRoad"),
        ("<x>100</x>", "<x>10,5</x>", "decimal, got '10,5'"),
        ("<x>100</x>", "<x>&e;</x>", "undefined entity"),
        ("<x>100</x>", "<x>1e9</x>", "at most 10000 m apart"),
        (f"<position>{REGION}</position>", '<position><lanelet ref="77"/></position>', "got 77"),
        ("goalState", "goal", "must have a planning problem"),
        ('timeStepSize="0.1"', "", "decimal, got None"),
        ("<planning", '<dynamicObstacle id="9"/><planning', "dynamicObstacle 9 must have a shape"),
        ("</commonRoad>", "<a>" * 100 + "</a>" * 100 + "</commonRoad>", "at most 64 deep"),
    ],
)
def test_a_file_that_is_no_scenario_is_named_in_one_line(reader, tmp_path, old, new, message):
    path = write_scenario(tmp_path)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(reader.ScenarioError, match=rf"one.xml: .*{message}") as caught:
        reader.read(path)
    assert "\n" not in str(caught.value)


def test_a_pipe_and_a_file_of_many_elements_are_refused(reader, tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.xml")
    with pytest.raises(OSError, match="no plain file"):
        reader.read(tmp_path / "pipe.xml")
    monkeypatch.setattr(reader, "MOST_ELEMENTS", 10)
    with pytest.raises(reader.ScenarioError, match="at most 10 elements"):
        reader.read(write_scenario(tmp_path))


def test_rows_of_a_folder_go_on_after_a_file_that_cannot_be_read(
    package, tmp_path, monkeypatch, capsys
):
    write_scenario(tmp_path).rename(tmp_path / "b.xml")
    (tmp_path / "a.xml").write_text("<commonRoad>")
    out = tmp_path / "plans.json"
    monkeypatch.setattr("sys.argv", ["rows", str(tmp_path), "--out", str(out)])
    monkeypatch.setattr(package[1], "plan_first", lambda planner, problems: 1 / 0)
    with pytest.raises(ZeroDivisionError):  # the second file is read
        package[1].main()
    assert "UNREADABLE" in capsys.readouterr().out
