"""The task `rally`: a quadrotor hits a ball again and again with a racket, by planned chains."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
