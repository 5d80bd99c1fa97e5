"""Blocks looked up: motions for every pair of cells of both boxes (paper 004, Algorithm 1)."""
