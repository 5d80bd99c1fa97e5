"""Models of the ball: flight with drag, impact on a racket, prediction and state estimation.

`fit` estimates position, velocity, drag and lift of a ball from one's own recording, and predicts
its flight; a `Ball` describes what is known about the ball.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
