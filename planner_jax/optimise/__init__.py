"""Solvers for batches (L-BFGS, Newton, least squares), base planners, gradients of optima."""
