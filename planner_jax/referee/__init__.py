"""Float64 NumPy checks of plans against the physics, independent of the planners."""
