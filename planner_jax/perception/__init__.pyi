from .drag import RlsState as RlsState
from .drag import drag_by_rls as drag_by_rls
from .drag import measure_drag as measure_drag
from .drag import rls_update as rls_update
from .drag import specific_energy as specific_energy
