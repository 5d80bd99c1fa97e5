"""The task `catch`: a quadrotor catches one or more flying targets in a net [Yu2023catch]."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
