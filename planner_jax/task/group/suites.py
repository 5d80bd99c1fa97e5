"""Seeded random cases of groups: several targets for one car among walls and moving obstacles.

`docs/suites.md` states how cases are drawn. World frame in the plane, SI units.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from planner_jax.core.checks import floating
from planner_jax.core.registry import suite_named
from planner_jax.plane.obstacles import Obstacles, Track
from planner_jax.task.arguments import make_generators
from planner_jax.task.group.case import InterceptGroup
from planner_jax.task.group.case import case as make_group
from planner_jax.task.group.spec import SUITES, TASK
from planner_jax.task.intercept import suites

_TARGET = ("pos", "angle", "speed", "rate")
# [m], side of the map of the suite `forty`. It has as many movers for each square metre as `group`,
# which has 2.5 on average on 8 m x 8 m.
WIDE = 32.0


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    dtype: DTypeLike = jnp.float32,
) -> InterceptGroup:
    """Draw a batch of cases with groups of targets in float64, and cast them to `dtype`.

    The suite is "group" by default, or a suite of another package. Case k of a suite and `seed` is
    always the same; the batch has `num` cases from k = `first` >= 0 on. `ValueError` is raised for
    an unknown suite or a number out of its range.
    """
    suite = suite_named(suite, "group")
    if suite not in SUITES:
        return TASK.other_suite(suite)(num, seed, first)
    spec, randoms, dtype = SUITES[suite], make_generators(suite, num, seed, first), floating(dtype)
    if suite == "forty":
        return _stack_wide([_draw_wide(random) for random in randoms], dtype)
    draws, _, _ = suites.draw_accepted(spec, randoms)
    fewest, most = spec.num_targets
    count = np.array([random.integers(fewest, most + 1) for random in randoms])
    targets = [{name: draws[name] for name in _TARGET}]
    targets += [_draw_target(suite, randoms, draws) for _ in range(most - 1)]
    stacked = {name: np.stack([each[name] for each in targets], axis=1) for name in _TARGET}
    shared = suites.cases_of(draws, dtype)
    return InterceptGroup(
        shared=dataclasses.replace(shared, target=suites.path_of(stacked, dtype)),
        present=jnp.asarray(np.arange(most) < count[:, None]),
        order=jnp.asarray(np.broadcast_to(np.arange(most), (num, most)), jnp.int32),
    )


def _draw_target(
    suite: str, randoms: list[np.random.Generator], draws: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    spec, pending = SUITES[suite], np.arange(len(randoms))
    turning = np.array([random.random() < 0.5 for random in randoms])
    targets = {name: np.zeros_like(draws[name]) for name in _TARGET}
    while len(pending):
        uniform = np.stack([randoms[k].random(6) for k in pending])
        meeting = suites.anywhere(uniform[:, :2])
        target = suites.target_to(meeting, spec.time, turning[pending], uniform[:, 2:])
        around = {name: leaf[pending] for name, leaf in draws.items()}
        candidates = {**around, **target, "meeting": meeting}
        is_good = suites.first_cause(spec, candidates) == len(suites.CAUSES)
        for name in _TARGET:
            targets[name][pending[is_good]] = target[name][is_good]
        pending = pending[~is_good]
    return targets


def _draw_wide(random: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the arrays of one case of the suite `forty`; the movers' poses are one a second."""
    spec = SUITES["forty"]
    movers, turn = spec.num_movers[1], 2.0 * np.pi
    start, targets = np.array([suites.START_X, random.uniform(1.0, WIDE - 1.0), 0.0]), []
    while len(targets) < spec.num_targets[1]:
        pos, angle = random.uniform(0.0, WIDE, 2), random.uniform(0.0, turn)
        speed, rate = random.uniform(0.2, 0.5), random.uniform(0.03, 0.1) * random.choice([-1, 1])
        centre = pos + speed / rate * np.array([-np.sin(angle), np.cos(angle)])
        reach = np.abs(centre - 0.5 * WIDE).max() + abs(speed / rate)
        if reach <= 0.5 * WIDE - suites.EDGE_ROOM:
            targets.append({"pos": pos, "angle": angle, "speed": speed, "rate": rate})
    middle, radius = start[:2] + [suites.BODY_MIDDLE, 0.0], random.uniform(0.2, 0.4, movers)
    pos, is_near = np.zeros((movers, 2)), np.ones(movers, bool)
    while is_near.any():
        pos[is_near] = random.uniform(0.0, WIDE, (is_near.sum(), 2))
        is_near = np.linalg.norm(pos - middle, axis=1) < radius + 1.0
    angle = random.uniform(0.0, turn, movers)
    velocity = np.stack([np.cos(angle), np.sin(angle)]) * random.uniform(*spec.mover_speed, movers)
    # A mover is reflected at the map's edges: its position on an axis is folded into the map.
    free = pos[:, None] + velocity.T[:, None] * np.arange(spec.time + 1.0)[:, None]
    poses = np.pad(np.abs((free - WIDE) % (2.0 * WIDE) - WIDE), ((0, 0), (0, 0), (0, 1)))
    paths = {name: np.array([each[name] for each in targets]) for name in _TARGET}
    return {"start": start, **paths, "radius": radius, "poses": poses}


def _stack_wide(draws: list[dict[str, np.ndarray]], dtype: DTypeLike) -> InterceptGroup:
    """Make the cases of the suite `forty`, whose movers are discs."""
    time = SUITES["forty"].time
    draw = {name: np.stack([each[name] for each in draws]) for name in draws[0]}
    radius, poses = (jnp.asarray(draw[name], dtype) for name in ("radius", "poses"))
    none, point = jnp.zeros_like(radius), jnp.zeros_like(poses[:, :, 0, :2])
    movers = Obstacles(
        centre=poses[:, :, 0, :2],
        corners=jnp.repeat(point[:, :, None], 3, axis=2),
        velocity=point,
        present=none == 0.0,
        radius=radius,
        growth=none,
        track=Track(poses, none, none + 1.0, none + time),
    )
    first = jax.tree.map(lambda leaf: leaf[:, :1], dataclasses.replace(movers, track=None))
    return make_group(
        suites.path_of(draw, dtype),
        np.full(len(draws), time),
        start=draw["start"],
        initial_speed=suites.START_SPEED,
        walls=dataclasses.replace(first, present=first.radius < 0.0),  # one absent wall
        movers=movers,
        upper=(WIDE, WIDE),
        speed=suites.TOP_SPEED,
        dtype=dtype,
    )
