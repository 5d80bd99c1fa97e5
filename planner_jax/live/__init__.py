"""Live planning for one robot: it receives observations of a ball and answers with setpoints (UDP).

A program sends packets with measured positions; the command `planner-jax serve` answers them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
