"""Closed-loop simulations in MuJoCo MJX of quadrotors, a car and an arm that execute plans."""

import importlib.util

from planner_jax.core.errors import MissingExtra

if not all(importlib.util.find_spec(name) for name in ("mujoco", "mujoco.mjx")):
    raise MissingExtra("a flight", "MuJoCo and MJX", "sims")
