"""Estimators of balls' drag and of a quadrotor's state, from observations of their flights."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
