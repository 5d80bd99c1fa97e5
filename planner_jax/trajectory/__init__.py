"""Piecewise polynomials and minimum-control splines."""
