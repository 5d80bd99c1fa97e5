"""Robots from files and by name: units, YAML, MJCF, round trips, and one-line errors."""

import copy
import dataclasses
import json
import math
import os
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.core.errors import ArgumentError, UnknownName
from planner_jax.core.missing_extra import MissingExtra
from planner_jax.robot.quadrotor_file import UNITS, RobotError, model_of, parse_numbers, to_yaml
from planner_jax.robot.quadrotor_models import MODELS
from planner_jax.runs.settings import settings_to_resume
from planner_jax.sims.settings import HitFly
from planner_jax.sweep.hit.settings import HitSettings

DATA = Path(__file__).parent / "data"
MINE = DATA / "my_quadrotor.yaml"
GRAVITY = 9.80665
FIELDS = yaml.safe_load(MINE.read_text())
TOOL = pj.Tool("net", 0.15, 0.1)
LIMITS = pj.FlightLimits(speed=5.0, body_rate=5.0)


@pytest.mark.parametrize(
    ("text", "kind", "found"),
    [
        *(("800 g", "mass", 0.8), ("33 g", "mass", 0.033), (0.8, "mass", 0.8)),
        *(("8e-1", "mass", 0.8), ("30ms", "time", 0.03), ("250 mm", "length", 0.25)),
        *(("18 km/h", "speed", 5.0), ("344 deg/s", "rate", math.radians(344.0))),
        *(("2 g", "acceleration", 2.0 * GRAVITY), ("500 gf", "force", 0.5 * GRAVITY)),
        *(("90 %", "share", 0.9), ("30 deg", "angle", math.pi / 6.0)),
        ("3 3 5 g m^2", "inertia", (0.003, 0.003, 0.005)),
        ("1 2 kg cm^2", "inertia", (1e-4, 2e-4)),
        (["1 m", "2 cm"], "length", (1.0, 0.02)),
        *(("0.3 1/s", "drag", 0.3), ("0.3 0.5 1/s", "drag", (0.3, 0.5)), (1, "drag", 1.0)),
        ("0.2 to 1.9 g", "acceleration", (0.2 * GRAVITY, 1.9 * GRAVITY)),
    ],
)
def test_quantities_are_read_in_si_units_of_which_each_kind_has_the_first(text, kind, found):
    assert next(iter(UNITS[kind].values())) == 1
    span = isinstance(text, str) and " to " in text
    numbers = parse_numbers(text, kind, np.size(found), span=span)
    np.testing.assert_allclose(numbers, np.atleast_1d(found), rtol=1e-15)


def test_a_robot_s_file_is_read_in_si_units():
    robot = pj.read_robot(MINE)
    assert (robot.name, robot.mass, robot.inertia) == ("my-quadrotor", 0.8, (0.003, 0.003, 0.005))
    np.testing.assert_allclose(np.hypot(*robot.rotors.positions[:, :2].T), 0.125)
    assert (robot.rotors.max_thrust, robot.rotors.lag) == (4.5, 0.03)
    assert robot.tool == pj.Tool("racket", 0.06, 0.11, restitution=0.7)
    np.testing.assert_allclose(robot.limits.thrust, (0.2 * GRAVITY, 1.9 * GRAVITY))
    assert hash(robot) == hash(pj.read_robot(MINE))


def test_keywords_go_before_the_file():
    robot = pj.read_robot(MINE, mass="900 g", tool=TOOL, rotors={"lag": "20 ms"})
    assert (robot.mass, robot.tool, robot.rotors.lag) == (0.9, TOOL, 0.02)
    assert robot.rotors.max_thrust == 4.5
    assert pj.read_robot(MINE, inertia=(0.003, 0.003, 0.005)) == pj.read_robot(MINE)
    with pytest.raises(RobotError, match="my_quadrotor.yaml: inertia must have its unit, one of "):
        pj.read_robot(MINE, inertia="3 3 5")


DRAGGED = pj.read_robot(MINE, name="dragged", drag={"across": "0.3 1/s", "along": 0.5})


@pytest.mark.parametrize("robot", [*MODELS.values(), pj.read_robot(MINE), DRAGGED], ids=str)
def test_a_robot_is_the_same_after_yaml_and_after_a_manifest(robot, tmp_path):
    place = tmp_path / "robot.yaml"
    place.write_text(to_yaml(robot))
    assert pj.read_robot(place) == robot
    assert to_yaml(pj.read_robot(place)) == place.read_text()
    assert model_of(json.loads(json.dumps(dataclasses.asdict(robot)))) == robot


def test_positions_of_rotors_may_be_pairs_of_numbers_pairs_as_text_or_one_text():
    pairs = ((0.1, 0.08), (-0.1, 0.08), (-0.1, -0.08), (0.1, -0.08))
    for places in (pairs, ["100 80 mm", *pairs[1:]], "10 8 -10 8 -10 -8 10 -8 cm"):
        assert pj.read_robot(MINE, rotors={"places": places}).rotors.places == pairs


def change_fields(**fields):
    description = copy.deepcopy(FIELDS)
    for name, value in fields.items():
        part, _, field = name.rpartition("__")
        at = description[part] if part else description
        at[field] = value
        if value is None:
            del at[field]
    return yaml.safe_dump(description)


# Each row has a field, its malformed value in YAML (~ removes the field), and the error message.
BAD = """
mass | 800 gg | mass must be in kg, g, got '800 gg'; did you mean g?
mass | 3 m | mass must be in kg, g, got '3 m'
mass | 1 2 kg | mass must be a number in kg, g, got '1 2 kg'
mass | 1.2.3 kg | mass must be in kg, g, got '1.2.3 kg'; did you mean kg?
mass | 1 to 2 kg | mass must be in kg, g, got '1 to 2 kg'
mass | 1e999 kg | mass must be finite, got '1e999 kg'
mass | .nan | mass must be finite, got nan
mass | [~] | mass must be in kg, g, got None
mass | -1 kg | mass must be > 0, got -1
tool | ~ | tool must be given, got nothing
tool | net | tool must be fields with values, got 'net'
tool.radius | ~ | tool.radius must be given, got nothing
tool.kind | rackett | tool.kind must be net or racket, got 'rackett'; did you mean racket?
masss | 1 kg | field must be one of FIELDS, got 'masss'; did you mean mass?
tool.size | 1 m | tool field must be one of TOOL, got 'size'
rotors.places | 1 m | rotors.places must be x and y of 4, 6 or 8 rotors in m, cm, mm, got '1 m'
rotors.count | 5 | rotors.count must be 4, 6 or 8, got 5
rotors.diagonal | ~ | rotors.places or diagonal must be given, got nothing
rotors.places | [[0, 1], [1, 1], [2, 1], [3, 1]] | rotors must have diagonal or places, not both
rotors.max_thrust | 1 N | 4 x rotors.max_thrust must be > the weight of 7.85 N, got 4 N
rotors.max_thrust | 2.06 N | limits.rotor_share must HOVER, 90% of RANGE
limits.body_rate | 3 deg | limits.body_rate must be in RATES, got '3 deg'; did you mean deg/s?
limits.max_tilt | 0 deg | limits.max_tilt must be in (0, 3.14159], got 0
limits.recovery_tilt | 190 deg | limits.recovery_tilt must be in (0, 3.14159], got 3.31613
limits.speed | '~' | limits.speed must be in m/s, cm/s, km/h, got '~'
inertia | 3 3 5 0 0 4 g m^2 | inertia must be OF_A_BODY, got (0.003, 0.003, 0.005, 0.0, 0.0, 0.004)
inertia | 1 1 9 g m^2 | inertia must be OF_A_BODY, got (0.001, 0.001, 0.009)
inertia | 3 3 5 g m | inertia must be in INERTIAS, got '3 3 5 g m'; did you mean g m^2?
inertia | 3 3 5 | inertia must have its UNIT, got '3 3 5'
inertia | [3, 3, 5] | inertia must have its UNIT, got [3, 3, 5]
inertia | [3 g m^2, 3 g m^2, 5] | inertia must have its UNIT, got ['3 g m^2', '3 g m^2', 5]
drag | 0.3 1/s | drag must be fields with values, got '0.3 1/s'
drag | {across: 0.3 1/s} | drag.along must be given, got nothing
drag | {across: 0.3 1/ms, along: 0} | drag.across must be in 1/s, got '0.3 1/ms'; did you mean 1/s?
drag | {across: 0.3 2 1/s, along: 0} | drag.across must be a number in 1/s, got '0.3 2 1/s'
drag | {across: -1 1/s, along: 0} | drag.across must be >= 0, got -1
model | my.urdf | model must name an MJCF file, .xml, got 'my.urdf'
"""
WORDS = {
    "RATES": "rad/s, deg/s",
    "FIELDS": "name, source, mass, inertia, rotors, tool, limits, drag",
    "TOOL": "kind, height, radius, restitution, max_angle",
    "OF_A_BODY": "of a body, none above the other two together",
    "HOVER": "let the robot hover with 1.962 N a rotor, got 0.103 to 1.957 N",
    "RANGE": "a rotor's range",
    "UNIT": "unit, one of INERTIAS, as in '3 3 5 g m^2'",
    "INERTIAS": "kg m^2, kg cm^2, kg mm^2, g m^2, g cm^2, g mm^2",
}


def bad_fields():
    for field, value, rule in (row.split(" | ") for row in BAD.strip().splitlines()):
        for word, text in WORDS.items():
            rule = rule.replace(word, text)
        yield change_fields(**{field.replace(".", "__"): yaml.safe_load(value)}), rule
    yield "- 1", "must be fields with values, got [1]"
    yield "", "must be fields with values, got None"


@pytest.mark.parametrize(("text", "rule"), list(bad_fields()))
def test_what_breaks_a_rule_is_named_in_one_line_with_its_file(text, rule, tmp_path):
    place = tmp_path / "mine.yaml"
    place.write_text(text)
    with pytest.raises(RobotError, match=f"^{re.escape(f'{place}: {rule}')}$"):
        pj.read_robot(place)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("mass: [", "expected the node content"),
        ("mass: 1\nmass: 2", "mass only once"),
        ("a: &b [1]\nc: *b", r"no \*reference"),
        ("mass: " + "[" * 2000, "recursion"),
        ("\x00", "unacceptable character"),
    ],
)
def test_what_is_no_plain_yaml_is_refused_in_one_line(text, problem, tmp_path):
    place = tmp_path / "mine.yaml"
    place.write_text(text)
    with pytest.raises(RobotError, match=f"mine.yaml: must be YAML, .*{problem}") as error:
        pj.read_robot(place)
    assert "\n" not in str(error.value)
    with pytest.raises(RobotError, match="^path must end in .yaml, .yml, .xml, got 'robot.urdf'$"):
        pj.read_robot("robot.urdf")


def test_mjcf_gives_body_and_rotors_about_the_centre_of_mass():
    robot = pj.read_robot(DATA / "quadrotor_of_mjcf.yaml")
    assert (robot.name, robot.tool) == ("quadrotor_of_mjcf", TOOL)
    np.testing.assert_allclose(robot.mass, 0.8)
    apart = 0.7 * 0.1 / 0.8 * 0.03**2
    box = 0.1 / 3.0 * (np.array([0.03, 0.015, 0.01]) ** 2 @ (1 - np.eye(3)))
    np.testing.assert_allclose(robot.inertia, [0.003, 0.003, 0.005] + box + [apart, apart, 0.0])
    places = [[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1]]
    np.testing.assert_allclose(robot.rotors.places, places, atol=1e-12)
    rotors = robot.rotors
    found = (rotors.min_thrust, rotors.max_thrust, rotors.torque_ratio, rotors.lag)
    np.testing.assert_allclose(found, (0.2, 4.5, 0.02, 0.03))


def test_mjcf_without_mujoco_names_the_file_and_the_extra(monkeypatch):
    def fail(_):
        raise MissingExtra("a flight", "MuJoCo and MJX", "sims")

    read, path = pj.read_robot, DATA / "quadrotor_of_mjcf.yaml"
    monkeypatch.setattr("pkgutil.resolve_name", fail)
    with pytest.raises(MissingExtra, match=r"^\w+\.xml needs MuJoCo and MJX: pip install "):
        read(path)


def test_mjcf_alone_takes_tool_and_limits_from_keywords():
    robot = pj.read_robot(DATA / "quadrotor.xml", tool=TOOL, limits=LIMITS, name="other")
    assert robot == pj.read_robot(DATA / "quadrotor_of_mjcf.yaml", name="other")
    with pytest.raises(RobotError, match="quadrotor.xml: tool must be given, got nothing$"):
        pj.read_robot(DATA / "quadrotor.xml", limits=LIMITS)


XML = (DATA / "quadrotor.xml").read_text()


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        (r"<actuator>.*</actuator>", "", "the model must have 4, 6 or 8 actuators, all on sites"),
        ("<freejoint/>", "", "the model must have one free joint, got 0"),
        ("2 0 0 -0.04", "2 0 0 0.04", "gear of neighbouring rotors must turn in opposite direct"),
        ('left" gear="0 0 2', 'left" gear="2 0 0', "gear of actuator 2 must push along z, got 2"),
        ("0.1 2.25", "0.1 2.5", "ctrlrange must be the same for all rotors"),
        ('ctrllimited="true"', 'ctrllimited="false"', "actuator 1 must have a ctrlrange"),
        ("0.1 2.25", "-1 2.25", "ctrlrange must be the same for all rotors"),
        ("<general", '<general biastype="affine" biasprm="1 0 0"', "actuator 1 must have a fixed"),
        ("</mujoco>", "", "the model must be accepted by MuJoCo: no XML"),
    ],
)
def test_mjcf_of_something_else_is_refused_in_one_line(old, new, rule, tmp_path):
    text = re.sub(old, new, XML, count=1, flags=re.DOTALL)
    assert text != XML
    place = tmp_path / "mine.xml"
    place.write_text(text)
    with pytest.raises(RobotError, match=re.escape(f"mine.xml: {rule}")) as error:
        pj.read_robot(place, tool=TOOL, limits=LIMITS)
    assert "\n" not in str(error.value)


def test_a_lag_that_mjcf_does_not_have_is_assumed_and_said(tmp_path):
    place = tmp_path / "mine.xml"
    place.write_text(XML.replace('dyntype="filterexact" dynprm="0.03"', ""))
    robot = pj.read_robot(place, tool=TOOL, limits=LIMITS)
    assert robot.rotors.lag == 0.02 and robot.source == "mine.xml; lag of 20 ms assumed"
    robot = pj.read_robot(place, tool=TOOL, limits=LIMITS, rotors={"lag": "25 ms"})
    assert robot.rotors.lag == 0.025 and robot.source == "mine.xml"


def test_what_yaml_states_is_not_read_from_the_model(tmp_path):
    place = tmp_path / "mine.xml"
    text = XML.replace("0.1 2.25", "0.1 2.5", 1).replace("2 0 0 -0.04", "2 0 0 0.04", 1)
    place.write_text(text.replace('dynprm="0.03"', 'dynprm="0.05"', 1))
    own = {"max_thrust": "4 N", "min_thrust": 0.0, "torque_ratio": "2 cm", "lag": "25 ms"}
    robot = pj.read_robot(place, tool=TOOL, limits=LIMITS, rotors=own)
    assert robot.rotors.max_thrust == 4.0 and robot.rotors.places[0] == pytest.approx((0.1, 0.1))
    place.write_text(re.sub(r"<actuator>.*</actuator>", "", XML, flags=re.DOTALL))
    own |= {"diagonal": "30 cm", "count": 6}
    assert len(pj.read_robot(place, tool=TOOL, limits=LIMITS, rotors=own).rotors.places) == 6


# A model with products of inertia, meshes and pictures whose files are missing, and motors without
# a lag. The motors on each side turn in one direction.
PICTURED = """<mujoco><compiler autolimits="true" assetdir="none"/>
<default><default class="x"><geom mass="0"/><motor ctrlrange="0 13"/></default></default>
<asset><texture type="2d" file="skin.png"/><material name="skin" texture="skin"/>
  <mesh name="hull" file="hull.obj"/></asset>
<worldbody><body childclass="x"><freejoint/><geom type="mesh" mesh="hull" material="skin"/>
  {arms}<geom type="ellipsoid" size=".16 .04 .02" pos="0 0 .02" mass=".3"/></body></worldbody>
<actuator>{motors}</actuator></mujoco>"""
ARM = '<site name="{0}" pos="{1}"/><geom type="sphere" size=".05" pos="{1}" mass=".25"/>'
MOTOR = '<motor class="x" site="{}" gear="0 0 1 0 0 {}"/>'


def test_a_model_with_products_of_inertia_and_missing_pictures_is_read(tmp_path):
    place = tmp_path / "mine.xml"
    places = "-.14 -.18 .05", "-.14 .18 .05", ".14 .18 .08", ".14 -.18 .08"
    arms = "".join(ARM.format(*each) for each in enumerate(places))
    for spins, is_sound in (
        ((-0.02, 0.02, -0.02, 0.02), True),
        ((-0.02, 0.02, 0.02, -0.02), False),
    ):
        motors = "".join(MOTOR.format(*each) for each in enumerate(spins))
        place.write_text(PICTURED.format(arms=arms, motors=motors))
        robot = pj.read_robot(place, tool=TOOL, limits=LIMITS)
        assert robot.inertia[3:] == pytest.approx((0.0, -0.25 * 4 * 0.14 * 0.015, 0.0))
        np.testing.assert_allclose(np.abs(robot.rotors.places), np.tile([0.14, 0.18], (4, 1)))
        assert robot.rotors.max_thrust == 13.0 and robot.rotors.torque_ratio == 0.02
        assert robot.source.endswith("assumed") == is_sound
        assert ("cannot turn the body about z alone" in robot.source) != is_sound
        (tmp_path / "again.yaml").write_text(to_yaml(robot))
        assert pj.read_robot(tmp_path / "again.yaml") == robot
    place.write_text(place.read_text().replace('<geom mass="0"/>', ""))
    with pytest.raises(RobotError, match="mine.xml: must be MJCF, Error.*hull.obj"):
        pj.read_robot(place, tool=TOOL, limits=LIMITS)


@pytest.mark.parametrize("name", ["none/hull.obj", "none/skin.png", "part.xml", "mine.xml"])
def test_a_pipe_in_the_place_of_a_file_of_a_model_is_not_waited_for(tmp_path, name):
    (tmp_path / "none").mkdir()
    (tmp_path / "mine.xml").write_text(
        PICTURED.format(arms='<include file="part.xml"/>', motors="")
    )
    (tmp_path / "part.xml").write_text("<mujocoinclude/>")
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    with pytest.raises(
        (RobotError, OSError), match=f"plain file.*{name}|{name}.*plain file"
    ) as error:
        pj.read_robot(tmp_path / "mine.xml", tool=TOOL, limits=LIMITS)
    assert "\n" not in str(error.value)


def test_a_model_that_needs_much_memory_is_refused_in_one_line(tmp_path):
    place = tmp_path / "mine.xml"
    for asset, rule in (
        ('<hfield name="a" nrow="40000" ncol="40000" size="1 1 1 1"/>', "element hfield must have"),
        ('<replicate count="20000000"><geom/></replicate>', "the model must have at most 20000"),
        ('<include file="mine.xml"/>', ".*mine.xml"),
        ('<include file="gone.xml"/>', 'include "gone.xml" must have the file'),
    ):
        place.write_text(f"<mujoco><asset>{asset}</asset></mujoco>")
        with pytest.raises(RobotError, match=f"^{place}: {rule}") as error:
            pj.read_robot(place, tool=TOOL, limits=LIMITS)
        assert "\n" not in str(error.value)


def test_a_model_of_one_thrust_and_three_moments_needs_the_rotors_diagonal(tmp_path):
    place = tmp_path / "mine.xml"
    moments = "".join(
        f'<motor site="0" gear="0 0 0 {gear}" ctrlrange="-1 1"/>'
        for gear in ("-1 0 0", "0 -1 0", "0 0 -1")
    )
    thrust = '<motor site="0" gear="0 0 1 0 0 0" ctrlrange="0 20"/>'
    arms = ARM.format(0, "0 0 0")
    place.write_text(PICTURED.format(arms=arms, motors=thrust + moments))
    with pytest.raises(
        RobotError, match="mine.xml: rotors must have a diagonal, or places and max"
    ):
        pj.read_robot(place, tool=TOOL, limits=LIMITS)
    own: dict = {"diagonal": "30 cm"}
    assert pj.read_robot(place, tool=TOOL, limits=LIMITS, rotors=own).rotors.max_thrust == 5.0
    own["count"] = 8
    robot = pj.read_robot(place, tool=TOOL, limits=LIMITS, rotors=own)
    assert robot.rotors.max_thrust == 2.5 and robot.rotors.places[7][1] < 0.0


def test_an_unknown_robot_is_refused_with_the_nearest_name_and_each_names_its_sources():
    with pytest.raises(UnknownName, match="^robot must be one of paper-catcher, .*mean x500-net?"):
        pj.robot_named("x50-net")
    assert all(f"`{name}`" in (pj.robot_named.__doc__ or "") for name in MODELS)
    assert all("assumed" in robot.source and len(robot.source) > 40 for robot in MODELS.values())


def test_the_command_lists_robots_and_prints_one_to_begin_from(capsys, tmp_path):
    assert main(["robots"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:]] == list(MODELS)
    assert main(["robots", "x500"]) == 0
    (tmp_path / "my.yaml").write_text(capsys.readouterr().out)
    assert pj.read_robot(tmp_path / "my.yaml") == pj.robot_named("x500")


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["robots", "crazyfly"], "robot must be one of paper-catcher, .*did you mean crazyflie"),
        (["sweep", "hit", "--robot", "crazyfly"], "--robot must be one of paper-catcher"),
        (["sweep", "hit", "--robot", "crazyflie"], "--robot must carry a racket, got 'crazyflie'"),
        (["fly", "catch", "--robot", "no.yaml"], "--robot must be a file that can be read, got"),
        (["fly", "catch", "--robot", "BAD"], "--robot must be a sound one: .*bad.yaml: mass must"),
    ],
)
def test_a_robot_that_does_not_fit_is_refused_before_anything_is_made(
    words, rule, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.yaml").write_text(change_fields(mass="800 gg"))
    assert main([word.replace("BAD", "bad.yaml") for word in words]) == 2
    error = capsys.readouterr().err
    assert re.match(f"planner-jax: error: {rule}", error) and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["bad.yaml"]


@pytest.mark.parametrize("kind", [HitSettings, HitFly])
def test_a_run_holds_the_whole_robot_whatever_becomes_of_its_file(kind):
    settings = kind(robot=str(MINE))
    assert settings.robot == pj.read_robot(MINE)
    written = json.loads(json.dumps(dataclasses.asdict(settings)))
    assert written["robot"]["rotors"]["max_thrust"] == 4.5
    assert kind(**written) == settings


def test_a_run_is_not_resumed_with_another_robot(tmp_path):
    (tmp_path / "other.yaml").write_text(change_fields(rotors__lag="20 ms"))
    parameters = json.loads(json.dumps(HitSettings(robot=str(MINE)).parameters()))
    again = settings_to_resume(HitSettings, parameters, {"robot": str(MINE)})
    assert again.robot == pj.read_robot(MINE)
    rule = "robot.rotors.lag must be 0.03 as in the run that is resumed, got 0.02"
    with pytest.raises(ArgumentError, match=f"^{rule}$"):
        settings_to_resume(HitSettings, parameters, {"robot": str(tmp_path / "other.yaml")})
    old = {**parameters, "robot": None}
    with pytest.raises(ArgumentError, match="^robot must be None as .*, got 'x500'$"):
        settings_to_resume(HitSettings, old, {"robot": "x500"})


def test_draws_are_of_the_robot_and_without_one_of_the_paper_s():
    parameters = HitSettings().parameters()
    del parameters["robot"]
    assert HitSettings(**parameters).robot is None
    assert "robot" not in HitSettings().draw_options()
    cases = pj.hit.draw(2, robot=pj.read_robot(MINE))
    np.testing.assert_allclose(cases.limits.rotors.max_thrust, 0.95 * 4.5)
    throws = pj.catch.draw(2, robot=pj.robot_named("x500-net"))
    np.testing.assert_allclose(throws.net.radius, 0.2)
    np.testing.assert_allclose(throws.limits.max_thrust, 4.0 * 0.95 * 8.549 / 2.064, rtol=1e-6)
    assert cases.limits.air is None


def test_draws_and_settings_have_the_drag_of_the_robot_and_the_wind():
    wind = (3.0, 0.0, -1.0)
    net = dataclasses.replace(DRAGGED, tool=TOOL)
    for draw, robot in ((pj.hit.draw, DRAGGED), (pj.catch.draw, net)):
        calm, windy = (draw(2, robot=robot, wind=each).limits.air for each in (None, wind))
        np.testing.assert_allclose(windy.wind, [wind] * 2)
        np.testing.assert_array_equal(calm.wind, np.zeros((2, 3)))
        np.testing.assert_allclose(np.stack([calm.drag, calm.thrust_drag]), [[0.3] * 2, [0.5] * 2])
    for kind in (HitSettings, HitFly):
        settings = kind(robot=DRAGGED, wind=list(wind))
        again = kind(**json.loads(json.dumps(dataclasses.asdict(settings))))
        assert again == settings and tuple(again.wind) == wind
        with pytest.raises(ArgumentError, match="^wind must be left out unless the file of the "):
            kind(robot=str(MINE), wind=wind)
    assert HitSettings(robot=DRAGGED, wind=wind).draw_options()["wind"] == wind
    with pytest.raises(ArgumentError, match="^wind must be three finite numbers"):
        HitFly(robot=DRAGGED, wind=(1.0, math.nan, 0.0))
    with pytest.raises(ArgumentError, match="^wind must be finite"):
        pj.hit.draw(2, robot=DRAGGED, wind=(1.0, math.nan, 0.0))
    known = HitFly(robot=DRAGGED, rotor_drag_error=-1.0).known_robot()
    assert (known.drag.across, known.drag.along) == (0.0, 0.0)
    with pytest.raises(ArgumentError, match="^rotor_drag_error must be 0 unless the file of the "):
        HitFly(rotor_drag_error=0.1)
