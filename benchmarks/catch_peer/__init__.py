"""A C++ program that plans catches of one ball, with its own L-BFGS and BFGS.

It minimises the objective of the planner `PaperCatch`, which reimplements [Yu2023catch].
`benchmarks.catch_reference` compares the speed of this library's planners with the program.
"""
