"""The task `reach`: an arm moves from one joint state to another, free of collisions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
