from .api import judge as judge
from .api import planner as planner
from .case import RallyCase as RallyCase
from .case import RallyLimits as RallyLimits
from .case import case as case
from .default_planner import RallyProblem as RallyProblem
from .plan import RallyPlan as RallyPlan
from .suites import draw as draw
