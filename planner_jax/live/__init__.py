"""Live planning for one robot: `planner-jax serve` answers measurements with setpoints (UDP)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
