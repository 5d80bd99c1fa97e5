from . import block as block
from . import catch as catch
from . import group as group
from . import hit as hit
from . import intercept as intercept
from . import rally as rally
from . import reach as reach
from . import team as team
