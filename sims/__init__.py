"""Plans in simulation, in closed loop: quadrotors that catch and hit, a car, an arm."""

import importlib.util

from planner_jax.sweep.settings import SettingError

if not all(importlib.util.find_spec(name) for name in ("mujoco", "mujoco.mjx")):
    raise SettingError("flights need MuJoCo and MJX: pip install 'planner-jax[sims]'")
