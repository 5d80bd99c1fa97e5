"""Stored motions for every pair of cells of both boxes [Natarajan2024, Algorithm 1]."""
