"""Trajectories as piecewise polynomials, and splines of least energy, such as minimum snap."""
