"""Solvers for batches (L-BFGS, Newton, least squares), base planners, gradients of optima."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
