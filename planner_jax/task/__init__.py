"""The tasks: hit, catch or block a ball, and intercept one target or a group with a car."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
