from . import catch as catch
from . import hit as hit
