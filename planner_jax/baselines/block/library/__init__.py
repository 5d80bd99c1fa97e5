"""A library of stored arm motions that block balls [Natarajan2024, Algorithm 1].

The faces of two boxes around the arm are divided into cells. A motion is stored for each pair of a
cell of the outer and a cell of the inner box that a ball can pass.
"""
