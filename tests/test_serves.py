"""Court, published trial files, generated serves and the checks before planning."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import region_of

import planner_jax as pj
from planner_jax import core
from planner_jax.ball import flight
from planner_jax.baselines.protocols import BY_ROW
from planner_jax.core.errors import ArgumentError, CaseError
from planner_jax.task.hit import court, suites
from planner_jax.task.hit.court import check_cases, fly, landing
from planner_jax.task.hit.published import read_serves
from planner_jax.task.hit.spec import DRAG
from planner_jax.task.hit.suites import GRAVITY
from tests.trees import assert_same

PUBLISHED = Path(__file__).resolve().parents[2] / "shared" / "data" / "serves"
needs_published = pytest.mark.skipif(
    not PUBLISHED.is_dir(), reason="the published trial files are not beside the repository"
)

HEADER = "number,serve position,serve velocity,landing position,target,position,velocity,attitude"
HIT = " -2.1 -0.3   1.5,  1.8 -0.2 1.1,-0.01  0.2  -0.002  0.97"
MISS = "failed,failed,failed"


def row(number=1, position=" 2.5 -0.3       2", velocity=" -4.3 0.02  7.3", hit=HIT):
    return f"{number},{position},{velocity},-2.9 -0.3        0,1.75    0    0,{hit}"


def write(folder, name, *rows, header=HEADER):
    (folder / name).write_text("\n".join([header, *rows]) + "\n")


def floor_points(position, velocity, step=1e-3):
    """Return landing points by the midpoint rule, with a straight line in the last step."""
    position, velocity = position.copy(), velocity.copy()
    point = np.full_like(position, np.nan)

    def acceleration(v):
        return [0.0, 0.0, -GRAVITY] - DRAG * np.linalg.norm(v, axis=1, keepdims=True) * v

    for _ in range(2000):
        middle = velocity + 0.5 * step * acceleration(velocity)
        after = position + step * middle
        crossed = (position[:, 2] > 0.0) & (after[:, 2] <= 0.0)
        share = position[:, 2:] / np.where(crossed, position[:, 2] - after[:, 2], 1.0)[:, None]
        point = np.where(crossed[:, None], position + share * (after - position), point)
        position, velocity = after, velocity + step * acceleration(middle)
    return point


def test_the_court_has_36_scenarios_without_mirror_images():
    assert len(court.SCENARIOS) == len(set(court.SCENARIOS)) == 36
    mirror = str.maketrans("LR", "RL")
    mirrored = {name.translate(mirror) for name in court.SCENARIOS if set(name) & {*"LR"}}
    assert not mirrored & {*court.SCENARIOS}
    assert court.SCENARIOS[:4] == ("NNN", "NNF", "NNL", "NFN") and court.SCENARIOS[-1] == "LRR"


def published_rates(table, scenario=""):
    """Return the published success rates [%] of the three planners: of a scenario, or the means."""
    return [BY_ROW["Yu2023bat", table, planner + scenario].value for planner in court.PLANNERS]


def test_published_rates_have_the_known_means():
    assert published_rates("Table I") == [12.7, 47.9, 77.9]
    assert published_rates("trial files") == [9.4, 46.6, 85.4]
    assert published_rates("Table I", " FLR") == [0.3, 60.6, 85.4]


def test_each_target_lies_in_the_region_that_its_scenario_names():
    target = court.target_of(np.arange(36))
    named = [1 + court.REGIONS.index(name[2]) for name in court.SCENARIOS]
    np.testing.assert_array_equal(region_of(target[:, 0], target[:, 1]), named)


def test_trial_files_are_read_with_the_outcome_of_each_planner(tmp_path):
    write(tmp_path, "1_1_2_p.csv", row(1), row(2, position="1.5 0.2 2"))
    write(tmp_path, "1_1_2_l.csv", row(1, hit=MISS), row(2, position="  1.5  0.2       2"))
    write(tmp_path, "1_1_2_b.csv", row(1, hit=MISS), row(2, position="1.5 0.2 2", hit=MISS))
    (tmp_path / "README.md").write_text("not a trial file")
    serves = read_serves(tmp_path)
    np.testing.assert_array_equal(serves.position, [[2.5, -0.3, 2.0], [1.5, 0.2, 2.0]])
    np.testing.assert_array_equal(serves.velocity[0], [-4.3, 0.02, 7.3])
    np.testing.assert_array_equal(serves.target[0], [1.75, 0.0, 0.0])
    np.testing.assert_array_equal(serves.published, [[0, 0, 1], [0, 1, 1]])
    assert [court.SCENARIOS[s] for s in serves.scenario] == ["NNF", "NNF"]
    assert list(serves.file) == ["1_1_2_b.csv"] * 2 and list(serves.line) == [2, 3]


def test_a_missing_planner_is_nan_and_scenarios_take_turns(tmp_path):
    write(tmp_path, "3_4_4_l.csv", row(1), row(2, hit=MISS))
    write(tmp_path, "1_1_1_p.csv", row(1), row(2), row(3))
    serves = read_serves(tmp_path)
    names = [court.SCENARIOS[s] for s in serves.scenario]
    assert names == ["NNN", "LRR", "NNN", "LRR", "NNN"]
    np.testing.assert_array_equal(serves.published[1], [np.nan, 1, np.nan])
    np.testing.assert_array_equal(serves[names.index("LRR") :: 2].line, [2, 3])


def test_an_absent_or_unsuitable_folder_is_named(tmp_path):
    with pytest.raises(ArgumentError, match="existing folder, got .*nowhere"):
        read_serves(tmp_path / "nowhere")
    with pytest.raises(ArgumentError, match="S_L_T_M.csv files, got none"):
        read_serves(tmp_path)
    write(tmp_path, "1_1_4_p.csv", row())
    with pytest.raises(ArgumentError, match=r"36 scenarios, got 1_1_4_p.csv \(NNR"):
        read_serves(tmp_path)


@pytest.mark.parametrize(
    "bad, says",
    [
        ("1,2", "row must have 8 columns between commas, got 2"),
        (row(position="2.5 nan 2"), "serve position must be 3 finite numbers, got '2.5 nan 2'"),
        (row(velocity="-4 7"), "serve velocity must be 3 finite numbers, got '-4 7'"),
        (row(hit="failed,1 2 3,failed"), "hitting position must be 3 finite numbers, got 'failed'"),
        (row(velocity="-1 0 3"), "serve must land in the hitting half, x < 0, got x = 1."),
        (row(velocity="-4e200 0 7e200"), "serve must land in the hitting half, x < 0, got x = nan"),
        (row(position="2.5 0 -2"), "serve height must be > 0, got -2"),
    ],
)
def test_a_bad_row_is_named_by_file_line_rule_and_value(tmp_path, bad, says):
    write(tmp_path, "1_1_1_p.csv", row(), bad)
    with pytest.raises(ArgumentError) as caught:
        read_serves(tmp_path)
    assert f"1_1_1_p.csv:3: {says}" in str(caught.value)
    assert "\n" not in str(caught.value) and len(caught.value.value) == 1


def test_all_bad_rows_and_empty_files_are_collected_and_the_first_few_spelled_out(tmp_path):
    write(tmp_path, "1_1_1_p.csv", *["broken"] * 4, row())
    write(tmp_path, "1_1_2_p.csv", *["broken"] * 3)
    with pytest.raises(ArgumentError, match="1_1_2_p.csv:2: .*; and 2 more$") as caught:
        read_serves(tmp_path)
    assert len(caught.value.value) == 7
    for text in ("", HEADER + "\n"):
        (tmp_path / "1_1_1_p.csv").write_text(text)
        with pytest.raises(ArgumentError, match="1_1_1_p.csv: file must have a row") as caught:
            read_serves(tmp_path)
        assert len(caught.value.value) == 4


def test_files_of_one_scenario_must_hold_the_same_serves(tmp_path):
    write(tmp_path, "1_1_1_b.csv", row(), row(2), row(3))
    write(tmp_path, "1_1_1_p.csv", row(), row(2, position="2.6 0 2"))
    with pytest.raises(ArgumentError) as caught:
        read_serves(tmp_path)
    changed, missing = caught.value.value
    rule = "serve must be the one in 1_1_1_b.csv"
    assert changed.startswith(f"1_1_1_p.csv:3: {rule}, [2.5, -0.3, 2.0")
    assert missing == f"1_1_1_p.csv:4: {rule}, got no such line"


@needs_published
def test_the_published_serves_are_read_with_their_rates():
    serves = read_serves(PUBLISHED)
    assert len(serves) == 9000
    np.testing.assert_array_equal(np.bincount(serves.scenario), np.full(36, 250))
    np.testing.assert_allclose(serves.target, court.target_of(serves.scenario))
    rates = 100.0 * serves.published.mean(axis=0)
    np.testing.assert_allclose(rates, published_rates("trial files"), atol=1.0)


def test_the_host_flies_a_ball_as_the_library_does(float64):
    position, velocity = np.array([2.0, 0.3, 2.0]), np.array([-5.0, 1.0, 7.0])
    ball = flight.BallState(pos=jnp.asarray(position), vel=jnp.asarray(velocity))
    there, _ = flight.fly(ball, 1.3, DRAG, GRAVITY, num_steps=16)
    pos, vel = fly(position, velocity, 1.3, DRAG, GRAVITY)
    np.testing.assert_allclose(pos, there.pos, rtol=1e-12)
    np.testing.assert_allclose(vel, there.vel, rtol=1e-12)


def test_without_drag_the_landing_is_the_closed_form():
    position = np.array([[1.0, 0.0, 2.0], [0.0, 0.0, 0.1], [2.0, 1.0, 5.0]])
    velocity = np.array([[-3.0, 0.5, 7.0], [1.0, 0.0, 0.0], [-4.0, 0.0, -20.0]])
    time, point = landing(position, velocity, 0.0, GRAVITY)
    rise, height = velocity[:, 2], position[:, 2]
    expected = (rise + np.sqrt(rise**2 + 2.0 * GRAVITY * height)) / GRAVITY
    np.testing.assert_allclose(time, expected, rtol=1e-12)
    np.testing.assert_allclose(point[:, :2], (position + expected[:, None] * velocity)[:, :2])
    np.testing.assert_allclose(point[:, 2], 0.0, atol=1e-12)


@pytest.mark.parametrize("drag", [0.0616, 1.0])
def test_the_landing_point_agrees_with_a_fine_integration(drag):
    position, velocity = np.array([0.0, 0.0, 2.0]), np.array([20.0, -3.0, 15.0])
    time, point = landing(position, velocity, drag, GRAVITY)
    fine, _ = fly(position, velocity, time, drag, GRAVITY, num_steps=4000)
    np.testing.assert_allclose(point, fine, atol=1e-3)


def test_fewer_serves_are_the_first_of_more_and_chunks_join():
    whole = suites.generate_serves(4700, 7)  # across two blocks
    assert_same(vars(suites.generate_serves(40, 7)), vars(whole[:40]))
    assert_same(vars(suites.generate_serves(200, 7, first=4500)), vars(whole[4500:]))
    assert not np.allclose(suites.generate_serves(40, 8).velocity, whole.velocity[:40])


def test_every_run_of_36_serves_covers_the_court_in_shuffled_order():
    runs = suites.generate_serves(360, 0).scenario.reshape(10, 36)
    np.testing.assert_array_equal(np.sort(runs, axis=1), np.tile(np.arange(36), (10, 1)))
    assert len(np.unique(runs, axis=0)) == 10
    some = suites.generate_serves(20, 0, ["LRR", "FFN"]).scenario
    first, every = ({court.SCENARIOS[s] for s in part} for part in (some[:2], some))
    assert first == every == {"LRR", "FFN"}


def test_serves_start_and_land_in_their_regions():
    serves = suites.generate_serves(36 * 20, 3)
    regions = court.scenario_regions(serves.scenario)
    x, y, z = serves.position.T
    assert (x > 0.0).all() and (z == suites.SERVE_HEIGHT).all()
    np.testing.assert_array_equal(region_of(x, y), regions[:, 0])
    point = floor_points(serves.position, serves.velocity)
    # `floor_points` and the generator integrate the flight with different errors, so a landing
    # point near the border of a region may be up to 1 mm outside.
    shifts = 1e-3 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])[:, None]
    near = region_of(*np.moveaxis(point[:, :2] + shifts, -1, 0))
    assert (near == regions[:, 1]).any(axis=0).all()
    assert (point[:, 0] < 0.0).all() and (np.abs(point[:, 0]) < suites.DEPTH + 1e-3).all()
    np.testing.assert_allclose(serves.target, court.target_of(serves.scenario))


def test_serves_keep_the_declared_law():
    serves = suites.generate_serves(3600, 1)
    time, _ = landing(serves.position, serves.velocity, DRAG, GRAVITY)
    assert time.max() < suites.MAX_FLIGHT_TIME + 1e-5 and time.min() > 1.49
    assert serves.velocity[:, 0].max() <= -suites.MIN_APPROACH_SPEED
    rise = serves.velocity[:, 2]
    assert rise.min() >= suites.RISE_SPEED[0] and rise.max() <= suites.RISE_SPEED[1]


def test_the_shortcut_of_the_generator_draws_uniform_serves():
    random = np.random.default_rng(0)
    low, high = [0.5, 0.84, 2.0, -8.5, -5.5, 6.5], [4.5, 2.5, 2.0, -2.0, -0.5, 8.73]
    plain = random.uniform(low, high, (40000, 6))
    time, point = landing(plain[:, :3], plain[:, 3:], DRAG, GRAVITY)
    accepted = (region_of(point[:, 0], point[:, 1]) == 4) & (time < suites.MAX_FLIGHT_TIME)
    plain = plain[accepted & (point[:, 0] < 0.0) & (point[:, 0] > -suites.DEPTH)]
    serves = suites.generate_serves(8000, 0, ["LRN"])
    shortcut = np.hstack([serves.position, serves.velocity])
    deciles = np.linspace(0.1, 0.9, 9)
    spread = np.maximum(plain.std(axis=0), 1e-9)
    gap = (np.quantile(shortcut, deciles, axis=0) - np.quantile(plain, deciles, axis=0)) / spread
    assert len(plain) > 3000 and np.abs(gap).max() < 0.1


@needs_published
def test_generated_serves_are_distributed_as_the_published_ones():
    published, generated = read_serves(PUBLISHED), suites.generate_serves(36000, 0)
    pair = np.array([name[:2] for name in court.SCENARIOS])

    def features(serves):
        time, point = landing(serves.position, serves.velocity, DRAG, GRAVITY)
        return np.column_stack([serves.position[:, :2], point[:, :2], serves.velocity, time])

    ours, theirs = features(generated), features(published)
    levels = [0.05, 0.25, 0.5, 0.75, 0.95]
    for name in np.unique(pair):
        a, b = ours[pair[generated.scenario] == name], theirs[pair[published.scenario] == name]
        share = np.stack([(b <= q).mean(axis=0) for q in np.quantile(a, levels, axis=0)])
        assert np.abs(share - np.array(levels)[:, None]).max() < 0.1, name
    np.testing.assert_allclose(ours.mean(axis=0), theirs.mean(axis=0), atol=0.035)


def test_two_delays_in_a_row_are_their_sum():
    serves = suites.generate_serves(36, 0)
    late = suites.advance(serves, 0.8)
    twice = suites.advance(suites.advance(serves, 0.5), 0.3)
    np.testing.assert_allclose(late.position, twice.position, atol=1e-5)
    np.testing.assert_allclose(late.velocity, twice.velocity, atol=1e-5)
    time, point = landing(serves.position, serves.velocity, DRAG, GRAVITY)
    later_time, later_point = landing(late.position, late.velocity, DRAG, GRAVITY)
    np.testing.assert_allclose(later_time, time - 0.8, atol=1e-4)
    np.testing.assert_allclose(later_point, point, atol=1e-3)


def test_a_delay_beyond_the_flight_names_the_serve():
    serves = suites.generate_serves(50, 0)
    time, _ = landing(serves.position, serves.velocity, DRAG, GRAVITY)
    first = np.argmax(time <= 1.6)
    with pytest.raises(ArgumentError, match=f"{time[first]:.3f} s for serve {first}, got 1.6"):
        suites.to_cases(serves, delay=1.6)


def test_cases_carry_the_serves_and_the_setting_of_the_paper():
    serves = suites.generate_serves(5, 0)
    cases = suites.to_cases(serves, limit_scale=0.5)
    np.testing.assert_allclose(cases.ball.pos, serves.position, rtol=1e-6)
    np.testing.assert_allclose(cases.target, serves.target, rtol=1e-6)
    np.testing.assert_allclose(cases.head_state[:, 0], np.tile([-3.0, 0.0, 1.5], (5, 1)))
    np.testing.assert_array_equal(cases.limits.speed, np.full(5, 2.5))
    np.testing.assert_array_equal(cases.hit_limits.hitting_speed[0], [4.0, 3.0, 4.0])
    assert cases.drag.dtype == jnp.float32
    check_cases(cases)
    plain = pj.hit.case(serves.position, serves.velocity, serves.target)
    np.testing.assert_array_equal(cases.drag, plain.drag)
    assert (plain.gravity == np.float32(core.GRAVITY)).all()
    assert (cases.gravity == np.float32(GRAVITY)).all()  # with which the drag was fitted


def test_uniform_starts_fill_the_half_court_and_belong_to_their_serve():
    serves = suites.generate_serves(3000, 0)
    start = np.asarray(suites.to_cases(serves, start="uniform", seed=1).head_state[:, 0])
    assert (start[:, 2] == 1.5).all()
    np.testing.assert_allclose(start[:, :2].min(axis=0), [-5.0, -2.5], atol=0.01)
    np.testing.assert_allclose(start[:, :2].max(axis=0), [-0.5, 2.5], atol=0.01)
    np.testing.assert_allclose(start[:, :2].mean(axis=0), [-2.75, 0.0], atol=0.1)
    part = suites.to_cases(serves[1000:1100], start="uniform", seed=1).head_state[:, 0]
    np.testing.assert_array_equal(part, start[1000:1100])
    other = suites.to_cases(serves[:10], start="uniform", seed=2).head_state[:, 0]
    assert not np.allclose(other, start[:10])


@pytest.mark.parametrize(
    "arguments, says",
    [
        ({"num": 1, "scenarios": ["NNN", "NNR"]}, "scenarios must be names out of .*, got 'NNR'"),
        ({"num": 1, "scenarios": []}, "scenarios must be names out of .*, got none"),
        ({"start": "random"}, "start must be three numbers or 'uniform', got 'random'"),
        ({"start": (1.0, 2.0)}, r"three finite numbers or 'uniform', got \(1.0, 2.0\)"),
        ({"start": "uniform", "seed": -1}, "seed must be >= 0, got -1"),
        *(({"delay": x}, f"delay must be finite and >= 0, got {x:g}") for x in (-0.1, np.nan)),
    ],
)
def test_arguments_of_generator_and_cases_out_of_range_are_named(arguments, says):
    with pytest.raises(ArgumentError, match=says):
        if "num" in arguments:
            suites.generate_serves(**{"seed": 0, **arguments})
        suites.to_cases(suites.generate_serves(1, 0), **arguments)


SERVE = ([2.0, 0.0, 2.0], [-4.0, 0.0, 7.0], [4.0, 0.0, 0.0])


@pytest.mark.parametrize(
    "change, error, says",
    [
        ({"hitting_speed": (4.0, -3.0, 4.0)}, CaseError, "hitting_speed must be > 0, got -3"),
        ({"drag": -0.1}, CaseError, "drag must be >= 0, got -0.1"),
        ({"ball_pos": np.ones(2)}, ValueError, "ball_pos must have a shape that ends with (3,)"),
        ({"ball_vel": np.ones(2)}, ValueError, "ball_vel must have the shape (3,), got (2,)"),
        ({"drag": np.ones(4)}, ValueError, "drag must have the shape (), got (4,)"),
        ({"ball_pos": [2.0, 0.0, -1.0]}, CaseError, "ball_pos must be at a height >= 0 m, got -1"),
        ({"extras": pj.KeepOut(0.0, 1.0)}, TypeError, "extras must be a sequence of limits and"),
    ],
)
def test_a_malformed_argument_is_named_in_one_line(change, error, says):
    given = dict(zip(("ball_pos", "ball_vel", "target"), SERVE, strict=True))
    with pytest.raises(error) as caught:
        pj.hit.case(**given | change)
    line = str(caught.value)
    assert line == says if error is CaseError else line.startswith(says) and "\n" not in line


def test_the_first_bad_lane_is_named_and_the_others_counted():
    batch = [np.tile(part, (6, 1)) for part in SERVE]

    def assert_refused(message, **options):
        with pytest.raises(CaseError, match=f"^{message}$"):
            check_cases(pj.hit.case(*batch, **options))

    drag = [0.1, 0.1, -1.0, 0.1, -2.0, 0.1]
    assert_refused(r"drag must be >= 0, got -1 in lane 2 \(1 more such lane\)", drag=drag)
    batch[1][4] = [2.0, 0.0, 7.0]
    message = r"landing point of ball must be in the hitting half, x < 0, got 4\.\d+ in lane 4"
    assert_refused(message)
    batch[0][1, 1] = np.nan
    assert_refused("ball_pos must be finite, got nan in lane 1")
    batch[0][1] = [2.0, 0.0, -1.0]
    assert_refused("ball_pos must be at a height >= 0 m, got -1 in lane 1")
