"""The task `group`: one car meets several moving targets among obstacles, one after another."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
