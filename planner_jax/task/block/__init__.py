"""The task `block`: an arm with a shield protects a box from thrown balls [Natarajan2024]."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
