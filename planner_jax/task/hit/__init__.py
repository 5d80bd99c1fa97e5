"""The task `hit`: a quadrotor hits a flying ball to a target with a racket [Yu2023bat]."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
