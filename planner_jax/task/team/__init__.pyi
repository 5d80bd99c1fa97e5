from .api import judge as judge
from .api import planner as planner
from .case import TeamCase as TeamCase
from .case import case as case
from .default_planner import ExactTeam as ExactTeam
from .plan import TeamPlan as TeamPlan
from .suites import draw as draw
