"""The task `team`: several quadrotors catch flying targets, and keep a distance from each other."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
