"""Closed-loop flights and drives in MuJoCo MJX: quadrotors, a car and an arm."""

import importlib.util

from planner_jax.core.errors import MissingExtra

if not all(importlib.util.find_spec(name) for name in ("mujoco", "mujoco.mjx")):
    raise MissingExtra("a flight", "MuJoCo and MJX", "sims")
