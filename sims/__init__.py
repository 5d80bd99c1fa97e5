"""Closed-loop simulations in MuJoCo MJX of quadrotors, a car and an arm that execute plans."""

import importlib.util

from planner_jax.core.missing_extra import MissingExtra

if importlib.util.find_spec("mujoco.mjx") is None:
    raise MissingExtra("a flight", "MuJoCo MJX", "sims")
