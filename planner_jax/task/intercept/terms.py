"""What an interception costs: hinges on limits, obstacles and the miss, with their slopes."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.plane.obstacles import Obstacles, distances, separation
from planner_jax.robot.car import CarBody
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.motion import Motion

_DISCS = 3  # that cover the body


@struct.dataclass
class Weights:
    """Of the squares; costs are made comparable by the limits themselves."""

    miss: float = 300.0  # of the distance to the target over its tolerance of 0.05 m
    obstacle: float = 1e3
    limit: float = 100.0
    effort: float = 0.02
    turning: float = 1e-3


def wrapped(angle: Array) -> Array:
    """An angle between -pi and pi [rad]."""
    return angle - 2.0 * np.pi * jnp.round(angle / (2.0 * np.pi))


def discs_of(body: CarBody, num: int) -> tuple[Array, Array]:
    """Radius () and places ahead of the rear axle (num,) [m] of discs that cover the body."""
    half = 0.5 * body.length / num
    radius = jnp.sqrt(half**2 + (0.5 * body.width) ** 2)
    places = np.arange(1 - num, num, 2)
    return radius, body.middle + half * jnp.asarray(places, body.length.dtype)


def limit_rows(
    case: InterceptCase,
    time: Array,
    speed: Array,
    curvature: Array,
    weights: Weights,
    slack: float,
    places: int,
) -> tuple[Array, Array, Array]:
    """Hinges on the car's limits, and effort, as rows of a linear least-squares problem.

    Returns:
        rows: (R, 2 K), slopes of the residuals by the unknowns.
        values: (R,), residuals.
        violation: (), largest relative excess.
    """
    limits, num, dtype = case.limits, speed.shape[0] - 1, speed.dtype
    rate = num / time
    own, last = np.eye(num), np.eye(num, k=-1)
    change, none = own - last, np.zeros((num, num))
    v, c = speed[1:], curvature[1:]
    acceleration = (speed[1:] - speed[:-1]) * rate
    # The steering angle changes quickest where the curvature is least.
    flat = jnp.where(
        curvature[1:] * curvature[:-1] > 0.0, jnp.minimum(c**2, curvature[:-1] ** 2), 0.0
    )
    gain = case.body.wheelbase / (1.0 + case.body.wheelbase**2 * flat) * rate
    steering = gain * (curvature[1:] - curvature[:-1])
    excesses, rows = [], []

    def hinge(value: Array, limit: Array, by_speed: Any, by_curvature: Any) -> None:
        excess = jnp.abs(value) / limit - 1.0
        inside = jnp.maximum(excess + slack, 0.0)
        sign = jnp.where(inside > 0.0, jnp.sign(value), 0.0) / limit
        excesses.append(excess)
        row = jnp.concatenate([jnp.asarray(by_speed, dtype), jnp.asarray(by_curvature, dtype)], 1)
        rows.append((inside * root, row * (sign * root)[:, None]))

    root = jnp.sqrt(jnp.asarray(weights.limit, dtype))
    # Between 0 and the limit: as far from the middle as half of it.
    hinge(v - 0.5 * limits.speed, 0.5 * limits.speed, own, none)
    hinge(c, limits.curvature, none, own)
    hinge(acceleration, limits.acceleration, change * rate, none)
    hinge(steering, limits.steering_rate, none, change * gain[:, None])
    for share in (np.arange(places) + 1.0) / places:  # of every piece
        at = share * own + (1.0 - share) * last
        fast, bend = (share * each[1:] + (1.0 - share) * each[:-1] for each in (speed, curvature))
        by_speed, by_curvature = (2.0 * fast * bend)[:, None] * at, (fast**2)[:, None] * at
        hinge(fast**2 * bend, limits.lateral_acceleration, by_speed, by_curvature)
    effort = jnp.sqrt(jnp.asarray(weights.effort, dtype)) * rate
    turning = jnp.sqrt(jnp.asarray(weights.turning, dtype)) * rate
    rows.append((effort * (speed[1:] - speed[:-1]), effort * jnp.concatenate([change, none], 1)))
    rows.append(
        (turning * (curvature[1:] - curvature[:-1]), turning * jnp.concatenate([none, change], 1))
    )
    values, slopes = zip(*rows, strict=True)
    return jnp.concatenate(slopes), jnp.concatenate(values), jnp.max(jnp.stack(excesses))


def meeting_rows(
    case: InterceptCase, way: Motion, goal: Array, weights: Weights
) -> tuple[Array, Array, Array]:
    """Miss and heading at the end; as `limit_rows`."""
    heading = way.heading[-1]
    direction = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    aside = jnp.stack([-direction[1], direction[0]])
    miss = way.pos[-1] + case.body.middle * direction - goal
    slope = way.pos_slope[-1] + case.body.middle * aside[:, None] * way.heading_slope[-1]
    off = wrapped(heading - case.end_heading)
    turned = jnp.abs(off) / case.heading_tolerance - 1.0
    over = jnp.where(case.heading_tolerance < np.pi, jnp.maximum(turned + 0.1, 0.0), 0.0)
    sign = jnp.where(over > 0.0, jnp.sign(off), 0.0) / case.heading_tolerance
    root = jnp.sqrt(jnp.asarray(weights.miss, miss.dtype))
    rows = jnp.concatenate([root * slope, (sign * way.heading_slope[-1])[None]])
    values = jnp.concatenate([root * miss, over[None]])
    missed = jnp.sqrt(jnp.sum(miss**2) + 1e-12) / case.tolerance - 1.0
    return rows, values, jnp.maximum(missed, turned)


def obstacle_terms(
    case: InterceptCase, way: Motion, time: Array, weights: Weights, margin: float
) -> tuple[Array, Array, Array, Array]:
    """Hinges on the distance of the body's discs from obstacles and from the map's edge.

    Returns:
        push: (M, 3), half the gradient of the cost by x, y and heading at every sample.
        stiffness: (M, 3, 3), the curvature that goes with it.
        cost: ().
        close: (), largest excess of a disc into an obstacle, relative to the body's width.
    """
    radius, ahead = discs_of(case.body, _DISCS)
    num = way.heading.shape[0]
    times = time / num * jnp.arange(1, num + 1)
    cos, sin = jnp.cos(way.heading), jnp.sin(way.heading)
    weight = weights.obstacle * (100.0 / num)
    both = together(case.walls, case.movers)
    x, y = way.pos[:, 0] + ahead[:, None] * cos, way.pos[:, 1] + ahead[:, None] * sin  # (discs, M)
    moved = both.centre[:, None] + both.velocity[:, None] * times[:, None]  # (N, M, 2)
    rel_x, rel_y = x[None] - moved[:, None, :, 0], y[None] - moved[:, None, :, 1]
    far, (away_x, away_y) = distances(
        both.corners,
        both.present,
        rel_x.reshape(rel_x.shape[0], -1),
        rel_y.reshape(rel_y.shape[0], -1),
    )
    depth = (radius - far).reshape(rel_x.shape)  # (N, discs, M)
    away_x, away_y = away_x.reshape(rel_x.shape), away_y.reshape(rel_y.shape)
    over = weight * jnp.maximum(depth + margin, 0.0)
    active = jnp.where(over > 0.0, weight, 0.0)
    turn = ahead[:, None] * (away_y * cos - away_x * sin)
    slopes = (away_x, away_y, turn)
    push = -jnp.stack([jnp.sum(over * slope, axis=(0, 1)) for slope in slopes], axis=1)
    products = {
        (a, b): jnp.sum(active * slopes[a] * slopes[b], axis=(0, 1))
        for a in range(3)
        for b in range(a, 3)
    }
    stiffness = jnp.stack(
        [jnp.stack([products[min(a, b), max(a, b)] for b in range(3)], axis=1) for a in range(3)],
        axis=1,
    )
    cost = jnp.sum(over * over) / weight
    close = jnp.max(depth) / case.body.width
    middle = case.body.middle
    pos = way.pos + middle * jnp.stack([cos, sin], axis=1)
    beyond = jnp.maximum(pos - case.upper, 0.0) - jnp.maximum(case.lower - pos, 0.0)
    is_beyond = jnp.where(beyond != 0.0, weight, 0.0)
    turn = middle * jnp.stack([-sin, cos], axis=1)
    slopes = jnp.stack(  # of x and y by x, y and heading, (M, 2, 3)
        [
            jnp.stack([jnp.ones(num), jnp.zeros(num), turn[:, 0]], axis=1),
            jnp.stack([jnp.zeros(num), jnp.ones(num), turn[:, 1]], axis=1),
        ],
        axis=1,
    ).astype(pos.dtype)
    push += jnp.sum((weight * beyond)[..., None] * slopes, axis=1)
    stiffness += jnp.sum(
        is_beyond[..., None, None] * slopes[..., :, None] * slopes[..., None, :], axis=1
    )
    return push, stiffness, cost + weight * jnp.sum(beyond**2), close


def together(walls: Obstacles, movers: Obstacles) -> Obstacles:
    """Both as one."""
    size = max(walls.corners.shape[1], movers.corners.shape[1])

    def padded(corners: Array) -> Array:
        more = size - corners.shape[1]
        return jnp.concatenate([corners, *[corners[:, -1:]] * more], axis=1)

    walls, movers = (
        dataclasses.replace(each, corners=padded(each.corners)) for each in (walls, movers)
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), walls, movers)


def ends_of(body: CarBody) -> tuple[Array, Array, Array]:
    """Rear and front end from the rear axle, and half the width [m]."""
    return -body.rear_overhang, body.length - body.rear_overhang, 0.5 * body.width


def clearance(case: InterceptCase, way: Motion, time: Array) -> Array:
    """How far the body is from obstacles, and its middle inside of the map, at M samples [m]."""
    num = way.heading.shape[0]
    times = time / num * jnp.arange(1, num + 1)
    middle = way.pos + case.body.middle * jnp.stack(
        [jnp.cos(way.heading), jnp.sin(way.heading)], axis=1
    )
    free = jnp.min(jnp.minimum(middle - case.lower, case.upper - middle), axis=1)
    both = together(case.walls, case.movers)
    moved = both.centre[:, None] + both.velocity[:, None] * times[:, None]
    apart = separation(
        both.corners,
        both.present,
        way.pos[:, 0] - moved[..., 0],
        way.pos[:, 1] - moved[..., 1],
        way.heading,
        ends_of(case.body),
    )
    return jnp.minimum(free, jnp.min(apart, axis=0))


def is_blocked(case: InterceptCase) -> Array:
    """Whether the car stands in an obstacle, or cannot be where it is to meet the target; ()."""
    goal = case.target.at(case.time).pos
    both = together(case.walls, case.movers)
    before = both.centre - case.start[:2]
    here = separation(
        both.corners,
        both.present,
        -before[:, :1],
        -before[:, 1:],
        case.start[2:],
        ends_of(case.body),
    )
    apart = goal - (both.centre + both.velocity * case.time)
    there, _ = distances(both.corners, both.present, apart[:, :1], apart[:, 1:])
    on_map = jnp.all((goal > case.lower) & (goal < case.upper))
    return (jnp.min(here) < 0.0) | (jnp.min(there) < 0.5 * case.body.width) | ~on_map
