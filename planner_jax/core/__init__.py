"""Base classes of planners, plans and cases, checks of arguments, and the registry of names."""

GRAVITY = 9.81  # [m/s^2], default magnitude of gravity in cases of all tasks
