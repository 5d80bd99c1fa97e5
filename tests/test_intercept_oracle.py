from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.benchmarks.intercept_departure import departs
from planner_jax.benchmarks.intercept_lattice import CELL, HEADINGS, LAYER, Lattice
from planner_jax.benchmarks.intercept_oracle import scenes, search
from planner_jax.referee.clearance import clearances

START, SPEED, TOP, ACCELERATION, MIDDLE, TOLERANCE = (0.8, 4.0, 0.0), 0.5, 1.5, 1.0, 0.15, 0.05


@pytest.fixture(scope="module")
def drawn():
    return scenes(pj.intercept.draw(3, "storm", 4))


def scene(pos, vel=(0.0, 0.0), time=5.0, **more):
    leaves = (jnp.asarray(leaf, jnp.float32) for leaf in (pos, vel, 0.0))
    one = pj.intercept.case(pj.TurningPath(*leaves), time, start=START, initial_speed=SPEED, **more)
    return scenes(jax.tree.map(lambda leaf: leaf[None], one))[0]


def box(left, low, right, high):
    return np.array([[left, low], [right, low], [right, high], [left, high]])


def gate(closing, time=6.0):
    return scene(
        (6.0, 4.0),
        time=time,
        walls=[box(3.0, 0.0, 3.2, 3.5), box(3.0, 4.5, 3.2, 8.0)],
        movers=[box(2.95, -1.6, 3.25, 3.4)],
        mover_velocities=(0.0, closing),
    )


def distance(scene, points, times):
    """Return distances of points (P, 2) from the nearest wall or mover at times (P,)."""
    polygons = np.array([*scene.walls, *scene.movers])
    centre = polygons.mean(axis=1)
    velocity = np.concatenate([np.zeros((len(scene.walls), 2)), scene.velocities])
    group = {"corners": polygons - centre[:, None], "present": np.ones(len(polygons), bool)}
    group |= {"centre": centre, "velocity": velocity}
    group = {
        name: np.broadcast_to(leaf, (len(points), *leaf.shape)) for name, leaf in group.items()
    }
    poses = np.concatenate([points, np.zeros((len(points), 1))], axis=1)[:, None]
    return clearances(group, np.zeros((len(points), 2)), times[:, None], poses)[0]


@pytest.mark.parametrize("away", [0.1, 0.45])
def test_on_an_open_map_a_chase_takes_the_time_of_its_closed_form(away):
    ahead, times = 1.0, np.linspace(0.0, 6.0, 60001)
    rising = np.minimum(times, (TOP - SPEED) / ACCELERATION)
    driven = SPEED * rising + 0.5 * ACCELERATION * rising**2 + TOP * (times - rising)
    exact = times[np.argmax(ahead + away * times - MIDDLE - driven <= TOLERANCE)]
    chase = scene((START[0] + ahead, START[1]), (away, 0.0))
    cell = CELL * (1.0 + np.sqrt(0.5)) / (TOP - away)
    assert exact - cell <= Lattice(chase).reach().earliest <= exact + cell + LAYER


def test_no_path_leads_through_a_wall_across_the_map():
    parted = scene((6.0, 4.0), walls=[box(3.0, -0.5, 3.1, 8.5)])
    found = Lattice(parted).reach()
    assert not found.at_end and found.earliest == np.inf


def test_a_gate_is_passed_before_it_closes_and_not_after():
    slow, fast = (Lattice(gate(closing)).reach() for closing in (0.1, 1.0))
    assert slow.at_end and not fast.at_end and fast.earliest == np.inf
    assert slow.earliest == Lattice(gate(0.0)).reach().earliest


@pytest.mark.slow
def test_a_car_passes_a_wide_gap_and_no_tight_one():
    def gap(width):
        walls = [box(3.0, 0.0, 3.2, 4.0 - width / 2), box(3.0, 4.0 + width / 2, 3.2, 8.0)]
        return search(scene((6.0, 4.0), walls=walls))[0]

    assert not gap(0.3) and gap(0.45)


def test_a_target_that_is_near_too_early_is_not_met_at_the_end():
    passing = scene((1.8, 4.0), (1.6, 0.0), time=3.5)
    assert not Lattice(passing).reach().at_end
    waiting = scene((1.8, 4.0), time=3.5)
    found = Lattice(waiting).reach()
    assert found.at_end and found.earliest < 1.1


def test_free_cells_are_free_by_the_referee(drawn):
    random, one = np.random.default_rng(0), drawn[0]
    lattice = Lattice(one)
    half = random.integers(0, 2 * lattice.layers + 1, 300)
    heading = random.integers(0, HEADINGS, 300)
    cells = random.integers(0, lattice.count, (300, 2))
    free = [
        lattice.free(h, k) >> int(row * lattice.stride + column) & 1
        for h, k, (column, row) in zip(half, heading, cells, strict=True)
    ]
    rear, ahead = lattice.origin + CELL * cells, lattice.direction[heading]
    times = 0.5 * half * one.dt
    gap = np.min([distance(one, rear + a * ahead, times) for a in lattice.ahead], axis=0)
    middle = rear + one.middle * ahead
    on_map = np.minimum(middle - one.lower, one.upper - middle).min(axis=1)
    margin = np.minimum(gap - lattice.radius, on_map)
    clear = np.abs(margin) > CELL / 4
    assert (margin > 0.0)[clear].any() and (margin < 0.0)[clear].any() and clear.sum() > 250
    np.testing.assert_array_equal(np.array(free, bool)[clear], (margin > 0.0)[clear])


@pytest.mark.parametrize(("ahead", "gets_away"), [(0.1, False), (1.2, True)])
def test_a_car_escapes_a_wall_ahead_if_it_can_still_turn(ahead, gets_away):
    # The car cannot reverse. It turns with a radius of at least 0.5 m, so it needs space ahead.
    front = START[0] + MIDDLE + 0.2
    one = scene((6.0, 4.0), time=8.0, walls=[box(front + ahead, 2.0, front + ahead + 0.2, 6.0)])
    assert departs(one, far=0.8, until=2.0) == gets_away


@pytest.mark.parametrize(
    ("ahead", "lives"), [(0.05, False), pytest.param(0.5, True, marks=pytest.mark.slow)]
)
def test_near_a_target_it_suffices_to_touch_nothing(ahead, lives):
    # The car brakes from its initial speed of 0.5 m/s within 0.125 m.
    front = START[0] + MIDDLE + 0.2
    near = scene((1.5, 4.0), time=2.0, walls=[box(front + ahead, 2.0, front + ahead + 0.2, 6.0)])
    assert departs(replace(near, initial_speed=0.5)) == lives
