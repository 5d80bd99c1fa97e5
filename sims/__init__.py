"""Flight of the plans in simulation: quadrotors that catch and hit in closed loop."""

import importlib.util

from planner_jax.sweep.settings import SettingError

if not all(importlib.util.find_spec(name) for name in ("mujoco", "mujoco.mjx")):
    raise SettingError("flights need MuJoCo and MJX: pip install 'planner-jax[sims]'")
