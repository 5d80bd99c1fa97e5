from .levenberg import LevenbergConfig as LevenbergConfig
from .methods import OptaxSolver as OptaxSolver
from .minimum import Minimum as Minimum
from .minimum import minimise as minimise
from .settings import LbfgsConfig as LbfgsConfig
from .settings import NewtonConfig as NewtonConfig
