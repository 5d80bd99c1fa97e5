"""Referees, independent of the planners: they check plans against the physics in float64 NumPy."""
