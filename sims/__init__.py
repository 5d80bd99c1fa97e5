"""Closed-loop flights and drives in MuJoCo MJX: quadrotors, a car and an arm."""

import importlib.util

from planner_jax.core.registry import install_line
from planner_jax.runs.settings import SettingError

if not all(importlib.util.find_spec(name) for name in ("mujoco", "mujoco.mjx")):
    raise SettingError(f"flights need MuJoCo and MJX: {install_line('sims')}")
