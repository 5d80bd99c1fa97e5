"""Penalties of the published planners, as pure functions of one motion in SI units.

`smooth_hinge` and `steep_hinge` turn an excess over a limit into a penalty, and `trapezoid`
integrates penalties over time. The other functions compute an excess, which is <= 0 within the
limit, or a cost. Where an equation has a misprint, `printed=True` computes the printed formula.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
