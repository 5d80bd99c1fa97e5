"""Piecewise polynomials and the maps that make them."""
