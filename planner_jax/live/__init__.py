"""A live loop for one robot: observations of a ball in, setpoints of a plan out, over UDP."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
