"""The task `intercept`: a car meets a moving target among static and moving obstacles [Qu2022]."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
