"""A library of stored arm motions that block balls [Natarajan2024, Algorithm 1].

Two boxes around the arm are divided into cells. A motion is stored for each pair of an outer and an
inner cell that a ball can pass.
"""
