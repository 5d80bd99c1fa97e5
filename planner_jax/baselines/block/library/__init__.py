"""A library of stored arm motions, one for each pair of box cells that a ball passes.

The method is [Natarajan2024, Algorithm 1].
"""
