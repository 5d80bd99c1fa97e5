"""Kalman filters of balls and quadrotors, each as three pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple

from planner_jax.ball.estimation import ekf_init, ekf_predict, ekf_update
from planner_jax.perception.robot_filter import (
    robot_filter_init,
    robot_filter_predict,
    robot_filter_update,
)


class Filter(NamedTuple):
    """The functions of a filter: a program for many sensors applies any filter by these names.

    In all filters an observation that is NaN is a missing one, and leaves the belief unchanged.
    """

    init: Callable[..., Any]  # makes the belief before any observation
    predict: Callable[..., Any]  # (belief, ..., duration [s], model) -> later belief
    update: Callable[..., Any]  # (belief, observation, ..., model) -> corrected belief


BALL_FILTER = Filter(ekf_init, ekf_predict, ekf_update)
ROBOT_FILTER = Filter(robot_filter_init, robot_filter_predict, robot_filter_update)
